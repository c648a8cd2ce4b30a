"""Switches of an error budget: for each source of error, keys of a scenario and the values that mean "off".

To add a source, add a ``Switch`` to ``SWITCHES``: nothing else names them. Sources that no key can remove are in
``BUILT``: they are removed from the built cameras and scene (``scenarios.studies.budget.quiet``). A source of error
without a switch stays in the remainder of the budget.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from pydantic import ValidationError

from mosca.data.files.toml import Table
from mosca.errors import InputError
from scenarios.spec.cameras import CameraSpec
from scenarios.spec.scenario import Scenario
from scenarios.spec.scenes import CloudScene

PER_CAMERA = ("errors", "optics", "timing", "mount", "sensor", "delivery")
"""Tables that a [[camera]] can have of its own."""
T = TypeVar("T", bound=Table)
SHORT_S = 1e-6
"""An exposure in which nothing moves: a marker at 10 m/s moves by 0.01 mm."""


@dataclass(frozen=True)
class Switch:
    """A source of error that can be switched off.

    ``keys``: dotted key of a scenario -> value that means "off". ``acts_on``: the part that must be made anew: the
    rendered "take", the "lens" (take and calibration session), or the "rig" that the pipeline gets.
    """

    name: str
    told: str
    keys: Mapping[str, Any]
    acts_on: Literal["take", "lens", "rig"] = "take"
    built: bool = False
    """Whether it is removed, under this name, from built cameras and scenes (``scenarios.studies.budget.quiet``)."""


SWITCHES = (
    Switch("occlusion", "markers that are hidden in part", {}, built=True),
    Switch("skin", "skin that slides on the bones", {"scene.skin": "off"}),
    Switch("noise", "noise and steps of the sensors", {}, built=True),
    Switch("shake", "shake of the camera bodies", {"errors.body_px": 0.0}),
    Switch(
        "mount",
        "vibration, drift and bumps of the mounts",
        {
            "mount.vibration_px": 0.0,
            "mount.drift_px_per_s": (0.0, 0.0),
            "mount.wander_px": 0.0,
            "mount.bump_s": None,
            "mount.bump_px": (0.0, 0.0),
            "mount.bump_m": (0.0, 0.0, 0.0),
        },
    ),
    Switch(
        "timing",
        "jitter and delays of the triggers",
        {
            "errors.trigger_jitter_s": 0.0,
            "timing.delay_s": 0.0,
            "timing.stamp_jitter_s": 0.0,
            "timing.clock_offset_s": 0.0,
            "timing.clock_drift_ppm": 0.0,
        },
    ),
    Switch("motion", "motion blur", {"capture.exposure_s": SHORT_S, "timing.exposure_s": None}),
    Switch(
        "defocus",
        "defocus, field curvature and coma",
        {"optics.focus_m": None, "optics.curvature_px": 0.0, "optics.coma_px": 0.0},
    ),
    Switch(
        "thermal",
        "warming of the lenses in the take",
        {"optics.principal_distance_ppm_per_s": 0.0, "optics.principal_point_px_per_s": (0.0, 0.0)},
    ),
    Switch(
        "stray",
        "stray light, shiny spots, mirrors, haze",
        {
            "surroundings.context": None,
            "surroundings.ring_light": None,
            "surroundings.spots": (),
            "surroundings.mirrors": (),
            "surroundings.glare.share": 0.0,
        },
    ),
    Switch(
        "losses",
        "frames lost, late or spoilt",
        {f"delivery.{key}": 0.0 for key in ("dropped_share", "burst_share", "corrupt_share", "late_share")},
    ),
    Switch(
        "lens",
        "what the lens model cannot follow",
        {"model_gap": "none", "optics.tilt_deg": None, "optics.pupil_shift_m": None},
        acts_on="lens",
    ),
    Switch("calibration", "calibration: estimated instead of true rig", {"calibration": None}, acts_on="rig"),
    Switch("fault", "the fault of the control", {"fault": None}, acts_on="lens"),
)
"""All switches, in the order in which ties are listed."""
BUILT = tuple(one.name for one in SWITCHES if one.built)


def switch(name: str) -> Switch:
    """Return the switch of a name. InputError, with all names, where there is none."""
    for one in SWITCHES:
        if one.name == name:
            return one
    raise InputError(
        f"--sources {name}: no such source of error; there are {', '.join(one.name for one in SWITCHES)}"
    )


def sources_of(spec: Scenario) -> tuple[str, ...]:
    """Return the sources of error that are on in ``spec`` and can be switched off, in the order of SWITCHES."""
    return tuple(one.name for one in SWITCHES if _is_on(spec, one))


def cameras_sources(spec: Scenario) -> tuple[str, ...]:
    """Return the sources of ``sources_of`` that single cameras have: those of the take, in tables of a [[camera]]."""
    return tuple(
        one.name
        for one in SWITCHES
        if _is_on(spec, one) and one.acts_on == "take" and (one.name == "noise" or (one.keys and _of_cameras(one)))
    )


def switched_off(spec: Scenario, names: Iterable[str], camera: str | None = None) -> Scenario:
    """Return ``spec`` without the named sources of error; only for ``camera`` where one is given.

    Sources with ``built`` stay here: they are removed after building. InputError where the result is no valid
    scenario.
    """
    names = tuple(names)
    for name in names:
        for key, value in switch(name).keys.items():
            spec = _with_key(spec, key, value) if camera is None else _with_own_key(spec, camera, key, value)
    try:
        return Scenario.model_validate(spec.model_dump(exclude_unset=True))
    except ValidationError as error:
        raise InputError(
            f"budget: {', '.join(names)} cannot be switched off here: {error.errors()[0]['msg']}"
        ) from None


def _is_on(spec: Scenario, one: Switch) -> bool:
    if one.name == "occlusion":
        return not isinstance(spec.scene, CloudScene)
    if one.built:
        return True
    return any(_differs(spec, key, value) for key, value in one.keys.items())


def _of_cameras(one: Switch) -> bool:
    return all(key.split(".")[0] in PER_CAMERA for key in one.keys)


def _differs(spec: Scenario, key: str, value: Any) -> bool:
    """Return whether a key of the scenario, or of a [[camera]] in it, has another value."""
    table, _, name = key.partition(".")
    tables: Collection[Any] = [spec]
    if table in PER_CAMERA:
        own = [getattr(one, table) for one in spec.camera]
        tables = [getattr(spec, table), *(one for one in own if name in one.model_fields_set)]
        return any(getattr(one, name) != value for one in tables)
    found: Any = spec
    for part in key.split("."):
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return bool(found != value) and not (key == "calibration" and spec.session is None)


def _with_key(spec: Scenario, key: str, value: Any) -> Scenario:
    table, _, name = key.partition(".")
    if table in PER_CAMERA:
        cameras = tuple(
            _changed(one, key, value) if name in getattr(one, table).model_fields_set else one for one in spec.camera
        )
        spec = spec.model_copy(update={"camera": cameras})
        if getattr(getattr(spec, table), name) == value:
            return spec
    return _changed(spec, key, value)


def _with_own_key(spec: Scenario, camera: str, key: str, value: Any) -> Scenario:
    cameras = list(spec.camera)
    names = [one.name for one in cameras]
    if camera not in names:
        cameras.append(CameraSpec(name=camera))
        names.append(camera)
    at = names.index(camera)
    cameras[at] = _changed(cameras[at], key, value)
    return spec.model_copy(update={"camera": tuple(cameras)})


def _changed(table: T, key: str, value: Any) -> T:
    """Return a table with another value at a dotted key; unchanged where it has no such key."""
    name, _, rest = key.partition(".")
    if not hasattr(table, name):
        return table
    if rest:
        below = getattr(table, name)
        value = below if below is None else _changed(below, rest, value)
    return table.model_copy(update={name: value})
