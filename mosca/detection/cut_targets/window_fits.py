"""Fits of cut targets and of pairs in their windows, and which of them are taken: compiled.

A fit is taken where its misfit and amplitude are those of the camera's whole discs and another one, cut elsewhere, is
clearly worse. Where both are as good, the place at which a track expects the target decides.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rays import AREA_RADIUS
from mosca.detection.cut_targets.cut_pair import UNKNOWNS, WAYS, fit_cut_pairs
from mosca.detection.cut_targets.disc import (
    AMPLITUDE,
    BLUR,
    BY_RADIUS_X,
    BY_RADIUS_Y,
    CUT,
    LEAST_CUT,
    MISFIT,
    OTHER_MISFIT,
    OTHER_X,
    OTHER_Y,
    RADIUS,
    XX,
    XY,
    YY,
    fit_discs,
)
from mosca.detection.cut_targets.kinds import BESIDE, GROWN, WHOLE
from mosca.detection.cut_targets.kinds import CUT as CUT_ONE
from mosca.detection.cut_targets.pair import PAIR_AMPLITUDE, PAIR_COVARIANCE, PAIR_MISFIT, fit_pairs
from mosca.detection.cut_targets.windows import (
    BLUR_PX,
    LOG_LIGHT,
    MOST_LOG_LIGHT,
    OTHERS_BLURS,
    REACH_BLURS,
    SIZE,
    SIZE_SIGMA,
    USUAL_MISFIT,
    Windows,
    own_pixels,
)
from mosca.numba_support.decorators import bare_step, callable_bare_step, kernel, step
from mosca.numba_support.order import median_in_place

MOST_MISFIT, LEAST_MISFIT = 4.0, 4e-4
"""A cut disc is taken where its misfit is at most so many times that of whole discs, or (2 %)^2 of the amplitude."""
LEAST_LIGHT = 0.4
"""Share of a whole disc's light from which an image that is not mended is judged by its size; below, by its light."""
SURE, AMBIGUOUS, SAME_PX = 60.0, 12.0, 0.1
"""Chi-square by which a disc cut on the other side must fit worse: whatever a track expects, and with its track's
prediction counted in (odds of 400); none is needed where its centre is nearer than the third [px]."""
EXPECTED_SIGMAS = 4.0
"""Largest distance, in its standard deviations, of a track's prediction that agrees with a fit. An actor's rms is
0.279 mm with 2.5 and 4, 0.283 mm with 8."""
LEAST_APART = 0.2
"""Least distance of two targets' centres, over the radius: the same images are taken with 0.1."""
LEAST_APART_CUT = 1.0
"""Least distance where an edge cuts one of them: in closer pairs it often cuts their overlap, which is drawn roughly.
Of a walker's 914 images 813 are taken and 11 are more than 0.3 px off, with 0.5, 817 and 12, with 2, 700 and 6."""
EXPECTED_REACH = 2.5
"""Largest distance from an image of two, over the radius, at which they are expected: 0.269 mm in 3 s of a walker
with 1.25, 2.5, 5."""
FARTHEST = 1.5
"""Largest distance of centres from their light, over the radius. In 3 s of a walker 0.286 mm with 0.6 (and 0.75 for
pairs: 0.272), 0.269 with 1.2 to 3.0."""
TINY = 1e-12
"""Least misfit of a fit without noise."""
NO_FIT, ONE, TWO, DIMMED, LEARNED_ONE = range(5)
"""What was found: nothing, a centre, two centres, or the diameter alone; and a whole disc to learn from."""
STATE, FIRST, SECOND, FITTED = 0, 1, 7, 13
"""Columns of a fit: which of these states; x, y [px], covariance (xx, xy, yy) [px^2] and diameter [px] of the first
target and of the second. For a whole disc the fit's first LEARNED_FROM_FIT columns follow STATE."""
LEARNED_FROM_FIT = MISFIT + 1


class OfTracks(NamedTuple):
    """Where tracks expect their targets."""

    xyz: Array
    """(k, 3) [m]."""
    places: Array
    """(c, k, 2) their images [px], infinite where there is none."""
    errors: Array
    """(c, k) standard deviations of these [px]."""
    distances: Array
    """(c, k) from the cameras [m]."""
    reach_m: float
    """Largest distance of a prediction from a point of the same target [m]."""


