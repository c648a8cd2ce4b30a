"""Calibration from measured points: a target file and its text files in, a rig and its quality out."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from mosca.calibration.single_camera.adjust import AdjustmentSettings, CameraAdjustment, adjust_camera
from mosca.data.files.target_file import PointsTarget, read_measured_points
from mosca.data.rig import Rig
from mosca.errors import InputError

# the samples that find starting values; the result does not depend on them where a camera is determined
SEED = 1975
REJECTED_SHOWN = 8


def calibrate_from_points(
    recording: Path, target: PointsTarget, settings: AdjustmentSettings | None = None, lens: str | None = None
) -> tuple[Rig, tuple[CameraAdjustment, ...]]:
    """Calibrate each camera of ``target`` by space resection; its files lie in the folder ``recording``.

    The target's pixel pitch overrides ``settings.pixel_pitch_mm``; ``lens`` (model of all cameras) overrides the
    target's.
    InputError for a file that cannot be used, CalibrationError for points that do not determine their camera.
    """
    if not Path(recording).is_dir():
        raise InputError(f"{recording}: no such folder; the folder that the target's files lie in is wanted")
    settings = settings or AdjustmentSettings()
    adjustments = []
    for one, rng in zip(target.camera, np.random.default_rng(SEED).spawn(len(target.camera)), strict=True):
        size = one.size_px or target.size_px
        assert size is not None  # the target file is checked for it
        path = Path(recording) / one.file
        points = read_measured_points(path, target)
        outside = np.any((points.xy_px < -0.5) | (points.xy_px > np.array(size) - 0.5), axis=1)
        if outside.any():
            x, y = points.xy_px[np.argmax(outside)]
            raise InputError(
                f"{path}: {int(outside.sum())} points lie outside the image of {size[0]} x {size[1]} px, the first "
                f"at ({x:g}, {y:g}); check 'size_px' and the order of 'columns'"
            )
        pitch = one.pixel_pitch_mm or target.pixel_pitch_mm
        own = replace(settings, pixel_pitch_mm=pitch)
        model = lens or one.lens or target.lens
        adjustments.append(adjust_camera(one.name, size, model, points.xy_px, points.xyz, rng, own))
    return Rig(tuple(a.camera for a in adjustments)), tuple(adjustments)


def summary(adjustments: tuple[CameraAdjustment, ...] | list[CameraAdjustment]) -> str:
    """Return the adjustments as plain text: precision, parameters with standard deviations, blunders."""
    return "\n\n".join(_camera_summary(adjustment) for adjustment in adjustments)


def _camera_summary(adjustment: CameraAdjustment) -> str:
    camera, sigma = adjustment.camera, adjustment.standard_deviations
    used = adjustment.residuals_px[adjustment.used]
    lines = [
        f"{camera.name}: {camera.lens.model} lens, {camera.width} x {camera.height} px, "
        f"{len(used)} of {len(adjustment.used)} points used",
        f"  sigma0 {adjustment.sigma0_px:.3f} px; sigma_x {adjustment.sigma_x_px:.3f} px, "
        f"sigma_y {adjustment.sigma_y_px:.3f} px in the image; sigma_x {1e3 * adjustment.sigma_x_m:.4f} mm, "
        f"sigma_y {1e3 * adjustment.sigma_y_m:.4f} mm on the target",
    ]
    lines += [
        f"  {name:<14} {value:>14.7g}" + (f"  +- {sigma[name]:.2g}" if name in sigma else "  held")
        for name, value in asdict(camera.lens).items()
    ]
    position = camera.world_from_camera.translation
    lines += [
        f"  {name:<14} {value:>14.6f}  +- {sigma[name]:.2g}"
        for name, value in zip(("X_m", "Y_m", "Z_m"), position, strict=True)
    ]
    turns = ", ".join(f"{sigma[name]:.2g}" for name in ("turn_x_rad", "turn_y_rad", "turn_z_rad"))
    lines.append(f"  turn about the camera's x, y, z  +- {turns} rad")
    if len(adjustment.rejected):
        distance = np.linalg.norm(adjustment.residuals_px, axis=1)
        worst = sorted(adjustment.rejected, key=lambda i: -distance[i])
        shown = ", ".join(f"{i + 1} ({distance[i]:.2f} px)" for i in worst[:REJECTED_SHOWN])
        more = f" and {len(worst) - REJECTED_SHOWN} more" if len(worst) > REJECTED_SHOWN else ""
        lines.append(f"  rejected as blunders, counted from 1: {shown}{more}")
    return "\n".join(lines)
