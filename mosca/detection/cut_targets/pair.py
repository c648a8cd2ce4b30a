"""Two discs of one size whose images have grown together, and their fit: compiled.

Two bright discs cover the area that either of them covers. Their common chord divides this area into two cut discs,
so that the image is the sum of two images of ``mosca.detection.cut_targets.disc``. The radius must be known.
"""

import math

import numpy as np

from mosca.detection.cut_targets.disc import (
    AMPLITUDE,
    ANGLE,
    CENTRE_X,
    CENTRE_Y,
    CUT,
    FEWEST_PX,
    LARGEST_STEP,
    LEAST_GAIN,
    LEVEL,
    MOST_NODES,
    RADIUS,
    SETTLED_PX,
    STEPS,
    cut_image,
    gather,
    levels,
    normal_equations,
)
from mosca.detection.disc_fit.disc_image import f32
from mosca.numba_support.cholesky import solve
from mosca.numba_support.decorators import bare_step, step

TOUCHING_PX = 1e-6
"""Least distance of two centres from which a direction is computed."""
PAIR_MISFIT, PAIR_AMPLITUDE, PAIR_COVARIANCE, PAIR_RESULT = 4, 5, 6, 12
"""Columns of a pair's fit after both centres [px]: squared residuals a degree of freedom over the squared amplitude,
amplitude [DN], and (xx, xy, yy) of either centre [px^2]."""
TURNS, APART = 4, (1.5, 1.0, 0.5, 2.0)
"""Directions and distances, over the radius, at which two centres are tried."""


@bare_step
def _pair_image(pixels, pair, disc, image, other, nodes):
    """Fill the first row of ``image`` with the light of two discs of one size, one of which hides part of the other.

    Their common chord divides the area that they cover into two cut discs. The further rows of ``image`` and
    ``other`` are the derivatives of either. ``pair`` (4,): both centres; ``disc`` (8,): RADIUS and BLUR, the rest is
    overwritten.
    """
    dx, dy = pair[2] - pair[0], pair[3] - pair[1]
    disc[CUT] = min(0.5 * math.sqrt(dx * dx + dy * dy), disc[RADIUS])
    disc[ANGLE] = math.atan2(dy, dx)
    disc[CENTRE_X], disc[CENTRE_Y] = pair[2], pair[3]
    disc[ANGLE] += math.pi
    cut_image(pixels, disc, other, nodes)
    disc[ANGLE] -= math.pi
    disc[CENTRE_X], disc[CENTRE_Y] = pair[0], pair[1]
    cut_image(pixels, disc, image, nodes)
    for i in range(pixels.shape[1]):
        image[0, i] += other[0, i]


@bare_step
def _pair_columns(pixels, pair, amplitude, radius, image, other, by):
    """Fill ``by`` (6, n): derivatives by both centres, amplitude and background.

    A change of a centre moves its own disc, and turns and moves the chord that cuts both.
    """
    dx, dy = pair[2] - pair[0], pair[3] - pair[1]
    apart = max(math.sqrt(dx * dx + dy * dy), TOUCHING_PX)
    cosine, sine = dx / apart, dy / apart
    moves = 0.5 if 0.5 * apart < radius else 0.0
    for i in range(pixels.shape[1]):
        edge, turn = amplitude * moves * (image[3, i] + other[3, i]), amplitude * (image[4, i] + other[4, i]) / apart
        along_x, along_y = cosine * edge - sine * turn, sine * edge + cosine * turn
        by[0, i] = amplitude * (sine * image[2, i] - cosine * image[1, i]) - along_x
        by[1, i] = -amplitude * (sine * image[1, i] + cosine * image[2, i]) - along_y
        by[2, i] = amplitude * (cosine * other[1, i] - sine * other[2, i]) + along_x
        by[3, i] = amplitude * (sine * other[1, i] + cosine * other[2, i]) + along_y
        by[4, i], by[5, i] = image[0, i], 1.0


