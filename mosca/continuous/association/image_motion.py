"""Motion of a camera's image points from frame to frame, and the error of its prediction, learned from the points.

The next step of a point is predicted from its last two: ``way = a speed + b change of speed`` over the time. Both
factors and the errors of the prediction are learned from the camera's tracklets so far. At frame rates that are high
for the motion, a = b = 1. At low ones a prediction is hardly better than the last position, and the gate is wide. All
sizes are quantiles, so that wrong links and images that are no targets have no influence.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from mosca.continuous.association.frame_detections import CameraDetections
from mosca.data.arrays import Array

GATE_SIGMA = 4.5
"""Gate about a prediction, in its standard deviations, as in matching and tracking."""
SURE = 0.8
"""Share of the links that are assumed to be right; sizes are computed from this quantile, as of a Gaussian."""
FIXED_GATES, FIXED_BEND = (16.0, 5.0, 0.3), 0.8
"""Fixed gates of the first step and of later ones [px], and the latter's share of the step; share of the change of
speed."""
FEWEST = 20
"""Fewest steps from which motion is learned."""
MOST_FRAMES = 400
"""Most frames from which the first motion is learned."""


@dataclass(frozen=True)
class ImageMotion:
    """``period_s`` of the camera; standard deviations per axis over one period [px]: ``first_px`` of a step without a
    prediction, ``one_px`` of one predicted from the last step, ``two_px`` and ``share`` of one predicted from two:
    the error for the smallest motions, and its growth with the length of the last step and its change.
    ``after_one``, ``after_two``: factors of the prediction. ``least_px``: least of all standard deviations.
    """

    period_s: float
    least_px: float
    first_px: float
    one_px: float
    after_one: float = 0.0
    after_two: tuple[float, float] | None = None
    two_px: float = 0.0
    share: float = 0.0

    def step(self, speed: Array, bend: Array, middle_s: Array, last_s: Array, now_s: float) -> tuple[Array, Array]:
        """Return the steps (k, 2) until ``now_s`` and their standard deviations (k,) per axis [px].

        ``speed``, ``bend`` (k, 2): speed of the last step and change of speed [px/s, px/s^2], NaN where unknown;
        ``middle_s``, ``last_s`` (k,): instants of that speed and of the last position.
        """
        length = now_s - last_s
        periods = np.maximum(length / self.period_s, 1.0)
        one: Array = np.asarray(np.isfinite(speed).all(axis=1))
        two: Array = np.asarray(np.isfinite(bend).all(axis=1)) & (self.after_two is not None)
        last = np.nan_to_num(speed) * length[:, None]
        change = np.nan_to_num(bend) * (0.5 * (now_s + last_s) - middle_s)[:, None] * length[:, None]
        a, b = self.after_two or (0.0, 0.0)
        way = np.where(two[:, None], a * last + b * change, np.where(one[:, None], self.after_one * last, 0.0))
        # over gaps errors grow in proportion, as the steps: the square, for an unknown acceleration, is far too wide
        moved = (last**2).sum(axis=1) + (change**2).sum(axis=1)
        of_two = np.sqrt((self.two_px * periods) ** 2 + self.share**2 * moved)
        sigma = np.where(two, of_two, np.where(one, self.one_px, self.first_px) * periods)
        return way, np.maximum(sigma, self.least_px)


def first_motion(seen: CameraDetections) -> ImageMotion:
    """Return the motion from nearest image points of consecutive frames, with predictions by the last place."""
    steps = []
    for f in range(min(len(seen.frame_ns) - 1, MOST_FRAMES)):
        here, there = (seen.xy_px[seen.start[k] : seen.start[k + 1]] for k in (f, f + 1))
        if not len(here) or not len(there):
            continue
        away = cdist(here, there)
        to = away.argmin(axis=1)
        # only mutually nearest points: a point that vanished has no step
        mutual = away.argmin(axis=0)[to] == np.arange(len(here))
        steps.append(away[np.arange(len(here)), to][mutual])
    away = np.concatenate(steps) if steps else np.zeros(0)
    # two targets nearer than a diameter have one image: a gate of one diameter admits no other target
    least = float(np.median(seen.diameter_px)) / GATE_SIGMA if len(seen.diameter_px) else 1.0
    size = max(quantile_size(away**2), least)
    return ImageMotion(seen.period_s, least, size, size)


class FixedMotion(ImageMotion):
    """Gates of fixed size in pixels, where motion cannot be learned: for lamps that are dark at times, as their gaps
    hide which links are right, and for images of moving cameras.
    """

    def step(self, speed: Array, bend: Array, middle_s: Array, last_s: Array, now_s: float) -> tuple[Array, Array]:
        """As ``ImageMotion.step``; the gate is the sum of a length and a share of the step."""
        length = (now_s - last_s)[:, None]
        known = np.asarray(np.isfinite(speed).all(axis=1))
        way = np.nan_to_num(speed + FIXED_BEND * np.nan_to_num(bend) * (0.5 * (now_s + last_s) - middle_s)[:, None])
        way = way * length
        first, later, share = FIXED_GATES
        gate = np.where(known, later + share * np.linalg.norm(way, axis=1), first)
        return way, gate / GATE_SIGMA


def fixed_motion(seen: CameraDetections) -> ImageMotion:
    """Return ``FixedMotion`` at a camera's rate."""
    first, later, _share = FIXED_GATES
    return FixedMotion(seen.period_s, later / GATE_SIGMA, first / GATE_SIGMA, later / GATE_SIGMA)


