"""Cramer-Rao bounds of a run's frames, from the twin's noise-free images, propagated into space.

For each image, the Fisher information of a target's position, brightness and background under its pixels' noise is
computed from images rendered without noise and with the image shifted (Kay 1993, section 3.9 for a Gaussian of known
variance). The trigger's jitter times the target's speed, a random error of the scenario and not of the pipeline, is
added to the bound of the image. The shake of a camera's body is one turn for all of its images of a frame: in space
the bound is that of all points and turns of a frame set together, of points whose cameras see them whole. The
target's diameter, which an estimator must find too, has no information on the position of a round image.

Lens errors of the calibration are not random and not part of the bound. The difference between the centre of a ball's
image and the image of the ball's centre is no error of detection either (geometry gives it, and triangulation
corrects it): detections are compared with the centroid of the true light.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mosca.camera.projection import project, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Camera, Rig, principal_distances_px
from mosca.data.truth import Truth
from scenarios.score.tracks import ratio_of_sums
from scenarios.types import Score, TruthPairs
from twin.cameras.expected_image import Expected
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing

WHOLE = 0.99
"""Visible share of its disc from which a target counts as seen whole."""
MARGIN_PX = 6.0
"""Distance beyond a target's rim up to which its light is included: the wings of the blur."""
APART_PX = 3.0
"""Distance from rim to rim below which images count as merged: no bound is given for them."""
PAIRED_PX = 1.0
"""Largest distance of a detection from the true image of its target."""
PULSES = 400
"""Most frame sets whose bound is computed. Shakes of the bodies move all points of a set together, by 3 numbers per
set: with 40 sets the efficiency scatters by 6 %, with 120 by 4, with 300 by 2."""
EFFICIENCIES = frozenset({"efficiency", "efficiency_detection"})
"""Metrics that need the bound, which takes seconds: they are scored where a scenario limits them."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Bounds of some pulses."""

    pulses: Array
    """(p,)"""
    image_px2: Array
    """(p, m, c, 2, 2) bound of each image, NaN where a target is not seen whole and apart from others."""
    light_px: Array
    """(p, m, c, 2) centroid of each image's light, NaN where others are near."""
    point_m2: Array
    """(p, m, 3, 3), NaN where fewer than two cameras see the target whole, or another camera sees a part of it."""


def needs_bound(limits: Iterable[str]) -> bool:
    """Return whether a scenario with these limits is scored against the bound."""
    return not EFFICIENCIES.isdisjoint(limits)


def pulses_asked(count: int) -> Array:
    """Return the numbers of the sampled pulses of ``count``: all, or evenly spaced ones without first and last."""
    if count <= PULSES:
        return np.arange(count)
    return np.unique(np.linspace(1, count - 2, PULSES).round().astype(int))


def bound(
    expected: Callable[[int], Sequence[Expected]],
    truth: Truth,
    rig: Rig,
    errors: Mapping[str, tuple[Mount, Timing]],
    pulses: Array,
) -> Bound:
    """Return the bounds at ``pulses``; ``expected`` renders a pulse, ``errors``: each camera's mount and timing."""
    m, c = len(truth.names), len(truth.cameras)
    image, light = np.full((len(pulses), m, c, 2, 2), np.nan), np.full((len(pulses), m, c, 2), np.nan)
    for k, pulse in enumerate(pulses):
        for frame in expected(int(pulse)):
            if frame.camera in truth.cameras:
                at = truth.cameras.index(frame.camera)
                image[k, :, at], light[k, :, at] = _image_bounds(
                    frame, truth.image_xy_px[pulse, :, at], truth.diameter_px[pulse, :, at],
                    truth.visible[pulse, :, at],
                )  # fmt: skip
    own, slope, turn = np.full_like(image, np.nan), np.zeros((*image.shape[:-1], 3)), np.zeros_like(image)
    for at, name in enumerate(truth.cameras):
        mount, timing = errors[name]
        moves = timing.jitter_s * _speed_px(truth, at)[pulses]
        own[:, :, at] = image[:, :, at] + moves[..., :, None] * moves[..., None, :]
        seen = np.isfinite(own[:, :, at]).all(axis=(2, 3))
        slope[seen, at] = _jacobian(rig.camera(name), truth.xyz[pulses][seen])
        turn[seen, at] = mount.body_px * _by_turn(rig.camera(name), truth.xyz[pulses][seen])
    seen = np.asarray(np.isfinite(own).all(axis=(3, 4)))
    # elsewhere images without a bound carry information too, so that the bound would be invalid
    bounded = (seen.sum(axis=2) >= 2) & (seen.sum(axis=2) == (truth.visible[pulses] > 0).sum(axis=2))
    weight = np.zeros_like(own)
    weight[seen] = np.linalg.inv(own[seen])
    point = np.full((len(pulses), m, 3, 3), np.nan)
    for k in range(len(pulses)):
        rows = seen[k].sum(axis=1) >= 2
        together = _with_turns(weight[k, rows], slope[k, rows], turn[k, rows])
        point[k, rows] = np.where(bounded[k, rows, None, None], together, np.nan)
    return Bound(np.asarray(pulses), image, light, point)


