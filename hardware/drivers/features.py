"""Access to a camera's features by their GenICam names, through any library: set, read back, one-line errors."""

import difflib
from collections.abc import Sequence
from typing import Literal, Protocol

from hardware.driver import DeviceError
from hardware.settings import Feature

Kind = Literal["integer", "float", "boolean", "enumeration", "string", "command"]

# a device rounds a time or a gain to its own steps; a larger relative difference is another value
FLOAT_SHARE = 0.005
# limits beyond this mean that there are none
BOUNDLESS = 1e18


class FeatureRefused(Exception):
    """The device or its library did not take a value; the text is the library's."""


class Features(Protocol):
    """The feature tree of an open camera. ``write``, ``execute`` and ``read`` raise FeatureRefused."""

    def names(self) -> Sequence[str]:
        """Return the names of all features, to suggest the one that was meant."""
        ...

    def kind(self, name: str) -> Kind | None:
        """Return what sort of feature it is, None where the device has none of that name just now."""
        ...

    def writable(self, name: str) -> bool:
        """Whether it can be written just now."""
        ...

    def readable(self, name: str) -> bool:
        """Whether it can be read just now."""
        ...

    def read(self, name: str) -> Feature:
        """Return the device's value."""
        ...

    def write(self, name: str, value: Feature) -> None:
        """Write a value that suits the feature's kind."""
        ...

    def execute(self, name: str) -> None:
        """Execute a command."""
        ...

    def limits(self, name: str) -> tuple[float, float, float]:
        """Return the least and largest value and the step (0 where there is none) of a number."""
        ...

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the entries of an enumeration that are available just now."""
        ...


def put(features: Features, camera: str, name: str, value: Feature, key: str = "") -> Feature:
    """Set a feature and return the value that the device accepted; ``key``: the feature's name in the rig file.

    DeviceError in one line (camera, feature, requested, accepted and allowed values) where the device has no such
    feature, rejects the value or accepts another (numbers: further off than half a percent and one increment).
    """
    kind = features.kind(name)
    if kind is None:
        asked = f" ({key} asks for it)" if key else ""
        raise DeviceError(f"camera '{camera}': the device has no feature '{name}'{asked}{_near(features, name)}")
    if kind == "command":
        return _execute(features, camera, name, value)
    where = f"camera '{camera}': {name}" + (f" ({key})" if key else "")
    fitting = _fitting(features, where, name, kind, value)
    if not features.writable(name):
        # a feature that is fixed at the requested value is no error
        held = features.read(name)
        if agrees(features, name, fitting, held):
            return held
        raise DeviceError(
            f"{where} = {_shown(value)} asked for, but the device holds it at "
            f"{_shown(held)} and lets nobody write it now"
        )
    _within(features, where, name, kind, fitting)
    try:
        features.write(name, fitting)
        # keys of scheduled actions are write-only
        taken = features.read(name) if features.readable(name) else fitting
    except FeatureRefused as error:
        raise DeviceError(
            f"{where} = {_shown(value)} was refused ({error}); allowed: {allowed(features, name)}"
        ) from None
    hold(features, where, name, fitting, taken)
    return taken


def hold(features: Features, where: str, name: str, asked: Feature, taken: Feature) -> None:
    """Raise DeviceError, beginning with ``where``, if the accepted value ``taken`` is not the requested ``asked``."""
    if not agrees(features, name, asked, taken):
        raise DeviceError(
            f"{where} = {_shown(asked)} asked for, the device took {_shown(taken)}; "
            f"allowed: {allowed(features, name)}"
        )


def agrees(features: Features, name: str, asked: Feature, taken: Feature) -> bool:
    """Whether the device's value equals the requested one."""
    if isinstance(asked, float) and isinstance(taken, int | float):
        step = features.limits(name)[2]
        return abs(taken - asked) <= max(FLOAT_SHARE * abs(asked), step)
    return asked == taken


def allowed(features: Features, name: str) -> str:
    """Return a text of what a feature allows just now."""
    kind = features.kind(name)
    if kind == "enumeration":
        return ", ".join(features.entries(name))
    if kind in ("integer", "float"):
        low, high, step = features.limits(name)
        if max(abs(low), abs(high)) > BOUNDLESS:
            return "any number"
        return f"{low:.10g} to {high:.10g}" + (f" in steps of {step:.10g}" if step else "")
    return "true, false" if kind == "boolean" else "text"


def number(features: Features, *names: str) -> float | None:
    """Return the first of the numbers ``names`` that the device has, None without any."""
    for name in names:
        if features.kind(name) in ("integer", "float"):
            value = features.read(name)
            if isinstance(value, int | float):
                return float(value)
    return None


def text(features: Features, name: str) -> str:
    """Return a feature's value in words, "" where the device has none."""
    kind = features.kind(name)
    return "" if kind in (None, "command") else str(features.read(name))


def _execute(features: Features, camera: str, name: str, value: Feature) -> bool:
    if value is not True:
        raise DeviceError(
            f"camera '{camera}': {name} is a command; {name} = true executes it, {_shown(value)} means nothing"
        )
    try:
        features.execute(name)
    except FeatureRefused as error:
        raise DeviceError(f"camera '{camera}': command {name} was refused ({error})") from None
    return True


def _fitting(features: Features, where: str, name: str, kind: Kind, value: Feature) -> Feature:
    """Return ``value`` in the feature's type; switches are numbers or On/Off enumerations on some devices."""
    if isinstance(value, bool):
        if kind == "boolean":
            return value
        if kind == "integer":
            return int(value)
        word = "On" if value else "Off"
        if kind == "enumeration" and word in features.entries(name):
            return word
    elif isinstance(value, str):
        if kind in ("enumeration", "string"):
            return value
    elif kind == "float":
        return float(value)
    elif kind == "integer" and float(value).is_integer():
        return int(value)
    raise DeviceError(
        f"{where} = {_shown(value)} does not suit a feature of kind {kind}; allowed: {allowed(features, name)}"
    )


def _within(features: Features, where: str, name: str, kind: Kind, value: Feature) -> None:
    # checked before writing: some devices clip silently, others accept values that they cannot apply
    if kind == "enumeration":
        fits = value in features.entries(name)
    elif kind in ("integer", "float") and isinstance(value, int | float):
        low, high, step = features.limits(name)
        fits = low <= value <= high
        if kind == "integer" and step > 1:
            fits = fits and (value - low) % step == 0
    else:
        return
    if not fits:
        keeps = f"; the device keeps {_shown(features.read(name))}" if features.readable(name) else ""
        raise DeviceError(f"{where} = {_shown(value)} is not allowed now; allowed: {allowed(features, name)}{keeps}")


def _near(features: Features, name: str) -> str:
    near = difflib.get_close_matches(name, list(features.names()), n=1)
    return f"; did you mean '{near[0]}'?" if near and near[0] != name else "; look it up in the camera's manual"


def _shown(value: Feature) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"'{value}'" if isinstance(value, str) else f"{value:.10g}"