@bare_step
def _settle_pair(pixels, pair, disc, work):
    """Improve a pair by Levenberg-Marquardt steps; return its squared residuals."""
    image, other, image_then, other_then, nodes, by, normal, right, tried = work
    _pair_image(pixels, pair, disc, image, other, nodes)
    least, damping = levels(pixels, image, disc), 1e-3
    for _ in range(STEPS):
        _pair_columns(pixels, pair, disc[AMPLITUDE], disc[RADIUS], image, other, by)
        normal_equations(pixels, disc, image, by, damping, normal, right)
        if not solve(normal, right[:, :1], 6):
            break
        far = 0.0
        for k in range(4):
            far = max(far, abs(right[k, 0]))
        held = min(1.0, LARGEST_STEP * disc[RADIUS] / max(far, 1e-9))
        for k in range(4):
            tried[k] = pair[k] + held * right[k, 0]
        amplitude, level = disc[AMPLITUDE], disc[LEVEL]
        _pair_image(pixels, tried, disc, image_then, other_then, nodes)
        error = levels(pixels, image_then, disc)
        if not error <= least:
            disc[AMPLITUDE], disc[LEVEL] = amplitude, level
            damping *= 10.0
            if damping > 1e4:
                break
            continue
        gained = least - error
        least, damping = error, damping / 8.0
        for k in range(4):
            pair[k] = tried[k]
        for row in range(5):
            for i in range(pixels.shape[1]):
                image[row, i], other[row, i] = image_then[row, i], other_then[row, i]
        if held * far < SETTLED_PX or gained < LEAST_GAIN * least:
            break
    return least


@step
def fit_pairs(patches, there, discs, usual):
    """Fit two discs of one size to ``patches`` (n, h, w); return (n, PAIR_RESULT), inf where there is no fit.

    As ``fit_discs``: ``discs`` (n, 8) start with the centre of the light, RADIUS and BLUR. (They are copied by
    element: for a slice Numba also compiles the message of a shape that does not fit, a third of the time.)
    """
    n, h, w = patches.shape
    out = np.full((n, PAIR_RESULT), np.inf)
    pixels, disc, pair, at = np.empty((3, h * w), f32), np.empty(8), np.empty(4), np.empty(4)
    work = (
        np.empty((7, h * w), f32), np.empty((7, h * w), f32), np.empty((7, h * w), f32), np.empty((7, h * w), f32),
        np.empty((3, MOST_NODES), f32), np.empty((6, h * w), f32), np.empty((6, 6)), np.empty((6, 6)),
        np.empty(4),
    )  # fmt: skip
    image, other, _, _, nodes, by, normal, right, _ = work
    for r in range(n):
        count = gather(patches[r], there[r], pixels)
        if count < FEWEST_PX:
            continue
        seen = pixels[:, :count]
        for k in range(8):
            disc[k] = discs[r, k]
        least, best = np.inf, 0.0
        for t in range(TURNS + len(APART) - 1):
            # all directions at the first distance, then the best of them at the others
            turn, apart = (t * math.pi / TURNS, APART[0]) if t < TURNS else (best, APART[t - TURNS + 1])
            x, y = 0.5 * apart * disc[RADIUS] * math.cos(turn), 0.5 * apart * disc[RADIUS] * math.sin(turn)
            at[0], at[1] = discs[r, 0] - x, discs[r, 1] - y
            at[2], at[3] = discs[r, 0] + x, discs[r, 1] + y
            _pair_image(seen, at, disc, image, other, nodes)
            error = levels(seen, image, disc)
            if error < least:
                least, best = error, turn
                for k in range(4):
                    pair[k] = at[k]
        least = _settle_pair(seen, pair, disc, work)
        _pair_columns(seen, pair, disc[AMPLITUDE], disc[RADIUS], image, other, by)
        normal_equations(seen, disc, image, by, 0.0, normal, right)
        for a in range(6):
            for b in range(6):
                right[a, b] = 1.0 if a == b else 0.0
        if not solve(normal, right, 6):
            continue
        a2 = disc[AMPLITUDE] * disc[AMPLITUDE]
        misfit = least / max(count - 6, 1) / a2
        variance = max(misfit, usual[r]) * a2
        for k in range(4):
            out[r, k] = pair[k]
        out[r, PAIR_MISFIT], out[r, PAIR_AMPLITUDE] = misfit, disc[AMPLITUDE]
        for k in range(2):
            m = PAIR_COVARIANCE + 3 * k
            out[r, m], out[r, m + 1] = variance * right[2 * k, 2 * k], variance * right[2 * k, 2 * k + 1]
            out[r, m + 2] = variance * right[2 * k + 1, 2 * k + 1]
    return out
