"""What a recording should hold by its own account: the pulses that were triggered, the frames that were written."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mosca.data.files.toml import read_toml
from mosca.errors import InputError
from mosca.recording.pulses import RecordedPulse

TOML_NAME = "recording.toml"
"""File beside a finished recording, for people and programs."""


def recorded_account(toml: Path, pulses: Iterable[RecordedPulse]) -> dict[str, Any]:
    """Return ``pulses``, the number that were triggered, and ``frames``, camera -> frames that were written.

    Each is returned only where it is known. A capture states its pulses in ``toml``. A capture that was killed has no
    such file; then its last pulse in ``/clock`` (``pulses``) determines the number.

    Raises
    ------
    InputError
        Where ``toml`` holds anything but counts.
    """
    told = read_toml(toml) if toml.exists() else {}
    account: dict[str, Any] = {}
    captured = _table(told.get("capture", {}), toml, "capture")
    if "pulses" in captured:
        account["pulses"] = _count(captured["pulses"], toml, "capture.pulses")
    elif (last := max((one.number for one in pulses), default=-1)) >= 0:
        account["pulses"] = last + 1
    cameras = told.get("camera", [])
    if not isinstance(cameras, list):
        raise InputError(f"{toml}: camera = {cameras!r}: a table [[camera]] for each camera is wanted")
    frames = {}
    for camera in (_table(one, toml, "camera") for one in cameras):
        counts = _table(camera.get("frames", {}), toml, "camera.frames")
        frames[str(camera.get("name"))] = sum(_count(n, toml, f"camera.frames.{kind}") for kind, n in counts.items())
    if frames:
        account["frames"] = frames
    return account


def _table(value: object, path: Path, key: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{path}: {key} = {value!r}: a table is wanted; restore the file as it was recorded")
    return value


def _count(value: object, path: Path, key: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"{path}: {key} = {value!r}: a count from 0 is wanted; restore the file as it was recorded")
    return value
