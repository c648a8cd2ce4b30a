"""Places of a chessboard's corners: a model of the image is fitted to the pixels nearer to each than to the others.

``mosca.coded_targets.corner_image`` states the model. All corners of an image are fitted side by side, by least
squares (Levenberg and Marquardt), in two rounds. What they have in common is learned from the first round. The noise
of black and of white pixels, and of those at edges, where the model is incomplete, is estimated from the residuals.
Blur and slopes of the light are estimated as means and spreads (method of moments; DerSimonian and Laird 1986), the
second round's priors. The covariance is that of the fit. Where residuals exceed those of the image's other corners by
more than chance, it is multiplied by as much.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.coded_targets.board_view import BoardView
from mosca.coded_targets.corner_image import (
    BLUR_1,
    BLUR_2,
    CONTRAST,
    LEAST_VARIANCE,
    MARKERS,
    MEAN,
    PLACE,
    REACH,
    SLOPE_X,
    SLOPE_Y,
    TURN_2,
    UNKNOWNS,
    PatternNoise,
    corner_sums,
)
from mosca.data.arrays import Array, looked_at
from mosca.data.boards import Board
from mosca.detection.local_background import ROUNDING_DN2

LARGEST_REACH_PX = 16.0
"""Half the window's longer side, at most: longer edges would bend by more than a parabola."""
SHARED = [BLUR_1, BLUR_2, SLOPE_X, SLOPE_Y]
FIRST_MEANS, FIRST_SPREADS = (0.5, 0.5, 0.0, 0.0), (2.0, 2.0, 0.3, 0.3)
"""Mean and standard deviation, before the image is known, of what corners of an image have in common [px^2,
share]."""
LEAST_SPREAD = 1e-6
"""Least variance of what is shared, over that of the first round's prior."""
STEPS_MOST, CLOSE_PX, SLACK, MOST_DAMPING = 25, 3e-4, 1e-4, 1e6
"""Steps at most, length of the last one, share by which chi-square may rise, since the pixels' weights change with
the pattern, and the damping at which no step helps any more."""
FARTHEST = np.array([0.7, 0.7, 0.2, 0.2, 1.0, 1.0, np.inf, np.inf, 0.3, 0.3])
"""Longest step, in the order of the unknowns: a blurred edge's width."""
MOST_VARIANCE, TINY, HELD = 25.0, 1e-12, 1e12
"""Largest variance of a blur [px^2]; what keeps divisors above 0; information on unknowns that are held."""
DIRTY = 4.0
"""Ratio of a corner's squared residuals to the median of an image's corners from which it is left out of the
noise."""
WORST_PX = 1.0
"""Standard deviation of a corner that the pixels do not determine."""
NONE = np.zeros((0, UNKNOWNS, UNKNOWNS))
MANY_SIGMA = 3.0
"""Standard deviations of chi-square from which it is taken for more than chance."""


def places_of(board: Board, view: BoardView, corner: Array, xy: Array) -> Array:
    """Return the surroundings (n, PLACE) of corners ``corner`` (n,) of a board in ``view``, at ``xy`` (n, 2) [px]."""
    plane, half = board.corners()[corner, :2], 0.5 * board.square_m
    middle = view.image(plane)
    out = np.zeros((len(xy), PLACE))
    out[:, :2] = xy
    sides = []
    for axis in (0, 1):
        by = half * np.eye(2)[axis]
        before, after = view.image(plane - by), view.image(plane + by)
        along = after - before
        length = np.linalg.norm(along, axis=1)
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / length[:, None]
        out[:, 2 + axis] = np.arctan2(along[:, 1], along[:, 0])
        out[:, 6 + axis] = np.sum(normal * (0.5 * (before + after) - middle), axis=1) / (0.5 * length) ** 2
        sides.append((along, normal))
    for axis in (0, 1):
        out[:, 4 + axis] = np.abs(np.sum(sides[1 - axis][0] * sides[axis][1], axis=1))
    longest = (np.abs(sides[0][0]) + np.abs(sides[1][0])).max(axis=1)
    out[:, REACH] = np.minimum(0.5 * longest, LARGEST_REACH_PX)
    if board.marker_m is not None:
        gap = 0.5 * (board.square_m - board.marker_m)
        # the part of a marker's edge beside the corner's half of the line
        beside = 0.5 * (gap + half)
        for quarter, (down, right) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
            for axis, away in enumerate(((right * beside, -down * gap), (right * gap, -down * beside))):
                r = view.image(plane + away) - middle
                along, normal = sides[axis]
                t = np.sum(r * along, axis=1) / np.linalg.norm(along, axis=1)
                d = np.sum(r * normal, axis=1) - out[:, 6 + axis] * t**2
                out[:, MARKERS + 2 * quarter + axis] = np.abs(d)
    out[~np.isfinite(out).all(axis=1)] = 0.0  # beyond what the view maps: no pixel is looked at
    return out


