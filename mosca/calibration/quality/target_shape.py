"""Is the target as its file has it? Residuals that go with the mark, from view to view, say no."""

import numpy as np

from mosca.calibration.quality.findings import warn
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding

REPEATED_SHARE = 0.1
"""Share of the residuals' squares, of views left out, above which it is told. Of a target as in its file the share is
below 0, since what is estimated from the noise of some views adds to that of others."""
FEWEST_VIEWS = 8
"""Exposures of the target below which it is not judged."""


def target_shape(calibration: Calibration) -> tuple[Finding, ...]:
    """Return whether the marks of a rigid target are elsewhere on it, by views that were left out.

    The displacements of all marks, to first order, that explain the residuals of one half of the session are tried on
    the other one.
    """
    rows = np.flatnonzero(calibration.used & np.isfinite(calibration.residuals_px).all(axis=1))
    frames = calibration.sightings.frame[rows]
    if len(np.unique(frames)) < FEWEST_VIEWS:
        return ()
    slope, residual = _slopes(calibration, rows), calibration.residuals_px[rows]
    mark = calibration.sightings.mark[rows]
    late = frames > np.median(frames)
    left = 0.0
    for half in (late, ~late):
        moved = _displacements(slope[~half], residual[~half], mark[~half], len(calibration.marks_m))
        predicted = np.einsum("nij,nj->ni", slope[half], moved[mark[half]])
        left += float(((residual[half] - predicted) ** 2).sum())
    repeated = 1 - left / max(float((residual**2).sum()), 1e-300)
    if not repeated > REPEATED_SHARE:
        return ()
    away = np.linalg.norm(_displacements(slope, residual, mark, len(calibration.marks_m)), axis=1)[np.unique(mark)]
    rms = float(np.sqrt(np.mean(away**2)))
    return (
        warn(
            "target-shape",
            f"{repeated:.0%} of the residuals' squares repeat with the mark from view to view, {REPEATED_SHARE:.0%} "
            f"allowed: the {calibration.target}'s marks lie {1e3 * rms:.2g} mm rms, {1e3 * away.max():.2g} mm at "
            f"most, from where its file has them; make it flat and measure it, or have them estimated: "
            f"sigma_m = {rms:.1g}",
        ),
    )


def _slopes(calibration: Calibration, rows: Array) -> Array:
    """Return the derivatives (n, 2, 3) [px/m] of image points ``rows`` by the marks' positions on the target."""
    world = calibration.points_in_world()[rows]
    slope = np.empty((len(rows), 2, 3))
    camera_of = calibration.sightings.camera[rows]
    for k, camera in enumerate(calibration.rig.cameras):
        mine = camera_of == k
        slope[mine] = project_with_jacobians(camera, world[mine]).by_point
    placement = calibration.placement[rows]
    placed = placement >= 0
    slope[placed] = slope[placed] @ calibration.target_rotation[placement[placed]]
    return slope


def _displacements(slope: Array, residual: Array, mark: Array, marks: int) -> Array:
    """Return the displacements (m, 3) [m] of the marks that explain the residuals best, 0 where nothing says it."""
    normal, right = np.zeros((marks, 3, 3)), np.zeros((marks, 3))
    np.add.at(normal, mark, np.einsum("nki,nkj->nij", slope, slope))
    np.add.at(right, mark, np.einsum("nki,nk->ni", slope, residual))
    return np.asarray(np.einsum("mij,mj->mi", np.linalg.pinv(normal, hermitian=True), right))
