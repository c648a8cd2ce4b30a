"""``lab.toml``: cameras described as in a scenario, the uncertainty of each parameter, and the unknown parameters.

``[[camera]]`` and ``[cameras]`` are a scenario's own tables; ``mosca run SCENARIO --lab lab.toml`` puts them in place
of the scenario's. ``[[estimate]]`` states the uncertainty of each key and the data of the estimate. ``[[not_told]]``
lists the keys that the recordings do not determine: for these the scenario's own values stay.
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from statistics import NormalDist
from typing import Any, ClassVar

import tomli_w
from pydantic import Field

from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate, Told
from mosca.data.files.toml import NotNegative, Table, check, read_toml
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError
from scenarios.spec.cameras import CameraSpec

REACH = NormalDist().inv_cdf(0.975)
"""Half a 95 % interval over the standard deviation."""
DIGITS = 6
TABLES = ("errors", "optics", "timing", "mount", "sensor", "delivery")
SIGNED = ("timing.delay", "timing.skew", "mount.drift")
"""Prefixes of keys whose values may be below zero."""
_PLACE = re.compile(
    "|".join(
        rf"{table}\.{name}(\[[01]\])?"
        for table in TABLES
        for name in CameraSpec.model_fields[table].annotation.model_fields  # type: ignore[union-attr]
    )
)
"""A key of a scenario, or one number of a pair."""
WHOLE = ("delivery.burst_frames", "errors.bits")
"""Keys of whole numbers."""


class LabRig(Table):
    """The rig of the lab."""

    rig: str = Field(description="rig file with which the lab is calibrated")


class EstimateSpec(Table):
    """How certain one key of one camera is."""

    camera: str = Field(description="the camera's name")
    key: str = Field(description="table and key of [[camera]], e.g. errors.read_noise_e; others are for people alone")
    value: float = Field(description="what was estimated, in the key's unit")
    sigma: NotNegative = Field(description="its standard deviation")
    low: float = Field(description="lower end of the 95 % interval")
    high: float = Field(description="upper end of the 95 % interval")
    evidence: str = Field(description="from what it was estimated")


class CorrelationSpec(Table):
    """How two estimates of one camera are correlated."""

    camera: str = Field(description="the camera's name")
    keys: tuple[str, str] = Field(description="keys of the two estimates")
    value: float = Field(ge=-1, le=1, description="coefficient of correlation; draws of the two have it")


class NotToldSpec(Table):
    """A key of one camera that the recordings did not tell."""

    camera: str = Field(description="the camera's name")
    key: str = Field(description="table and key of [[camera]]")
    reason: str = Field(description="what lacks")


class LabTwin(Table):
    """Cameras of a lab as fitted to its recordings."""

    FILE_KIND: ClassVar[str] = "lab"

    recordings: tuple[str, ...] = Field((), description="what it was fitted to, KIND:FOLDER each")
    cameras: LabRig | None = None
    camera: tuple[CameraSpec, ...] = Field(min_length=1, description="the cameras, as in a scenario; [[camera]]")
    estimate: tuple[EstimateSpec, ...] = Field((), description="how certain each key is; [[estimate]]")
    correlation: tuple[CorrelationSpec, ...] = Field(
        (), description="estimates that are not independent of each other; [[correlation]]"
    )
    not_told: tuple[NotToldSpec, ...] = Field((), description="what the recordings did not tell; [[not_told]]")


def read_lab(path: Path) -> LabTwin:
    """Return the cameras in a lab file; the path of its rig file is made absolute.

    InputError names file, key, value and what is allowed, also where an estimate is of a camera or a key that does
    not exist.
    """
    lab = check(LabTwin, read_toml(path), path)
    names = [one.name for one in lab.camera]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: [[camera]] {', '.join(names)} given; each name once is wanted")
    for k, one in enumerate(lab.estimate):
        if one.camera not in names:
            raise InputError(
                f"{path}: key 'estimate[{k}].camera': '{one.camera}' given; one of {', '.join(names)} is wanted"
            )
        if one.low > one.high:
            raise InputError(f"{path}: key 'estimate[{k}].low': {one.low:g} given, above high = {one.high:g}")
        if is_scenario_key(one.key) and not _PLACE.fullmatch(one.key):
            raise InputError(f"{path}: key 'estimate[{k}].key': '{one.key}' given, which no scenario has")
    known = {(one.camera, one.key) for one in lab.estimate}
    for k, pair in enumerate(lab.correlation):
        if missing := [key for key in pair.keys if (pair.camera, key) not in known]:
            raise InputError(
                f"{path}: key 'correlation[{k}].keys': '{missing[0]}' given, of which camera '{pair.camera}' has no "
                "[[estimate]]"
            )
    if lab.cameras is None:
        return lab
    rig = LabRig(rig=str((path.parent / lab.cameras.rig).resolve()))
    return lab.model_copy(update={"cameras": rig})


def lab_document(told: Sequence[Told], recordings: Sequence[str], rig: str | None) -> dict[str, Any]:
    """Return the document of a lab file from the estimates and the missing estimates.

    ``rig``: path of the rig file, relative to the lab file; None for none.
    """
    names = list(dict.fromkeys(one.camera for one in told))
    cameras: dict[str, dict[str, Any]] = {name: {"name": name} for name in names}
    found = [one for one in told if isinstance(one, ParameterEstimate)]
    for one in found:
        if is_scenario_key(one.key):
            put(cameras[one.camera], one.key, as_written(one.key, one.value))
    return {
        "recordings": list(recordings),
        **({} if rig is None else {"cameras": {"rig": rig}}),
        "camera": list(cameras.values()),
        "estimate": [_row(one) for one in found],
        "correlation": [
            {"camera": one.camera, "keys": [one.key, other], "value": _rounded(value)}
            for one in found
            for other, value in one.correlation
        ],
        "not_told": [
            {"camera": one.camera, "key": one.key, "reason": one.reason} for one in told if isinstance(one, NotTold)
        ],
    }


def write_lab(path: Path, document: dict[str, Any]) -> None:
    """Write a lab file, whole or not at all."""
    check(LabTwin, document, path)
    head = "# Cameras fitted by 'mosca twin fit'; use: mosca run SCENARIO --lab THIS_FILE, mosca twin predict\n\n"
    write_text(path, head + tomli_w.dumps(document))


def put(camera: dict[str, Any], key: str, value: float | int) -> None:
    """Set ``table.key``, or ``table.key[0]`` of a pair, of a camera's table."""
    table, name = key.split(".")
    inside = camera.setdefault(table, {})
    if not name.endswith("]"):
        inside[name] = value
        return
    name, index = name[:-1].split("[")
    pair = list(inside.get(name, (0.0, 0.0)))
    pair[int(index)] = value
    inside[name] = pair


def is_scenario_key(key: str) -> bool:
    """Return whether an estimate's key is a key of a scenario, not only information for people."""
    table, dot, name = key.partition(".")
    return bool(dot) and table in TABLES and bool(name)


def as_written(key: str, value: float) -> float | int:
    """Return a value as written in a scenario: rounded, and whole where it must be."""
    return round(value) if key in WHOLE else _rounded(value)


def interval(one: ParameterEstimate) -> tuple[float, float]:
    """Return the 95 % interval of an estimate, limited to possible values."""
    low, high = one.value - REACH * one.sigma, one.value + REACH * one.sigma
    return (low if one.key.startswith(SIGNED) else max(low, 0.0)), high


def _row(one: ParameterEstimate) -> dict[str, Any]:
    low, high = interval(one)
    value = float(as_written(one.key, one.value))
    numbers = {"value": value, "sigma": one.sigma, "low": min(low, value), "high": max(high, value)}
    kept = {name: _rounded(number) for name, number in numbers.items()}
    return {"camera": one.camera, "key": one.key, **kept, "evidence": one.evidence}


def _rounded(value: float) -> float:
    if value == 0.0 or not math.isfinite(value):
        return value
    return round(value, DIGITS - 1 - math.floor(math.log10(abs(value))))