def fitted_corners(
    image: Array, places: Array, markers: tuple[float, float], full_dn: float, noise_dn: float
) -> tuple[Array, Array]:
    """Return positions (n, 2) [px] and covariances (n, 2, 2) [px^2] of corners in surroundings ``places`` (n, PLACE).

    NaN where the pixels show no corner.

    ``image`` (H, W) [DN]; ``markers``: see ``corner_sums``; pixels from ``full_dn`` on are saturated; ``noise_dn``: a
    first guess of the noise.
    """
    look = _Look(looked_at(np.ascontiguousarray(image)), places, markers, full_dn)
    unknowns, noise = _start(look), PatternNoise(noise_dn**2, 0.0, 0.0, ROUNDING_DN2)
    prior = np.array([FIRST_MEANS, np.square(FIRST_SPREADS)])
    unknowns = _fit(look, unknowns, noise, prior)
    equations = _covariances(look, unknowns, noise, prior)[-1]
    noise = _noise(equations, noise)
    normal, *_ = look.sums(unknowns, noise, np.arange(len(unknowns)))
    prior = _shared(unknowns, _inverse(normal, prior), prior)
    unknowns = _fit(look, unknowns, noise, prior)
    normal, covariance, misfit, _ = _covariances(look, unknowns, noise, prior)
    covariance = covariance[:, :2, :2] * misfit[:, None, None]
    variance, information = np.einsum("nii->ni", covariance), np.einsum("nii->ni", normal)[:, :2]
    is_one = np.maximum(variance, 1 / (information + TINY)).max(axis=1) < WORST_PX**2
    return np.where(is_one[:, None], unknowns[:, :2], np.nan), covariance


class _Look(NamedTuple):
    """Inputs of a fit, see ``fitted_corners``."""

    image: Array
    places: Array
    markers: tuple[float, float]
    full_dn: float

    def sums(self, unknowns: Array, noise: PatternNoise, which: Array, fitted: Array = NONE) -> Any:
        """Return ``corner_sums`` of the corners ``which``."""
        return corner_sums(self.image, unknowns[which], self.places[which], self.markers, noise, self.full_dn, fitted)


def _start(look: _Look) -> Array:
    """Return unknowns (n, UNKNOWNS) to begin with: the light of a pattern at the place in the view."""
    out = np.zeros((len(look.places), UNKNOWNS))
    out[:, : TURN_2 + 1] = look.places[:, : TURN_2 + 1]
    out[:, [BLUR_1, BLUR_2]] = FIRST_MEANS[0]
    out[:, CONTRAST] = 1.0
    normal, right, *_ = look.sums(out, PatternNoise(1.0, 0.0, 0.0, 1.0), np.arange(len(out)))
    light = normal[:, MEAN : CONTRAST + 1, MEAN : CONTRAST + 1] + 1e-9 * np.eye(2)
    out[:, MEAN : CONTRAST + 1] += np.linalg.solve(light, right[:, MEAN : CONTRAST + 1, None])[..., 0]
    return out


def _fit(look: _Look, unknowns: Array, noise: PatternNoise, prior: Array) -> Array:
    """Return the unknowns (n, UNKNOWNS) after Levenberg's and Marquardt's steps with priors (2, 4) of ``SHARED``."""
    unknowns = unknowns.copy()
    busy, damping = np.arange(len(unknowns)), np.full(len(unknowns), 1e-3)

    def cost_of(values: Array, chi2: Array) -> Array:
        return np.asarray(chi2 + np.sum((values[:, SHARED] - prior[0]) ** 2 / prior[1], axis=1))

    normal, right, chi2, *_ = look.sums(unknowns, noise, busy)
    cost = cost_of(unknowns, chi2)
    for _ in range(STEPS_MOST):
        here, moved = unknowns[busy], unknowns.copy()
        trial = moved[busy] = _stepped(here, normal, right, damping[busy], prior)
        new_normal, new_right, chi2, *_ = look.sums(moved, noise, busy)
        now = cost_of(trial, chi2)
        better = now <= cost * (1 + SLACK)
        unknowns[busy[better]] = trial[better]
        normal[better], right[better], cost = new_normal[better], new_right[better], np.where(better, now, cost)
        damping[busy] *= np.where(better, 0.2, 10.0)
        ended = better & (np.abs(trial - here)[:, :2].max(axis=1) < CLOSE_PX) | (damping[busy] > MOST_DAMPING)
        normal, right, cost, busy = normal[~ended], right[~ended], cost[~ended], busy[~ended]
        if not len(busy):
            break
    return unknowns