class OfPoints(NamedTuple):
    """The points of a frame set."""

    xyz: Array
    """(n, 3) [m]."""
    rays: Array
    """(n, c) ``Points.rays``."""
    distances: Array
    """(n, c) from the cameras [m]."""


@kernel
def fit_windows(
    patches: Array,
    windows: Windows,
    learned: Array,
    table: tuple[Array, Array, Array],
    points: OfPoints,
    expected: OfTracks,
) -> Array:
    """Return the fits (n, FITTED) of ``windows``.

    ``patches`` (n, h, h) [DN]; ``learned`` (c, LEARNED); ``table``: ``rays``, ``start``, ``xy_px`` of a ``RayTable``.
    """
    rays, start, xy = table
    n, side, _ = patches.shape
    out, there, place = np.zeros((n, FITTED)), np.empty((1, side, side), np.bool_), np.empty(3)
    own, seen, last = np.empty(2, np.int64), np.empty((0, 3)), -1
    for r in range(n):
        c = windows.camera[r]
        corner, first = windows.corner[r], start[c]
        if r == 0 or c != windows.camera[last]:
            seen = np.empty((start[c + 1] - first, 3))
        for k in range(len(seen)):
            for a in range(2):
                seen[k, a] = xy[first + k, a] - corner[a]
            seen[k, 2] = rays[first + k, AREA_RADIUS]
        last = r
        own[0], own[1] = windows.rays[r, 0] - first, windows.rays[r, 1] - first
        place[0], place[1] = seen[own[0], 0], seen[own[0], 1]
        kind, radius, blur = windows.kind[r], windows.radius[r, 0], learned[c, BLUR_PX]
        patch = patches[r : r + 1]
        if kind in (WHOLE, CUT_ONE):
            place[2] = radius + REACH_BLURS * blur
            count = own_pixels(patch[0], there[0], place, own, seen, OTHERS_BLURS * blur if kind == CUT_ONE else -1.0)
            if kind == WHOLE:
                _whole(patch, there, place, radius, blur, out[r])
            else:
                _cut(patch, there, count, place, r, windows, learned[c], points, expected, out[r])
            continue
        if kind == GROWN:
            place[2] = 2.0 * radius + REACH_BLURS * blur
            own_pixels(patch[0], there[0], place, own, seen, OTHERS_BLURS * blur)
            taken, light, whole, radii = _grown(patch, there, place, r, windows, learned[c], points, expected, out[r])
            if taken:
                continue
        else:
            light, whole, radii = np.empty((2, 2)), 0.0, windows.radius[r].copy()
            for k in range(2):
                light[k, 0], light[k, 1] = seen[own[k], 0], seen[own[k], 1]
        if math.isfinite(light[0, 0]):
            pair = own, seen, light, whole, radii
            _cut_pair(patch, there, pair, r, windows, learned[c], points, expected, out[r])
        if kind == BESIDE and out[r, STATE] == NO_FIT:
            own[1], place[2] = own[0], radius + REACH_BLURS * blur
            own_pixels(patch[0], there[0], place, own, seen, OTHERS_BLURS * blur)
            _dimmed(patch, there, place, radius, windows.share[r], learned[c], out[r])
    return out


@bare_step
def _as_whole(learned, misfit, amplitude, limit):
    """Return whether a fit's misfit is below the limit and its amplitude is that of whole discs."""
    return (
        math.isfinite(misfit) and misfit < limit
        and abs(math.log(max(amplitude, 1e-9)) - learned[LOG_LIGHT]) < learned[MOST_LOG_LIGHT]
    )  # fmt: skip


@step
def _starting(place, radius, blur):
    """Return a disc (1, 8) to start a fit from."""
    start = np.zeros((1, 8))
    start[0, 0], start[0, 1], start[0, RADIUS], start[0, BLUR] = place[0], place[1], radius, blur
    return start