def _with_turns(weight: Array, slope: Array, turn: Array) -> Array:
    """Return the covariances (m, 3, 3) [m^2] of the points of a frame set whose cameras turn by unknown amounts.

    ``weight`` (m, c, 2, 2): inverse covariance of an image, 0 where there is none; ``slope`` (m, c, 2, 3): its
    derivative by the point; ``turn`` (m, c, 2, 2): that by the camera's turns, in their standard deviations.
    """
    m, c = weight.shape[:2]
    toward = np.einsum("mcki,mckl,mclj->mcij", slope, weight, turn)
    inverse = np.linalg.inv(np.einsum("mcki,mckl,mclj->mij", slope, weight, slope))
    held = np.einsum("mij,mcjk->mick", inverse, toward).reshape(m, 3, 2 * c)
    normal = np.eye(2 * c) - np.einsum("mick,mil->ckl", np.swapaxes(toward, 1, 2), held).reshape(2 * c, 2 * c)
    for at, own in enumerate(np.einsum("mcki,mckl,mclj->cij", turn, weight, turn)):
        normal[2 * at : 2 * at + 2, 2 * at : 2 * at + 2] += own
    return np.asarray(inverse + held @ np.linalg.inv(normal) @ np.swapaxes(held, 1, 2))


def efficiencies(
    bounds: Bound, matched: TruthPairs, truth: Truth, detections: Mapping[int, Mapping[str, Detections]], blocks: int
) -> dict[str, Score]:
    """Return the efficiencies, rms bound over rms error, of points in space and of their images.

    ``detections``: pulse -> camera -> detections. Intervals are by the bootstrap over ``blocks`` of pulses.
    """
    block = np.arange(len(bounds.pulses)) * blocks // max(1, len(bounds.pulses))
    row_of = {int(pulse): k for k, pulse in enumerate(bounds.pulses)}
    asked = np.array([row_of.get(int(f), -1) for f in matched.frame], dtype=int)
    least = np.where(asked >= 0, np.trace(bounds.point_m2[asked, matched.marker], axis1=1, axis2=2), np.nan)
    counted = np.isfinite(least)
    found = {}
    if counted.any():
        at = block[asked[counted]]
        found["efficiency"] = _efficiency(least[counted], matched.distance_m[counted] ** 2, at, blocks)
    image = [
        (block[k], *_image_errors(bounds.image_px2[k, :, c], bounds.light_px[k, :, c], seen[name].xy_px))
        for k, pulse in enumerate(bounds.pulses)
        for c, name in enumerate(truth.cameras)
        if (seen := detections.get(int(pulse), {})) and name in seen
    ]
    if image:
        at = np.concatenate([np.full(len(lowest), b) for b, lowest, _ in image])
        lowest, reached = (np.concatenate([part[i] for part in image]) for i in (1, 2))
        if len(lowest):
            found["efficiency_detection"] = _efficiency(lowest, reached, at, blocks)
    return found


def _efficiency(least: Array, reached: Array, block: Array, blocks: int) -> Score:
    above = np.bincount(block, weights=least, minlength=blocks)
    below = np.bincount(block, weights=reached, minlength=blocks)
    return ratio_of_sums(above, below, len(least), np.sqrt)


