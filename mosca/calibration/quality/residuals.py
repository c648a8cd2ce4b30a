"""Residuals: too many blunders, and patterns over the image that the lens model cannot follow."""

import numpy as np

from mosca.calibration.quality.findings import refuse, warn
from mosca.calibration.quality.jacobian import own_lens_parameters
from mosca.calibration.quality.limits import QualityLimits
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.distributions import f as f_distribution

LEAST_WITHIN = 40
"""Degrees of freedom inside cells from which the scatter of a residual is known well enough."""
POINTS_OF_AN_IMAGE = 8
"""Fewest points of an image for its common shift (the body's shake) to be subtracted first."""


def blunders(calibration: Calibration, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return the cameras with a large share of points that do not fit."""
    found = []
    # points that nothing determines have no residual
    judged = np.isfinite(calibration.residuals_px).all(axis=1)
    for k, camera in enumerate(calibration.rig.cameras):
        mine = judged & (calibration.sightings.camera == k)
        out = int((mine & ~calibration.used).sum())
        share = out / max(int(mine.sum()), 1)
        if share <= settings.warned_blunders:
            continue
        text = (
            f"camera '{camera.name}': {out} of {int(mine.sum())} image points ({share:.0%}) do not fit, "
            f"{settings.warned_blunders:.0%} allowed; look for reflections, wrong numbers of marks, or a target that "
            "moved or bent during the session"
        )
        raise_ = refuse if share > settings.refused_blunders else warn
        found.append(raise_("blunders", text, camera.name))
    return tuple(found)


def lens_misfit(calibration: Calibration, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return the cameras whose residuals have a pattern over the image beyond chance."""
    found = []
    for k, camera in enumerate(calibration.rig.cameras):
        free = len(own_lens_parameters(camera.name, calibration.parameters))
        size, chance, sigma = residual_pattern(calibration, k, settings.cells, free)
        least = max(settings.pattern_px, settings.pattern_sigmas * sigma)
        if chance >= settings.pattern_significance or size <= least:
            continue
        text = (
            f"camera '{camera.name}': the residuals have a pattern over the image of {size:.3f} px rms, "
            f"{least:.3f} px allowed (chance makes it with p = {max(chance, 1e-300):.1g}); the lens model cannot "
            "follow this lens: free more of its distortion, or take another model"
        )
        found.append(warn("lens-model", text, camera.name))
    return tuple(found)


def residual_pattern(
    calibration: Calibration, camera: int, cells: tuple[int, int], free: int = 0
) -> tuple[float, float, float]:
    """Return the size [px rms, an axis] of the residuals' cell means beyond chance, its p-value, and their scatter.

    An F-test compares the means of cells with the scatter inside cells. (0, 1, 0) where cells hold too few points.
    """
    mean, count, residuals, cell = cell_means(calibration, camera, cells)
    filled = count > 0
    within_freedom = 2 * int(count.sum() - filled.sum())
    between_freedom = 2 * int(filled.sum()) - free
    if within_freedom < LEAST_WITHIN or between_freedom < 4:
        return 0.0, 1.0, 0.0
    variance = float(((residuals - mean[cell]) ** 2).sum() / within_freedom)
    squares = float((count[:, None] * mean**2).sum())
    if variance == 0:
        return 0.0, 1.0, 0.0
    chance = float(f_distribution.sf(squares / between_freedom / variance, between_freedom, within_freedom))
    excess = max(squares - between_freedom * variance, 0.0) / (2 * count.sum())
    return float(np.sqrt(excess)), chance, float(np.sqrt(variance))


def cell_means(calibration: Calibration, camera: int, cells: tuple[int, int]) -> tuple[Array, Array, Array, Array]:
    """Return mean residual (k, 2) [px] and count (k,) of each cell, and residual (m, 2) and cell (m,) of each
    used point of a camera; cells row by row.
    """
    see = calibration.sightings
    rows = np.flatnonzero(calibration.used & (see.camera == camera))
    residuals = calibration.residuals_px[rows].copy()
    frame = see.frame[rows]
    number = np.bincount(frame, minlength=see.frames)
    for axis in (0, 1):
        shift = np.bincount(frame, residuals[:, axis], see.frames) / np.maximum(number, 1)
        residuals[:, axis] -= np.where(number >= POINTS_OF_AN_IMAGE, shift, 0.0)[frame]
    columns, lines = cells
    at = (see.xy_px[rows] + 0.5) / np.asarray(see.sizes[camera], dtype=float) * cells
    place = np.clip(at.astype(int), 0, (columns - 1, lines - 1))
    cell = place[:, 1] * columns + place[:, 0]
    count = np.bincount(cell, minlength=columns * lines)
    total = np.stack([np.bincount(cell, residuals[:, axis], columns * lines) for axis in (0, 1)], axis=1)
    return total / np.maximum(count, 1)[:, None], count, residuals, cell
