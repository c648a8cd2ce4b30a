"""Places of a chessboard's corners: a model of their image fitted to all pixels that are nearer to each than to others.

``mosca.coded_targets.corner_image`` states the model. Least squares by Levenberg and Marquardt, all corners of an
image side by side, in two rounds. What the corners of an image have in common is learned from the first one: the noise
of black and white pixels and of those at edges, where the model lacks something, from the residuals; blur and slopes
of the light, as means and spreads (method of moments; DerSimonian and Laird 1986), which are the second round's priors.
The covariance is that of the fit; a corner whose residuals are larger than the image's others' by more than chance has
it multiplied by as much.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.coded_targets.board_view import BoardView
from mosca.coded_targets.corner_image import (
    BLUR_1,
    BLUR_2,
    CONTRAST,
    LEAST_VARIANCE,
    MEAN,
    SLOPE_X,
    SLOPE_Y,
    TURN_1,
    TURN_2,
    UNKNOWNS,
    MARKERS,
    PLACE,
    Noise,
    corner_sums,
)
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.detection.local_background import ROUNDING_DN2

LARGEST_REACH_PX = 16.0
"""Half the window's longer side, at most."""
SHARED = [BLUR_1, BLUR_2, SLOPE_X, SLOPE_Y]
FIRST_MEANS, FIRST_SPREADS = (0.5, 0.5, 0.0, 0.0), (2.0, 2.0, 0.3, 0.3)
"""What corners of an image have in common, and its mean and standard deviation before the image is known [px^2, share]."""
LEAST_SPREAD = 1e-6
STEPS_MOST, CLOSE_PX, SLACK, MOST_DAMPING = 25, 3e-4, 1e-4, 1e6
FARTHEST = np.array([0.7, 0.7, 0.2, 0.2, 1.0, 1.0, np.inf, np.inf, 0.3, 0.3])
MOST_VARIANCE, TINY = 25.0, 1e-12
NONE = np.zeros((0, UNKNOWNS, UNKNOWNS))
MANY_SIGMA = 3.0
"""Standard deviations of chi-square from which it is taken for more than chance."""


def places_of(board: Board, view: BoardView, corner: Array, xy: Array) -> Array:
    """Return the surroundings (n, PLACE) of corners ``corner`` (n,) of a board seen in ``view`` at ``xy`` (n, 2) [px]."""
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
    longest = np.max([np.abs(sides[0][0]) + np.abs(sides[1][0]), np.abs(sides[0][0]) + np.abs(sides[1][0])], axis=(0, 2))
    out[:, 8] = np.minimum(0.5 * longest, LARGEST_REACH_PX)
    if board.marker_m is not None:
        gap = 0.5 * (board.square_m - board.marker_m)
        # of a marker's edge the part beside the corner's half of the line
        beside = 0.5 * (gap + half)
        for quarter, (down, right) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
            for axis, away in enumerate(((right * beside, -down * gap), (right * gap, -down * beside))):
                r = view.image(plane + away) - middle
                along, normal = sides[axis]
                t = np.sum(r * along, axis=1) / np.linalg.norm(along, axis=1)
                d = np.sum(r * normal, axis=1) - out[:, 6 + axis] * t**2
                out[:, MARKERS + 2 * quarter + axis] = np.abs(d)
    return out


def fitted_corners(
    image: Array, places: Array, markers: tuple[float, float], full_dn: float, noise_dn: float
) -> tuple[Array, Array]:
    """Return places (n, 2) [px] and covariances (n, 2, 2) [px^2] of corners about ``places``; NaN where there is none.

    ``image`` (H, W) [DN]; pixels from ``full_dn`` on are saturated; ``noise_dn``: a first guess.
    """
    look = _Look(image, places, markers, full_dn)
    unknowns, noise = _start(look), Noise(noise_dn**2, 0.0, 0.0, ROUNDING_DN2)
    prior = np.array([FIRST_MEANS, np.square(FIRST_SPREADS)])
    unknowns = _fit(look, unknowns, noise, prior)
    inverse, _, seen = _solved(look, unknowns, noise, prior)
    noise = _noise(seen, noise)
    inverse, _, _ = _solved(look, unknowns, noise, prior)
    prior = _shared(unknowns, inverse, prior)
    unknowns = _fit(look, unknowns, noise, prior)
    inverse, misfit, _ = _solved(look, unknowns, noise, prior)
    return unknowns[:, :2], inverse[:, :2, :2] * misfit[:, None, None]


class _Look(NamedTuple):
    """What is looked at, see ``fitted_corners``."""

    image: Array
    places: Array
    markers: tuple[float, float]
    full_dn: float

    def sums(self, unknowns: Array, noise: Noise, which: Array, fitted: Array = NONE) -> Any:
        """Return ``corner_sums`` of the corners ``which``."""
        return corner_sums(
            self.image, unknowns[which], self.places[which], self.markers, noise, self.full_dn, fitted
        )


def _start(look: _Look) -> Array:
    """Return unknowns (n, UNKNOWNS) to begin with: the light of a pattern where the view has it."""
    out = np.zeros((len(look.places), UNKNOWNS))
    out[:, : TURN_2 + 1] = look.places[:, : TURN_2 + 1]
    out[:, [BLUR_1, BLUR_2]] = FIRST_MEANS[0]
    out[:, CONTRAST] = 1.0
    normal, right, *_ = look.sums(out, Noise(1.0, 0.0, 0.0, 1.0), np.arange(len(out)))
    light = normal[:, MEAN : CONTRAST + 1, MEAN : CONTRAST + 1] + 1e-9 * np.eye(2)
    out[:, MEAN : CONTRAST + 1] += np.linalg.solve(light, right[:, MEAN : CONTRAST + 1, None])[..., 0]
    return out