def _image_errors(bounds: Array, true_xy: Array, found_xy: Array) -> tuple[Array, Array]:
    """Return the bounds' traces (k,) and squared errors (k,) [px^2] of the detected targets that are seen whole."""
    rows = np.flatnonzero(np.isfinite(bounds).all(axis=(1, 2)) & np.isfinite(true_xy).all(axis=1))
    if not len(rows) or not len(found_xy):
        return np.empty(0), np.empty(0)
    away = np.linalg.norm(true_xy[rows, None] - found_xy[None], axis=2).min(axis=1)
    near = away < PAIRED_PX
    return np.trace(bounds[rows[near]], axis1=1, axis2=2), away[near] ** 2


def _image_bounds(frame: Expected, xy_px: Array, diameter_px: Array, visible: Array) -> tuple[Array, Array]:
    """Return the bound (m, 2, 2) [px^2] of each target's position, and the centroid (m, 2) [px] of its light.

    NaN where the target is not seen whole and apart from others; the centroid is also NaN where other light is within
    1.5 margins.
    """
    bounds, light = np.full((len(xy_px), 2, 2), np.nan), np.full((len(xy_px), 2), np.nan)
    there = np.isfinite(xy_px).all(axis=1) & (visible > 0)
    height, width = frame.mean_e.shape
    for marker in np.flatnonzero(there & (visible >= WHOLE)):
        x, y = xy_px[marker]
        reach = diameter_px[marker] / 2 + MARGIN_PX
        left, right = max(0, int(np.ceil(x - reach))), min(width, int(np.floor(x + reach)) + 1)
        top, bottom = max(0, int(np.ceil(y - reach))), min(height, int(np.floor(y + reach)) + 1)
        window = np.s_[top:bottom, left:right]
        column, row = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
        own = ~frame.saturated[window]
        rim = np.hypot(column - x, row - y) - diameter_px[marker] / 2
        others = there.copy()
        others[marker] = False
        gaps = np.hypot(*(xy_px[others] - xy_px[marker]).T) - (diameter_px[others] + diameter_px[marker]) / 2
        if (gaps < APART_PX).any():
            continue
        for u, v, diameter in np.column_stack([xy_px[others], diameter_px[others]])[gaps < 2 * MARGIN_PX]:
            own &= rim <= np.hypot(column - u, row - v) - diameter / 2
        change = np.stack(
            [frame.right_e[window][own], frame.down_e[window][own], frame.target_e[window][own], np.ones(own.sum())]
        )
        information = (change / frame.variance_e2[window][own]) @ change.T
        scale = np.sqrt(np.diag(information))
        if (scale > 0).all():
            bounds[marker] = np.linalg.inv(information / np.outer(scale, scale))[:2, :2] / np.outer(
                scale[:2], scale[:2]
            )
        shares = np.where(rim <= MARGIN_PX, frame.target_e[window], 0.0)
        if (gaps >= 1.5 * MARGIN_PX).all() and shares.sum() > 0:
            light[marker] = np.sum(shares * column) / shares.sum(), np.sum(shares * row) / shares.sum()
    return bounds, light


def _speed_px(truth: Truth, camera: int) -> Array:
    """Return the velocities of images (t, m, 2) [px/s], NaN where they are not seen before and after."""
    xy: Array = truth.image_xy_px[:, :, camera]
    seconds = truth.time_ns * 1e-9
    if len(xy) < 2:
        return np.zeros(xy.shape)
    speed: Array = np.gradient(xy, seconds, axis=0)
    return np.where(np.isfinite(speed), speed, 0.0)


def _by_turn(camera: Camera, xyz: Array) -> Array:
    """Return the derivatives (n, 2, 2) of images of ``xyz`` (n, 3) by rotations of the camera about two axes, each of
    which moves the middle of the image by 1 px (the rim moves more).
    """
    turned = project_with_jacobians(camera, xyz).by_pose[:, :, 1::-1]
    return np.asarray(turned / np.array(principal_distances_px(camera.lens)))


def _jacobian(camera: Camera, xyz: Array) -> Array:
    """Return the Jacobian (n, 2, 3) [px/m] of a point's image by its position."""
    step = 1e-5
    return np.stack(
        [
            (project(camera, xyz + step * axis) - project(camera, xyz - step * axis)) / (2 * step)
            for axis in np.eye(3)
        ],
        axis=2,
    )
