"""Two discs beside or before one another, one of them cut by an edge, and their fit: compiled.

The light is that of the whole disc and of the cut one (``mosca.detection.cut_targets.disc``). Where they overlap, and
the edge does not hide the overlap, bright discs cover it once. Their common chord then divides both, so that the
light is that of the whole disc cut by the chord, plus that of the cut one less what the chord cuts off it. Radii must
be known.
"""

import math

import numpy as np

from mosca.detection.cut_targets.disc import (
    AMPLITUDE,
    ANGLE,
    BLUR,
    CENTRE_X,
    CENTRE_Y,
    CLEARLY_WORSE,
    CUT,
    FEWEST_PX,
    LARGEST_STEP,
    LEAST_CUT,
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
from mosca.detection.cut_targets.pair import PAIR_AMPLITUDE, PAIR_COVARIANCE, PAIR_MISFIT, PAIR_RESULT, TOUCHING_PX
from mosca.detection.disc_fit.disc_image import f32
from mosca.numba_support.cholesky import solve
from mosca.numba_support.decorators import bare_step, step

X1, Y1, X2, Y2, EDGE, TURN, RADIUS_1, RADIUS_2 = range(8)
"""Elements of a pair: centres [px], first of the whole disc; the second one's cut and its direction; radii [px]."""
UNKNOWNS, WAYS, TURNS, CLEAR, HOPELESS = 8, 8, 8, 2.0, 16.0
"""Numbers of unknowns of a fit (six of the pair, amplitude and background), of fits that are tried (either disc cut,
from the best direction and at right angles to it) and of directions; and misfit over that of whole discs with which a
fit that shows more than half of the disc ends the search: no other side comes near then. With 0, pairs take twice the
time, as many end wrong. And misfit of the better of the first two, either disc cut, from which no other way is tried:
of 250 pairs that are taken in 3 s of a walker and in 200 balls it is at most 7, of 20 in 200 balls without a fit 11
to 222."""
FIRST_CUT, MOST_CUT = 0.1, 0.95
"""Cut that is tried first, over the radius, and the largest one, which hides 1 %: at the rim no direction can be
estimated. Of 720 drawn pairs 41 end elsewhere, 37 of them with 0.2 of a disc seen. With 0.2 and -0.1, 0.4 and -0.2,
0.8 and -0.4 for the first, 31 to 40 do at half the speed; with 0.9 and 0.98 for the largest, as many do."""


@bare_step
def _draw(pixels, disc, radius, x, y, cut, turn, image, nodes):
    """Fill ``image`` (7, n) with that of a disc; ``disc`` (8,) gives BLUR, the rest is overwritten."""
    disc[RADIUS], disc[CENTRE_X], disc[CENTRE_Y], disc[CUT], disc[ANGLE] = radius, x, y, cut, turn
    cut_image(pixels, disc, image, nodes)


@bare_step
def _pair_image(pixels, pair, disc, images, nodes):
    """Draw a pair: its light is the first row of ``images[0]``; return the chord's direction, NaN where none counts.

    ``images`` (3, 7, n): those of the whole and the cut disc. Where a chord counts, the first is cut by the chord,
    and the third is what the chord cuts off the second disc.
    """
    dx, dy = pair[X2] - pair[X1], pair[Y2] - pair[Y1]
    apart = max(math.sqrt(dx * dx + dy * dy), TOUCHING_PX)
    first, second = pair[RADIUS_1], pair[RADIUS_2]
    _draw(pixels, disc, second, pair[X2], pair[Y2], pair[EDGE], pair[TURN], images[1], nodes)
    seen = -0.5 * (dx * math.cos(pair[TURN]) + dy * math.sin(pair[TURN])) < pair[EDGE]
    if not seen or apart >= first + second:
        _draw(pixels, disc, first, pair[X1], pair[Y1], first, 0.0, images[0], nodes)
        for i in range(pixels.shape[1]):
            images[0, 0, i] += images[1, 0, i]
        return np.nan
    chord, turn = 0.5 * (apart + (first * first - second * second) / apart), math.atan2(dy, dx)
    _draw(pixels, disc, first, pair[X1], pair[Y1], min(max(chord, -first), first), turn, images[0], nodes)
    _draw(pixels, disc, second, pair[X2], pair[Y2], min(max(chord - apart, -second), second), turn, images[2], nodes)
    for i in range(pixels.shape[1]):
        images[0, 0, i] += images[1, 0, i] - images[2, 0, i]
    return turn


@bare_step
def _columns(pixels, pair, a, turn, images, by):
    """Fill ``by`` (UNKNOWNS, n): derivatives by both centres, amplitude, background, cut and its direction.

    ``turn``: what ``_pair_image`` returned. A change of a centre also turns and moves the chord.
    """
    one, cut, off = images[0], images[1], images[2]
    cosine, sine = math.cos(pair[TURN]), math.sin(pair[TURN])
    for i in range(pixels.shape[1]):
        by[0, i], by[1, i] = -a * one[1, i], -a * one[2, i]
        by[2, i] = a * (sine * cut[2, i] - cosine * cut[1, i])
        by[3, i] = -a * (sine * cut[1, i] + cosine * cut[2, i])
        by[4, i], by[5, i] = one[0, i], 1.0
        by[6, i], by[7, i] = a * cut[3, i], a * cut[4, i]
    if math.isnan(turn):
        return
    cosine, sine = math.cos(turn), math.sin(turn)
    apart = max(math.hypot(pair[X2] - pair[X1], pair[Y2] - pair[Y1]), TOUCHING_PX)
    for i in range(pixels.shape[1]):
        edge, swing = a * 0.5 * (one[3, i] + off[3, i]), a * (one[4, i] - off[4, i]) / apart
        along_x, along_y = cosine * edge - sine * swing, sine * edge + cosine * swing
        by[0, i] = a * (sine * one[2, i] - cosine * one[1, i]) - along_x
        by[1, i] = -a * (sine * one[1, i] + cosine * one[2, i]) - along_y
        by[2, i] += a * (cosine * off[1, i] - sine * off[2, i]) + along_x
        by[3, i] += a * (sine * off[1, i] + cosine * off[2, i]) + along_y


@bare_step
def _moved(pair, change, out):
    """Write to ``out`` the pair after a step, within bounds; return how far it goes [px]."""
    far, radius = 0.0, pair[RADIUS_2]
    for k in range(4):
        far = max(far, abs(change[k, 0]))
    far = max(far, abs(change[6, 0]), abs(change[7, 0]) * radius)
    held = min(1.0, LARGEST_STEP * radius / max(far, TOUCHING_PX))
    for k in range(4):
        out[k] = pair[k] + held * change[k, 0]
    out[EDGE] = min(max(pair[EDGE] + held * change[6, 0], LEAST_CUT * radius), MOST_CUT * radius)
    out[TURN] = pair[TURN] + held * change[7, 0]
    out[RADIUS_1], out[RADIUS_2] = pair[RADIUS_1], pair[RADIUS_2]
    return held * far


@bare_step
def _settle(pixels, pair, disc, work):
    """Improve a pair by Levenberg-Marquardt steps; return its squared residuals, the last image being its own."""
    images, nodes, by, normal, right, tried = work
    turn = _pair_image(pixels, pair, disc, images, nodes)
    least, damping = levels(pixels, images[0], disc), 1e-3
    for _ in range(STEPS):
        _columns(pixels, pair, disc[AMPLITUDE], turn, images, by)
        normal_equations(pixels, disc, images[0], by, damping, normal, right)
        if not solve(normal, right[:, :1], UNKNOWNS):
            break
        far = _moved(pair, right, tried)
        turn = _pair_image(pixels, tried, disc, images, nodes)
        error = levels(pixels, images[0], disc)
        if error <= least:
            gained = least - error
            least, damping = error, damping / 8.0
            for k in range(8):
                pair[k] = tried[k]
            if far < SETTLED_PX or gained < LEAST_GAIN * least:
                break
            continue
        turn = _pair_image(pixels, pair, disc, images, nodes)
        levels(pixels, images[0], disc)
        damping *= 10.0
        if damping > 1e4:
            break
    return least


@bare_step
def _start(given, way, turn, pair):
    """Write a pair whose centres, or centroids of what is seen, are as ``given``; odd ways cut the first one."""
    whole, other = (2, 0) if way % 2 else (0, 2)
    pair[X1], pair[Y1], pair[RADIUS_1] = given[whole], given[whole + 1], given[4 + whole // 2]
    radius = given[4 + other // 2]
    half = math.acos(FIRST_CUT)
    sine, cosine = math.sin(half), math.cos(half)
    away = given[7] * 2.0 / 3.0 * radius * sine**3 / (math.pi - half + sine * cosine)
    pair[X2], pair[Y2] = given[other] + away * math.cos(turn), given[other + 1] + away * math.sin(turn)
    pair[EDGE], pair[TURN], pair[RADIUS_2] = FIRST_CUT * radius, turn, radius


@step
def _starts(pixels, given, disc, work, starts):
    """Fill ``starts`` (WAYS, 8) with the pairs to start from; return which disc is cut in the better ones.

    The area that both discs cover counts twice here.
    """
    images, nodes = work[0], work[1]
    errors, pair, least = np.empty(TURNS), np.empty(8), np.empty(2)
    for way in range(2):
        for k in range(TURNS):
            _start(given, way, 2.0 * math.pi * k / TURNS, pair)
            if k == 0:
                _draw(pixels, disc, pair[RADIUS_1], pair[X1], pair[Y1], pair[RADIUS_1], 0.0, images[2], nodes)
            _draw(pixels, disc, pair[RADIUS_2], pair[X2], pair[Y2], pair[EDGE], pair[TURN], images[0], nodes)
            for i in range(pixels.shape[1]):
                images[0, 0, i] += images[2, 0, i]
            errors[k] = levels(pixels, images[0], disc)
        best = int(np.argmin(errors))
        least[way] = errors[best]
        for k in range(WAYS // 2):
            at = (best + k * TURNS * 2 // WAYS) % TURNS
            _start(given, way, 2.0 * math.pi * at / TURNS, starts[2 * k + way])
    return 0 if least[0] <= least[1] else 1


@bare_step
def _write(pixels, pair, way, usual, disc, work, out):
    """Write a fit of the last image drawn to a row (PAIR_RESULT,), infinite where its equations have no solution."""
    images, nodes, by, normal, right, _ = work
    turn = _pair_image(pixels, pair, disc, images, nodes)
    error, a2 = levels(pixels, images[0], disc), disc[AMPLITUDE] * disc[AMPLITUDE]
    out[PAIR_MISFIT], out[PAIR_AMPLITUDE] = error / max(pixels.shape[1] - UNKNOWNS, 1) / a2, disc[AMPLITUDE]
    _columns(pixels, pair, disc[AMPLITUDE], turn, images, by)
    normal_equations(pixels, disc, images[0], by, 0.0, normal, right)
    for a in range(UNKNOWNS):
        for b in range(UNKNOWNS):
            right[a, b] = 1.0 if a == b else 0.0
    if not solve(normal, right, UNKNOWNS):
        out[PAIR_MISFIT] = np.inf
        return
    variance = max(out[PAIR_MISFIT], usual) * a2
    for disc_of in range(2):
        at, m = 2 * (1 - disc_of if way % 2 else disc_of), PAIR_COVARIANCE + 3 * disc_of
        out[2 * disc_of], out[2 * disc_of + 1] = pair[at], pair[at + 1]
        out[m], out[m + 1] = variance * right[at, at], variance * right[at, at + 1]
        out[m + 2] = variance * right[at + 1, at + 1]


@step
def fit_cut_pairs(patches, there, given, usual):
    """Fit a whole and a cut disc to ``patches`` (n, h, w); return (n, WAYS, PAIR_RESULT), inf where there is no fit.

    ``there`` (n, h, w): pixels that count; ``given`` (n, 8): positions of both discs from the patch's first pixel,
    both radii and the blur [px], and 1 where these are positions of the light, 0 where of the whole discs; ``usual``
    (n,): misfit of the camera's whole discs. Columns are those of ``mosca.detection.cut_targets.pair.fit_pairs``,
    with centres in the order given; even ways cut the second disc, odd ones the first.
    """
    n, h, w = patches.shape
    out = np.full((n, WAYS, PAIR_RESULT), np.inf)
    pixels, disc, starts = np.empty((3, h * w), f32), np.empty(8), np.empty((WAYS, 8))
    work = (
        np.zeros((3, 7, h * w), f32), np.empty((3, MOST_NODES), f32), np.empty((UNKNOWNS, h * w), f32),
        np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(8),
    )  # fmt: skip
    misfit = np.empty(2)
    for r in range(n):
        count = gather(patches[r], there[r], pixels)
        if count < FEWEST_PX:
            continue
        seen, worse = pixels[:, :count], 1.0 + CLEARLY_WORSE / max(count - UNKNOWNS, 1)
        disc[BLUR], disc[AMPLITUDE], disc[LEVEL] = given[r, 6], 0.0, 0.0
        first = _starts(seen, given[r], disc, work, starts)
        misfit[0] = misfit[1] = np.inf
        for k in range(WAYS):
            way = (k + first) % 2 + k // 2 * 2
            least = min(misfit[0], misfit[1])
            if k >= 2 and (least > HOPELESS * usual[r] or misfit[way % 2] > worse * least):
                continue
            _settle(seen, starts[way], disc, work)
            _write(seen, starts[way], way, usual[r], disc, work, out[r, way])
            misfit[way % 2] = min(misfit[way % 2], out[r, way, PAIR_MISFIT])
            if out[r, way, PAIR_MISFIT] < CLEAR * usual[r] and starts[way, EDGE] > 0.0:
                break
    return out
