"""Check of the target's shape: it differs from its file if residuals of a mark repeat from view to view."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mosca.calibration.quality.findings import note, warn
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding

REPEATED_SHARE = 0.1
"""Share of the residuals' squares, in views left out, above which a finding is reported. For a target as in its file
the share is below 0, since displacements estimated from the noise of some views add to the noise of others."""
ESTIMATED_SHARE = 0.25
"""Share, as before, above which the marks are estimated: bends as large as half of the noise. A lens whose model
leaves residuals of 6 times the noise makes 0.13, the bent board of sleap-anipose 0.77."""
FEWEST_VIEWS = 8
"""Exposures of the target below which it is not judged."""


def target_shape(calibration: Calibration) -> tuple[Finding, ...]:
    """Return a warning where the marks of a rigid target are not where its file has them."""
    share, away = repeated_displacements(calibration)
    if not share > REPEATED_SHARE:
        return ()
    return (warn("target-shape", f"{_told(calibration, share, away)}; make it flat and measure it"),)


def with_shape(calibration: Calibration, calibrated: Callable[[Array], Calibration]) -> Calibration:
    """Return the calibration, with the marks' positions among the unknowns where the residuals require it.

    ``calibrated``: calibrates with a-priori standard deviations (3,) [m] of the marks along the target's axes. These
    are the rms of the displacements, in the plane and out of it: paper bends more than a printer stretches it.
    """
    share, away = repeated_displacements(calibration)
    if not share > ESTIMATED_SHARE:
        return calibration
    in_plane = np.mean(away[:, :2] ** 2)
    found = calibrated(np.sqrt([in_plane, in_plane, np.mean(away[:, 2] ** 2)]))
    told = note("target-shape", f"{_told(calibration, share, away)}; their positions were estimated")
    return replace(found, findings=(*found.findings, told))


def _told(calibration: Calibration, share: float, away: Array) -> str:
    distance = 1e3 * np.linalg.norm(away, axis=1)
    return (
        f"{share:.0%} of the residuals' squares repeat with the mark from view to view, {REPEATED_SHARE:.0%} "
        f"allowed: the {calibration.target}'s marks lie {np.sqrt(np.mean(distance**2)):.2g} mm rms, "
        f"{distance.max():.2g} mm at most, from where its file has them"
    )


def repeated_displacements(calibration: Calibration) -> tuple[float, Array]:
    """Return the share of the residuals' squares that displacements of the marks explain, and these (m, 3) [m].

    The share is that of views left out: the displacements of all marks, to first order, are estimated from the
    residuals of one half of the session and tried on the other half. 0 with too few views.
    """
    rows = np.flatnonzero(calibration.used & np.isfinite(calibration.residuals_px).all(axis=1))
    frames = calibration.sightings.frame[rows]
    if len(np.unique(frames)) < FEWEST_VIEWS:
        return 0.0, np.zeros((1, 3))
    slope, residual = _slopes(calibration, rows), calibration.residuals_px[rows]
    mark = calibration.sightings.mark[rows]
    late = frames > np.median(frames)
    left = 0.0
    for half in (late, ~late):
        moved = _displacements(slope[~half], residual[~half], mark[~half], len(calibration.marks_m))
        predicted = np.einsum("nij,nj->ni", slope[half], moved[mark[half]])
        left += float(((residual[half] - predicted) ** 2).sum())
    away = _displacements(slope, residual, mark, len(calibration.marks_m))[np.unique(mark)]
    return 1 - left / max(float((residual**2).sum()), 1e-300), away


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
    """Return the displacements (m, 3) [m] of the marks that explain the residuals best, 0 where undetermined."""
    normal, right = np.zeros((marks, 3, 3)), np.zeros((marks, 3))
    np.add.at(normal, mark, np.einsum("nki,nkj->nij", slope, slope))
    np.add.at(right, mark, np.einsum("nki,nk->ni", slope, residual))
    return np.asarray(np.einsum("mij,mj->mi", np.linalg.pinv(normal, hermitian=True), right))