def _fit(look: _Look, unknowns: Array, noise: Noise, prior: Array) -> Array:
    """Return the unknowns (n, UNKNOWNS) after Levenberg's and Marquardt's steps with priors (2, 4) of ``SHARED``."""
    unknowns = unknowns.copy()
    weight, damping = np.zeros(UNKNOWNS), np.full(len(unknowns), 1e-3)
    weight[SHARED] = 1 / prior[1]
    busy = np.arange(len(unknowns))

    def cost_of(values: Array, chi2: Array) -> Array:
        return chi2 + np.sum((values[:, SHARED] - prior[0]) ** 2 / prior[1], axis=1)

    normal, right, chi2, *_ = look.sums(unknowns, noise, busy)
    cost = cost_of(unknowns, chi2)
    for _ in range(STEPS_MOST):
        here = unknowns[busy]
        held = right.copy()
        held[:, SHARED] -= (here[:, SHARED] - prior[0]) / prior[1]
        system = normal + np.diag(weight)
        size = np.einsum("nii->ni", system) + TINY
        system = system + np.einsum("ni,ij->nij", damping[busy, None] * size, np.eye(UNKNOWNS))
        scale = 1 / np.sqrt(size)
        scaled = system * scale[:, :, None] * scale[:, None, :]
        step = scale * np.linalg.solve(scaled, (held * scale)[..., None])[..., 0]
        trial = here + np.clip(step, -FARTHEST, FARTHEST)
        trial[:, [BLUR_1, BLUR_2]] = np.clip(
            trial[:, [BLUR_1, BLUR_2]], np.maximum(here[:, [BLUR_1, BLUR_2]] / 4, LEAST_VARIANCE), MOST_VARIANCE
        )
        moved = unknowns.copy()
        moved[busy] = trial
        n1, r1, chi2, *_ = look.sums(moved, noise, busy)
        now = cost_of(trial, chi2)
        better = now <= cost * (1 + SLACK)
        unknowns[busy[better]] = trial[better]
        normal[better], right[better], cost = n1[better], r1[better], np.where(better, now, cost)
        damping[busy] *= np.where(better, 0.2, 10.0)
        ended = better & (np.abs(trial - here)[:, :2].max(axis=1) < CLOSE_PX) | (damping[busy] > MOST_DAMPING)
        normal, right, cost, busy = normal[~ended], right[~ended], cost[~ended], busy[~ended]
        if not len(busy):
            break
    return unknowns


def _solved(look: _Look, unknowns: Array, noise: Noise, prior: Array) -> tuple[Array, Array, Array]:
    """Return the covariance (n, UNKNOWNS, UNKNOWNS), by how much residuals exceed it (n,), and ``_noise``'s equations."""
    every = np.arange(len(unknowns))
    normal, *_ = look.sums(unknowns, noise, every)
    weight = np.zeros(UNKNOWNS)
    weight[SHARED] = 1 / prior[1]
    system = normal + np.diag(weight)
    scale = 1 / np.sqrt(np.einsum("nii->ni", system) + TINY)
    covariance = np.linalg.pinv(system * scale[:, :, None] * scale[:, None, :], hermitian=True)
    covariance = covariance * scale[:, :, None] * scale[:, None, :]
    _, _, chi2, pixels, seen = look.sums(unknowns, noise, every, covariance)
    freedom = np.maximum(pixels - UNKNOWNS, 1.0)
    ratio = chi2 / freedom
    misfit = np.where(ratio > 1 + MANY_SIGMA * np.sqrt(2 / freedom), ratio, 1.0)
    return covariance, misfit, seen


def _noise(seen: Array, before: Noise) -> Noise:
    """Return the noise by its equations (3, 4)."""
    level, slope, edge = np.linalg.solve(seen[:, :3], seen[:, 3])
    if edge < 0:
        level, slope = np.linalg.solve(seen[:2, :2], seen[:2, 3])
        edge = 0.0
    level = max(level, ROUNDING_DN2)
    most = level - ROUNDING_DN2
    return before._replace(level=level, slope=float(np.clip(slope, -most, most)), edge=edge)


def _shared(unknowns: Array, covariance: Array, prior: Array) -> Array:
    """Return means and variances (2, 4) of what corners have in common (DerSimonian and Laird)."""
    out = prior.copy()
    for k, index in enumerate(SHARED):
        own, values = covariance[:, index, index], unknowns[:, index]
        own = 1 / np.maximum(1 / own - 1 / prior[1, k], TINY)
        w = 1 / own
        mean = np.sum(w * values) / np.sum(w)
        excess = np.sum(w * (values - mean) ** 2) - (len(w) - 1)
        spread = max(excess / (np.sum(w) - np.sum(w**2) / np.sum(w)), 0.0)
        w = 1 / (own + spread)
        out[:, k] = np.sum(w * values) / np.sum(w), min(max(spread, LEAST_SPREAD * prior[1, k]), prior[1, k])
    return out