@step
def _whole(patch, there, place, radius, blur, out):
    """Fit a whole disc, to learn from it."""
    fit = fit_discs(patch, there, _starting(place, radius, blur), True, np.zeros(1))[0]
    for k in range(LEARNED_FROM_FIT):
        if not math.isfinite(fit[k]):
            return
        out[1 + k] = fit[k]
    out[STATE] = LEARNED_ONE


@callable_bare_step
def cut_of(hidden):
    """Return the distance, over the radius, of the edge that hides a share of a disc from its centre (by halving)."""
    low, high = -1.0, 1.0
    for _ in range(20):
        at = 0.5 * (low + high)
        if math.acos(at) - at * math.sqrt(1.0 - at * at) > hidden * math.pi:
            low = at
        else:
            high = at
    return 0.5 * (low + high)


@step
def _cut(patch, there, count, place, r, windows, learned, points, expected, out):
    """Fit a cut disc; where no fit is taken and the image is dim, estimate the hidden share from its light."""
    radius, share, corner = windows.radius[r, 0], windows.share[r], windows.corner[r]
    start = _starting(place, radius, learned[BLUR_PX])
    start[0, CUT] = radius * cut_of(min(max(1.0 - share, 0.05), 0.9))
    usual = np.full(1, learned[USUAL_MISFIT])
    fit = fit_discs(patch, there, start, False, usual)[0]
    good = _as_whole(learned, fit[MISFIT], fit[AMPLITUDE], max(MOST_MISFIT * learned[USUAL_MISFIT], LEAST_MISFIT))
    good &= fit[CUT] < radius and fit[CUT] > 0.99 * LEAST_CUT * radius
    if good:
        good = _told_apart(fit, count, corner, windows.point[r], windows.camera[r], points, expected)
    if good and math.hypot(fit[0] - place[0], fit[1] - place[1]) < FARTHEST * radius:
        by = learned[SIZE_SIGMA] * radius
        out[STATE], out[FIRST], out[FIRST + 1] = ONE, fit[0] + corner[0], fit[1] + corner[1]
        out[FIRST + 2] = fit[XX] + (by * fit[BY_RADIUS_X]) ** 2
        out[FIRST + 3] = fit[XY] + by * by * fit[BY_RADIUS_X] * fit[BY_RADIUS_Y]
        out[FIRST + 4] = fit[YY] + (by * fit[BY_RADIUS_Y]) ** 2
        out[FIRST + 5] = 2.0 * radius / learned[SIZE]
        return
    _dimmed(patch, there, place, radius, share, learned, out)


@step
def _dimmed(patch, there, place, radius, share, learned, out):
    """Write a diameter by the image's light where that is low: also below ``share``, the share by its area."""
    light = _share_of_light(patch[0], there[0], place, radius, learned)
    if light < min(share, LEAST_LIGHT):
        # the visible part of a disc looks larger than it is, because of its blur
        out[STATE], out[FIRST + 5] = DIMMED, 2.0 * radius * math.sqrt(max(light, TINY)) / learned[SIZE]


@step
def _share_of_light(patch, there, place, radius, learned):
    """Return an image's light over that of a whole disc in its pixels, above the background of those around them."""
    side, reach, many = len(patch), math.ceil(place[2]) + 1, 0
    around = np.empty(side * side)
    for i in range(side):
        for j in range(side):
            x, y = j - place[0], i - place[1]
            if max(abs(x), abs(y)) <= reach and x * x + y * y > reach * reach and not math.isnan(patch[i, j]):
                around[many] = patch[i, j]
                many += 1
    background, light, whole = median_in_place(around[:many]), 0.0, TINY
    for i in range(side):
        for j in range(side):
            if there[i, j]:
                light += patch[i, j] - background
                inward = radius - math.hypot(j - place[0], i - place[1])
                whole += 0.5 * math.erfc(-inward / (math.sqrt(2.0) * learned[BLUR_PX]))
    return light / (math.exp(learned[LOG_LIGHT]) * whole)


@bare_step
def _expected_at(point, c, points, expected):
    """Return where the track nearest to a point expects its image and the standard deviation [px], inf for none."""
    least, at = expected.reach_m * expected.reach_m, -1
    for j in range(len(expected.xyz)):
        away = 0.0
        for a in range(3):
            away += (points.xyz[point, a] - expected.xyz[j, a]) ** 2
        if away < least:
            least, at = away, j
    if at < 0 or not math.isfinite(expected.places[c, at, 0]):
        return 0.0, 0.0, np.inf
    return expected.places[c, at, 0], expected.places[c, at, 1], expected.errors[c, at]