def learned_motion(seen: CameraDetections, tracklet: Array, before: ImageMotion) -> ImageMotion:
    """Return the motion learned from tracklets (n,) of a camera's image points; ``before`` for too few steps."""
    order = np.lexsort((seen.frame, tracklet))
    of, frame, xy = tracklet[order], seen.frame[order], seen.xy_px[order]
    # consecutive frames only
    link = (of[1:] == of[:-1]) & (np.diff(frame) == 1)
    step = np.diff(xy, axis=0)
    if link.sum() < FEWEST:
        return before
    motion = replace(before, first_px=max(quantile_size((step[link] ** 2).sum(axis=1)), before.least_px))
    pair = np.flatnonzero(link[1:] & link[:-1])
    if len(pair) < FEWEST:
        return motion
    (factor,), rest = _predicted(step[pair + 1], step[pair][:, None])
    motion = replace(motion, after_one=factor, one_px=max(quantile_size(rest), before.least_px))
    three = np.flatnonzero(link[2:] & link[1:-1] & link[:-2])
    if len(three) < FEWEST:
        return motion
    last, change = step[three + 1], step[three + 1] - step[three]
    factors, rest = _predicted(step[three + 2], np.stack([last, change], axis=1))
    activity = (last**2).sum(axis=1) + (change**2).sum(axis=1)
    still, lively = activity <= np.quantile(activity, 0.25), activity >= np.median(activity)
    share = quantile_size(rest[lively] / np.maximum(activity[lively], 1e-12))
    return replace(
        motion,
        after_two=(factors[0], factors[1]),
        two_px=max(quantile_size(rest[still]), before.least_px),
        share=share,
    )


def _predicted(step: Array, by: Array) -> tuple[tuple[float, ...], Array]:
    """Return the factors of ``by`` (n, k, 2) that fit ``step`` (n, 2) best, robustly, and squared errors (n,)."""
    weight = np.ones(len(step))
    for _pass in range(5):
        normal = np.einsum("n,nia,nja->ij", weight, by, by)
        right = np.einsum("n,nia,na->i", weight, by, step)
        factor = np.linalg.lstsq(normal, right, rcond=None)[0]
        rest = ((step - np.einsum("i,nia->na", factor, by)) ** 2).sum(axis=1)
        weight = 1.0 / (1.0 + rest / max(2.0 * quantile_size(rest), 1e-6) ** 2)
    return tuple(factor.tolist()), rest


def quantile_size(squared: Array) -> float:
    """Return the standard deviation per axis of two-dimensional vectors with these squared lengths (n,)."""
    if not len(squared):
        return 0.0
    return float(np.sqrt(np.quantile(squared, SURE) / (-2.0 * np.log(1.0 - SURE))))
