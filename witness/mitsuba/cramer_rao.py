"""Cramer-Rao bounds of positions for given noise and light: of markers' images, and of points in space.

Fisher information of a window: J = sum over pixels of D^T D / variance. D are the derivatives of the expected
photoelectrons by the position x, y, and by the amplitude of the target's light and the level of the background
(nuisances). The noise is taken as normal with known variance. The bound is the upper left 2 x 2 of J^-1. Size and
shape count as known. In space the information is the sum of P^T C^-1 P over the cameras, P the derivative of the
image by the point; cameras count as known.
"""

import numpy as np

from witness.mitsuba.film import Markers, Render
from witness.mitsuba.projection import project_slopes
from witness.mitsuba.scene import Array, WitnessScene
from witness.mitsuba.sensor import variance_e2

CLEAR = 0.999
"""Visible share from which a target counts as unobstructed."""


def scale_e(scene: WitnessScene, render: Render) -> float:
    """Return photoelectrons per radiance: the 95th percentile of targets' brightest pixels gets ``peak_e``.

    Without targets, the 95th percentile of all windows' pixels does.
    """
    peaks = [
        render.total[:, a:b].mean(0).max()
        for a, b, marker in zip(render.start[:-1], render.start[1:], render.place[:, 2], strict=True)
        if marker >= 0 and b > a
    ]
    values = peaks or render.total.mean(0)
    if not len(values) or np.percentile(values, 95) <= 0:
        raise ValueError(f"scene {scene.name}: no camera sees any light from a target")
    return scene.sensor.peak_e / float(np.percentile(values, 95))


def image_bounds(scene: WitnessScene, render: Render, scale: float) -> tuple[Array, Array]:
    """Return bounds (F, C, M, 2, 2) [px^2] of unobstructed targets, NaN elsewhere, and the render's own noise.

    The render's noise (F, C, M, 2) [px] is half the difference of an efficient estimator's results on both halves:
    one draw of the error that the rendering adds to the position.
    """
    shape = render.visible.shape
    bounds, moved = np.full((*shape, 2, 2), np.nan), np.full((*shape, 2), np.nan)
    overlapping = _overlapping(render)
    for k, (frame, camera, marker, x, y, w, h) in enumerate(render.place):
        size = scene.cameras[camera].size
        touches = x == 0 or y == 0 or x + w == size[0] or y + h == size[1]
        if marker < 0 or overlapping[k] or touches or render.visible[frame, camera, marker] < CLEAR:
            continue
        part = slice(render.start[k], render.start[k + 1])
        columns = [render.by_x[part], render.by_y[part], render.contrast[part], np.ones(w * h) / scale]
        design = scale * np.column_stack(columns).astype(float)
        weight = 1 / variance_e2(scene.sensor, scale * render.total[:, part].mean(0))
        information = design.T @ (design * weight[:, None])
        if np.linalg.cond(information / np.sqrt(np.outer(*[np.diag(information)] * 2) + 1e-300)) > 1e10:
            continue
        inverse = np.linalg.inv(information)
        bounds[frame, camera, marker] = inverse[:2, :2]
        halves = scale * (render.total[0, part] - render.total[1, part]) / 2
        moved[frame, camera, marker] = (inverse @ (design.T @ (weight * halves)))[:2]
    return bounds, moved


def render_noise_share(bounds: Array, moved: Array) -> float:
    """Return the share by which rendering noise raises the rms error of positions above the Cramer-Rao bound."""
    good = np.isfinite(moved[..., 0])
    if not good.any():
        return float("nan")
    white = np.linalg.solve(np.linalg.cholesky(bounds[good]), moved[good][..., None])
    return float(np.sqrt(1 + (white**2).mean()) - 1)


def point_bounds(scene: WitnessScene, markers: Markers, bounds: Array) -> Array:
    """Return bounds (F, M, 3, 3) [m^2] of points seen by two cameras or more, NaN elsewhere."""
    frames, cameras, m = bounds.shape[:3]
    information, seen = np.zeros((frames, m, 3, 3)), np.zeros((frames, m), int)
    for c in range(cameras):
        by_point = project_slopes(scene.cameras[c], markers.mean_xyz)
        good = np.isfinite(bounds[:, c, :, 0, 0])
        weight = np.linalg.inv(bounds[:, c][good])
        information[good] += by_point[good].transpose(0, 2, 1) @ weight @ by_point[good]
        seen += good
    out = np.full((frames, m, 3, 3), np.nan)
    out[seen >= 2] = np.linalg.inv(information[seen >= 2])
    return out


def _overlapping(render: Render) -> Array:
    """Return whether a target's window shares pixels with another target's (n)."""
    place, out = render.place, np.zeros(len(render.place), bool)
    for image in np.unique(place[:, :2], axis=0):
        rows = np.flatnonzero((place[:, :2] == image).all(1) & (place[:, 2] >= 0))
        x, y, w, h = place[rows, 3:].T
        meet = (x[:, None] < (x + w)[None]) & (x[None] < (x + w)[:, None])
        meet &= (y[:, None] < (y + h)[None]) & (y[None] < (y + h)[:, None])
        np.fill_diagonal(meet, False)
        out[rows] = meet.any(1)
    return out