@step
def _told_apart(fit, count, corner, point, c, points, expected):
    """Return whether a cut disc is distinct from that cut on the other side; take the latter where it is likelier.

    A sliver of a disc looks the same from either side, its covariance too. The place where its track expects it
    decides.
    """
    worse = (count - 6) * (fit[OTHER_MISFIT] / max(fit[MISFIT], TINY) - 1.0)
    if worse > SURE or math.hypot(fit[0] - fit[OTHER_X], fit[1] - fit[OTHER_Y]) < SAME_PX:
        return True
    x, y, sigma = _expected_at(point, c, points, expected)
    x, y = x - corner[0], y - corner[1]
    own, other = (fit[0] - x) ** 2 + (fit[1] - y) ** 2, (fit[OTHER_X] - x) ** 2 + (fit[OTHER_Y] - y) ** 2
    if min(own, other) < (EXPECTED_SIGMAS * sigma) ** 2:
        worse += (other - own) / (sigma * sigma)
    if worse < -AMBIGUOUS:
        fit[0], fit[1] = fit[OTHER_X], fit[OTHER_Y]
    return abs(worse) > AMBIGUOUS


@step
def _grown(patch, there, place, r, windows, learned, points, expected, out):
    """Fit two whole discs; return whether they are taken, and the pair to be tried with one of them cut otherwise.

    The pair is given by positions (2, 2), NaN for no fit; 1 where these are whole discs' centres as tracks expect
    them; and both radii.
    """
    radius, c, corner = windows.radius[r, 0], windows.camera[r], windows.corner[r]
    usual = np.full(1, learned[USUAL_MISFIT])
    fit = fit_pairs(patch, there, _starting(place, radius, learned[BLUR_PX]), usual)[0]
    light, radii = np.empty((2, 2)), np.full(2, radius)
    if not math.isfinite(fit[PAIR_MISFIT]):
        light[0, 0] = np.nan
        return False, light, 0.0, radii
    for k in range(2):
        light[k, 0], light[k, 1] = fit[2 * k], fit[2 * k + 1]
    limit = max(MOST_MISFIT * learned[USUAL_MISFIT], LEAST_MISFIT)
    apart = math.hypot(fit[0] - fit[2], fit[1] - fit[3])
    good = _as_whole(learned, fit[PAIR_MISFIT], fit[PAIR_AMPLITUDE], limit) and apart > LEAST_APART * radius
    if good and _as_expected(fit, corner, c, FARTHEST * radius, expected):
        _write_two(fit, corner, radii, learned, out)
        return True, light, 0.0, radii
    two, away = np.full(2, -1), np.full(2, np.inf)
    for j in range(len(expected.xyz)):
        x, y = expected.places[c, j, 0] - corner[0] - place[0], expected.places[c, j, 1] - corner[1] - place[1]
        far = math.hypot(x, y)
        if far < away[0]:
            two[1], away[1], two[0], away[0] = two[0], away[0], j, far
        elif far < away[1]:
            two[1], away[1] = j, far
    if not away[1] < EXPECTED_REACH * radius:
        return False, light, 0.0, radii
    for k in range(2):
        for a in range(2):
            light[k, a] = expected.places[c, two[k], a] - corner[a]
        radii[k] = radius * points.distances[windows.point[r], c] / expected.distances[c, two[k]]
    return False, light, 1.0, radii


@step
def _as_expected(fit, corner, c, reach, expected):
    """Return whether each track that expects its image within ``reach`` of one of two centres agrees with it."""
    for j in range(len(expected.xyz)):
        x, y, away = expected.places[c, j, 0] - corner[0], expected.places[c, j, 1] - corner[1], np.inf
        for k in range(2):
            away = min(away, math.hypot(fit[2 * k] - x, fit[2 * k + 1] - y))
        if EXPECTED_SIGMAS * expected.errors[c, j] < away < reach:
            return False
    return True