def _stepped(here: Array, normal: Array, right: Array, damping: Array, prior: Array) -> Array:
    """Return the unknowns (n, UNKNOWNS) after one damped step."""
    right = right.copy()
    right[:, SHARED] -= (here[:, SHARED] - prior[0]) / prior[1]
    scaled, scale = _scaled(normal, prior)
    scaled = scaled + damping[:, None, None] * np.eye(UNKNOWNS)
    step = scale * np.linalg.solve(scaled, (right * scale)[..., None])[..., 0]
    out = here + np.clip(step, -FARTHEST, FARTHEST)
    blurs = [BLUR_1, BLUR_2]
    out[:, blurs] = np.clip(out[:, blurs], np.maximum(here[:, blurs] / 4, LEAST_VARIANCE), MOST_VARIANCE)
    return np.asarray(out)


def _scaled(normal: Array, prior: Array) -> tuple[Array, Array]:
    """Return the normal equations (n, UNKNOWNS, UNKNOWNS) with the prior, scaled, and the scale (n, UNKNOWNS)."""
    system = normal.copy()
    system[:, SHARED, SHARED] += 1 / prior[1]
    scale = 1 / np.sqrt(np.einsum("nii->ni", system) + TINY)
    return system * scale[:, :, None] * scale[:, None, :], scale


def _inverse(normal: Array, prior: Array) -> Array:
    """Return covariances (n, UNKNOWNS, UNKNOWNS); 0 for unknowns that the pixels do not determine."""
    scaled, scale = _scaled(normal, prior)
    return np.asarray(np.linalg.pinv(scaled, hermitian=True) * scale[:, :, None] * scale[:, None, :])


def _covariances(
    look: _Look, unknowns: Array, noise: PatternNoise, prior: Array
) -> tuple[Array, Array, Array, Array]:
    """Return normal equations and covariances, both (n, UNKNOWNS, UNKNOWNS).

    Also return by how much residuals exceed the latter (n,), and the equations of ``_noise``.
    """
    every = np.arange(len(unknowns))
    normal, *_ = look.sums(unknowns, noise, every)
    held = normal.copy()
    for index in (BLUR_1, BLUR_2):
        # the blur of an edge that is as sharp as can be is held, and takes up no noise
        held[:, index, index] += np.where(unknowns[:, index] <= LEAST_VARIANCE, HELD, 0.0)
    covariance = _inverse(held, prior)
    _, _, chi2, pixels, seen = look.sums(unknowns, noise, every, covariance)
    freedom = np.maximum(pixels - np.einsum("nij,nij->n", covariance, normal), 1.0)
    ratio = chi2 / freedom
    # dirt on a corner must not count as the noise of others
    usual = ratio <= DIRTY * np.median(ratio)
    return (
        normal,
        covariance,
        np.where(ratio > 1 + MANY_SIGMA * np.sqrt(2 / freedom), ratio, 1.0),
        seen[usual].sum(axis=0),
    )


def _noise(seen: Array, before: PatternNoise) -> PatternNoise:
    """Return the noise from its equations (3, 4)."""
    level, slope, edge = np.linalg.lstsq(seen[:, :3], seen[:, 3])[0]
    if edge < 0:
        (level, slope), edge = np.linalg.lstsq(seen[:2, :2], seen[:2, 3])[0], 0.0
    level = max(level, ROUNDING_DN2)
    most = level - ROUNDING_DN2
    return before._replace(level=level, slope=float(np.clip(slope, -most, most)), edge=edge)


def _shared(unknowns: Array, covariance: Array, prior: Array) -> Array:
    """Return means and variances (2, 4) of what corners have in common (DerSimonian and Laird)."""
    out = prior.copy()
    for k, index in enumerate(SHARED):
        own, values = covariance[:, index, index], unknowns[:, index]
        w = np.maximum(1 / np.maximum(own, TINY) - 1 / prior[1, k], TINY)
        own = 1 / w
        mean = np.sum(w * values) / np.sum(w)
        excess = np.sum(w * (values - mean) ** 2) - (len(w) - 1)
        spread = max(excess / (np.sum(w) - np.sum(w**2) / np.sum(w)), 0.0)
        w = 1 / (own + spread)
        out[:, k] = np.sum(w * values) / np.sum(w), min(max(spread, LEAST_SPREAD * prior[1, k]), prior[1, k])
    return out
