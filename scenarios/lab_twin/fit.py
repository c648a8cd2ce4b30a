"""Fits the cameras of a lab to its recordings, by the estimators of ``mosca.accuracy.lab_twin``."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate, Told
from mosca.accuracy.lab_twin.frame_losses import loss_estimates
from mosca.accuracy.lab_twin.photon_transfer import sensor_estimates
from mosca.data.files.rig_file import read_rig
from mosca.data.rig import Rig
from mosca.errors import InputError
from scenarios.lab_twin.lab_file import lab_document, write_lab
from scenarios.lab_twin.moving import timing_of
from scenarios.lab_twin.recordings import CameraImages, LabRecording, Progress, image_sums, parse_recording
from scenarios.lab_twin.still import KEYS, NEEDS, in_well, still_estimates

BITS = (8, 10, 12)
"""Bits that a scenario's sensor can have."""


@dataclass(frozen=True)
class FitRequest:
    """Arguments of a fit."""

    recordings: tuple[str, ...]
    """Recordings, KIND:FOLDER each."""
    out: Path
    rig: Path | None = None
    fps: float | None = None
    bits: int | None = None


def fit_lab(request: FitRequest, progress: Progress | None = None) -> tuple[Told, ...]:
    """Fit the cameras, write the lab file, and return the estimates, camera by camera."""
    recordings = tuple(parse_recording(text) for text in request.recordings)
    rig = None if request.rig is None else read_rig(request.rig)
    if rig is None and any(one.kind == "moving" for one in recordings):
        raise InputError("moving:FOLDER needs the cameras' calibration; add --rig RIG.toml (mosca calibrate)")
    told = estimates(recordings, rig, request, progress)
    beside = None if request.rig is None else os.path.relpath(request.rig.resolve(), request.out.resolve().parent)
    write_lab(request.out, lab_document(told, [one.given for one in recordings], beside))
    return tuple(told)


def estimates(
    recordings: Sequence[LabRecording], rig: Rig | None, request: FitRequest, progress: Progress | None = None
) -> list[Told]:
    """Return the estimates from the recordings, and those that are impossible, camera by camera."""
    sums = [(one, image_sums(one, rig, request.fps, request.bits, progress)) for one in recordings]
    _check_same_cameras(sums)
    still: dict[str, list[Told]] = {}
    for one, found in sums:
        if one.kind == "static" and not still:
            still = still_estimates(one, found, rig, request.fps, progress)
    names = tuple(sums[0][1])
    moving = next((one for one, _found in sums if one.kind == "moving"), None)
    timing = timing_of(moving, rig, names, request.fps)
    told: list[Told] = []
    for name in names:
        own = _of_camera(name, [(one, found[name]) for one, found in sums])
        own += still.get(name) or [NotTold(name, key, NEEDS) for key in KEYS]
        own += [one for one in timing if one.camera == name]
        own.append(_lens_residual(name, rig))
        told += in_well(own, sums[0][1][name].pixels.bits)
    return told


def _of_camera(name: str, seen: Sequence[tuple[LabRecording, CameraImages]]) -> list[Told]:
    bits = seen[0][1].pixels.bits
    told: list[Told] = []
    if bits in BITS:
        told.append(ParameterEstimate(name, "errors.bits", bits, 0.0, "as the recording states, or --bits"))
    else:
        told.append(NotTold(name, "errors.bits", f"images of {bits} bits; say 8, 10 or 12 by --bits"))
    dark = [images.pixels for one, images in seen if one.kind == "dark"]
    lit = [images.pixels for one, images in seen if one.kind == "lit"]
    told += sensor_estimates(name, dark[0] if dark else None, lit)
    told += loss_estimates(name, [images.arrived for _one, images in seen if images.arrived is not None])
    return told


def _lens_residual(name: str, rig: Rig | None) -> Told:
    """Return the residual of the lens model in a camera's images, on each axis, from the rig file."""
    stated = 0.0 if rig is None else rig.camera(name).residual_px
    if stated == 0.0:
        why = "needs a rig file whose calibration states what its lens model leaves: --rig RIG.toml (mosca calibrate)"
        return NotTold(name, "lens_residual_px", why)
    return ParameterEstimate(name, "lens_residual_px", stated, 0.0, "as the rig file states; model_gap stays")


def _check_same_cameras(sums: Sequence[tuple[LabRecording, dict[str, CameraImages]]]) -> None:
    """Raise InputError where recordings show different cameras, or one camera with different images."""
    first, wanted = sums[0]
    for one, found in sums[1:]:
        if set(found) != set(wanted):
            raise InputError(
                f"{one.given}: cameras {', '.join(found)}; {first.given} has {', '.join(wanted)}: record the same"
            )
        for name, images in found.items():
            here, there = images.pixels, wanted[name].pixels
            if (here.mean.shape, here.bits) != (there.mean.shape, there.bits):
                raise InputError(
                    f"{one.given}: camera '{name}' has images of another size or other bits than in {first.given}; "
                    "record both with the same settings"
                )