@step
def _write_two(fit, corner, radii, learned, out):
    """Write a pair's fit."""
    out[STATE] = TWO
    for k in range(2):
        at, m, by = FIRST if k == 0 else SECOND, PAIR_COVARIANCE + 3 * k, learned[SIZE_SIGMA] * radii[k]
        out[at], out[at + 1] = fit[2 * k] + corner[0], fit[2 * k + 1] + corner[1]
        out[at + 2], out[at + 3], out[at + 4] = fit[m] + by * by, fit[m + 1], fit[m + 2] + by * by
        out[at + 5] = 2.0 * radii[k] / learned[SIZE]


@step
def _cut_pair(patch, there, pair, r, windows, learned, points, expected, out):
    """Fit a pair with one disc cut; which one is, and on which side, is decided as for one disc."""
    own, seen, light, whole, radii = pair
    place, blur = np.empty(3), learned[BLUR_PX]
    apart = math.hypot(light[0, 0] - light[1, 0], light[0, 1] - light[1, 1])
    place[0], place[1] = 0.5 * (light[0, 0] + light[1, 0]), 0.5 * (light[0, 1] + light[1, 1])
    place[2] = 0.5 * apart + max(radii[0], radii[1]) + REACH_BLURS * blur
    count = own_pixels(patch[0], there[0], place, own, seen, OTHERS_BLURS * blur)
    given = np.array([[light[0, 0], light[0, 1], light[1, 0], light[1, 1], radii[0], radii[1], blur, 1.0 - whole]])
    ways = fit_cut_pairs(patch, there, given, np.full(1, learned[USUAL_MISFIT]))[0]
    best = _best_way(ways, count, own, r, windows, points, expected)
    if best < 0:
        return
    fit, far = ways[best], 0.0
    for k in range(2):
        far = max(far, math.hypot(fit[2 * k] - light[k, 0], fit[2 * k + 1] - light[k, 1]) / radii[k])
    apart = math.hypot(fit[0] - fit[2], fit[1] - fit[3])
    # no least misfit: eight unknowns fit much that is no pair
    good = _as_whole(learned, fit[PAIR_MISFIT], fit[PAIR_AMPLITUDE], MOST_MISFIT * learned[USUAL_MISFIT])
    if good and apart > LEAST_APART_CUT * 0.5 * (radii[0] + radii[1]) and far < FARTHEST:
        _write_two(fit, windows.corner[r], radii, learned, out)


@step
def _best_way(ways, count, own, r, windows, points, expected):
    """Return which fit (WAYS, PAIR_RESULT) of a pair is best, -1 where that is undecided.

    They are compared by misfit and by the distances of centres from where tracks expect them. Another way whose
    centres differ must be clearly worse.
    """
    c, corner, score, least = windows.camera[r], windows.corner[r], np.zeros(WAYS), np.inf
    for k in range(WAYS):
        least = min(least, ways[k, PAIR_MISFIT])
    if not least < np.inf:
        return -1
    for k in range(WAYS):
        score[k] = (count - UNKNOWNS) * (ways[k, PAIR_MISFIT] / max(least, TINY) - 1.0)
    for i in range(len(points.rays)):
        if points.rays[i, c] != own[0] and points.rays[i, c] != own[1]:
            continue
        x, y, sigma = _expected_at(i, c, points, expected)
        if not math.isfinite(sigma):
            continue
        for k in range(WAYS):
            away = np.inf
            for disc in range(2):
                dx, dy = ways[k, 2 * disc] + corner[0] - x, ways[k, 2 * disc + 1] + corner[1] - y
                away = min(away, dx * dx + dy * dy)
            score[k] += min(away / (sigma * sigma), SURE - AMBIGUOUS)
    best = int(np.argmin(score))
    for k in range(WAYS):
        apart = 0.0
        for disc in range(2):
            dx, dy = ways[k, 2 * disc] - ways[best, 2 * disc], ways[k, 2 * disc + 1] - ways[best, 2 * disc + 1]
            apart = max(apart, math.hypot(dx, dy))
        if apart > SAME_PX and not score[k] > score[best] + AMBIGUOUS:
            return -1
    return best
