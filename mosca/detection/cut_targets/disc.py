"""Image of a disc that a straight edge cuts, and its fit: compiled.

A limb before a marker hides its disc on one side of an edge, which is straight over the few pixels of a marker. Let
u, v be coordinates from the disc's centre, u towards what is hidden, and c the edge's u. Under a Gaussian blur s the
image is

    I = b + A int_{-R}^{c} g(u - t) (Phi((h - v) / s) + Phi((h + v) / s) - 1) dt,    h^2 = R^2 - t^2

with the blur's normal density g and its integral Phi. With t = -R cos(w) the integrand is smooth in w, and the
integral is computed with Gauss-Legendre nodes. With c = R the disc is whole. The fit is least squares by
Levenberg-Marquardt steps. Unknowns of a cut disc are centre, amplitude, background, c and the edge's direction; those
of a whole one have radius and blur instead of the latter two. A cut disc's radius must be known: without it, edge and
rim trade places.
"""

import math

import numpy as np

from mosca.detection.disc_fit.disc_image import FAST, f32
from mosca.numba_support.cholesky import solve
from mosca.numba_support.decorators import bare_step, inlined_step, step

FEWEST_NODES, NODES_A_BLUR, MOST_NODES = 3.0, 3.3, 64
"""Nodes of a cut disc's integral: the first number, and the second for each blur of a whole disc's radius; at most
the third. Images are then right to 1e-4 of the amplitude (discs of 0.5 to 14 blurs, whole or cut, beside 200 nodes).
With half as many for each blur it leaves errors of 2e-2; with twice as many, fits take twice as long."""
NODES, WEIGHTS = np.zeros((2, MOST_NODES + 1, MOST_NODES))
"""Nodes and weights of Gauss and Legendre on (0, 1): row n holds those of n nodes."""
for _n in range(1, MOST_NODES + 1):
    _x, _w = np.polynomial.legendre.leggauss(_n)
    NODES[_n, :_n], WEIGHTS[_n, :_n] = 0.5 * _x + 0.5, 0.5 * _w
CENTRE_X, CENTRE_Y, AMPLITUDE, LEVEL, RADIUS, BLUR, CUT, ANGLE = range(8)
"""Elements of a disc: [px], [DN], [DN], [px], [px], [px] from the centre, [rad] towards what is hidden."""
MISFIT, XX, XY, YY, BY_RADIUS_X, BY_RADIUS_Y, OTHER_MISFIT, OTHER_X, OTHER_Y, RESULT = range(8, 18)
"""What a fit gives besides: squared residuals a degree of freedom over the squared amplitude, covariance of the
centre [px^2], change of the centre by the radius, and misfit and centre of the best fit cut on the other side."""
STEPS, DIRECTIONS = 12, 8
SETTLED_PX, LEAST_GAIN = 2e-3, 1e-3
"""Step, and gain as a share of the squared residuals, below which a fit ends."""
CLEARLY_WORSE = 300.0
"""Chi-square by which a start from the other side must be worse for no fit from it to be tried."""
LEAST_CUT, LARGEST_STEP = -0.8, 0.5
"""Least c that is tried, and largest step of a length, over the radius."""
NUMERIC = 1e-3
"""Step [px] of radius and blur in derivatives by differences."""
FEWEST_PX = 20
"""Pixels that a fit needs."""
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
"""Density of the normal distribution at 0."""
_ONE, _HALF = f32(1.0), f32(0.5)
"""Numbers in the type of the pixels."""
_E = (f32(1.0 / 16.0), f32(0.5), f32(1.0 / 6.0), f32(1.0 / 24.0))
"""Factor of the exponential's argument, and terms of its series."""
_PHI = (f32(0.33267), f32(0.4361836), f32(-0.1201676), f32(0.9372980))
"""Abramowitz and Stegun 26.2.16."""


@inlined_step(fastmath=FAST)
def _series(x):
    """Return exp(x^2 / 32) to second order in x^6."""
    y = _HALF * x * x * _E[0]
    return _ONE + y * (_ONE + y * (_E[1] + y * (_E[2] + y * _E[3])))


@inlined_step(fastmath=FAST)
def _power_16(z):
    """Return z^16."""
    z = z * z
    z = z * z
    z = z * z
    return z * z


@inlined_step(fastmath=FAST)
def _bells(x, y, z):
    """Return exp(-x^2 / 2) to 1e-5 and those of y and z, without a branch and with one division."""
    a, b, c = _series(x), _series(y), _series(z)
    each = _ONE / (a * b * c)
    return _power_16(each * b * c), _power_16(each * a * c), _power_16(each * a * b)


@inlined_step(fastmath=FAST)
def _below_both(x, y, bell_x, bell_y):
    """Return the sum of the normal distribution's integrals from 0 to x and to y (Abramowitz and Stegun 26.2.16).

    Each is right to 1e-5. ``bell_x``: exp(-x^2 / 2).
    """
    a, b = _ONE + _PHI[0] * abs(x), _ONE + _PHI[0] * abs(y)
    each = _ONE / (a * b)
    t, u, density = each * b, each * a, f32(_DENSITY)
    first = _HALF - density * bell_x * t * (_PHI[1] + t * (_PHI[2] + t * _PHI[3]))
    second = _HALF - density * bell_y * u * (_PHI[1] + u * (_PHI[2] + u * _PHI[3]))
    return math.copysign(first, x) + math.copysign(second, y)


@bare_step(fastmath=FAST)
def cut_image(pixels, disc, image, nodes):
    """Fill the first rows of ``image`` (7, n): share of the amplitude, derivatives by u, v, c and the direction.

    ``pixels`` (3, n): x, y [px] and value; ``disc`` as named above; ``nodes`` (3, k): scratch.
    """
    radius, blur, cut, turn = disc[RADIUS], disc[BLUR], disc[CUT], disc[ANGLE]
    last, inverse = math.acos(min(max(-cut / radius, -1.0), 1.0)), f32(1.0 / blur)
    many = min(math.ceil(FEWEST_NODES + NODES_A_BLUR * radius / blur * last / math.pi), MOST_NODES)
    for k in range(many):
        w = last * NODES[many, k]
        nodes[0, k] = -radius * math.cos(w) / blur
        nodes[1, k] = radius * math.sin(w) / blur
        nodes[2, k] = radius * math.sin(w) * last * WEIGHTS[many, k] * _DENSITY / blur
    cosine, sine, n = f32(math.cos(turn)), f32(math.sin(turn)), pixels.shape[1]
    x, y, edge, height = (
        f32(disc[CENTRE_X]),
        f32(disc[CENTRE_Y]),
        f32(cut / blur),
        f32(radius / blur * math.sin(last)),
    )
    share, by_u, by_v, by_c, by_turn, us, vs = image[0], image[1], image[2], image[3], image[4], image[5], image[6]
    for i in range(n):
        dx, dy = (pixels[0, i] - x) * inverse, (pixels[1, i] - y) * inverse
        us[i], vs[i] = cosine * dx + sine * dy, cosine * dy - sine * dx
        share[i] = by_u[i] = by_v[i] = f32(0.0)
    density = f32(_DENSITY)
    for k in range(many):
        at, half, weight = nodes[0, k], nodes[1, k], nodes[2, k]
        for i in range(n):
            a, p, q = us[i] - at, half - vs[i], half + vs[i]
            bell, low, high = _bells(a, p, q)
            along = weight * bell
            part = along * _below_both(p, q, low, high)
            share[i] += part
            by_u[i] -= part * a
            by_v[i] += along * (high - low)
    for i in range(n):
        a, p, q = us[i] - edge, height - vs[i], height + vs[i]
        bell, low, high = _bells(a, p, q)
        by_c[i] = density * inverse * bell * _below_both(p, q, low, high)
        by_turn[i] = by_u[i] * vs[i] - density * by_v[i] * us[i]
        by_u[i] *= inverse
        by_v[i] *= inverse * density


@bare_step
def levels(pixels, image, disc):
    """Set amplitude and background to the best for an image; return the squared residuals."""
    n = pixels.shape[1]
    s = ss = v = sv = vv = 0.0
    for i in range(n):
        a, b = image[0, i], pixels[2, i]
        s, ss, v, sv, vv = s + a, ss + a * a, v + b, sv + a * b, vv + b * b
    det = n * ss - s * s
    if not det > 0.0:
        return np.inf
    disc[AMPLITUDE] = (n * sv - s * v) / det
    disc[LEVEL] = (v - disc[AMPLITUDE] * s) / n
    return vv - disc[AMPLITUDE] * sv - disc[LEVEL] * v


@bare_step
def _columns(pixels, disc, whole, image, other, nodes, by):
    """Fill ``by`` (6, n): derivatives by x, y, amplitude, background and the two further unknowns."""
    cosine, sine, a = math.cos(disc[ANGLE]), math.sin(disc[ANGLE]), disc[AMPLITUDE]
    for i in range(pixels.shape[1]):
        by[0, i] = a * (sine * image[2, i] - cosine * image[1, i])
        by[1, i] = -a * (sine * image[1, i] + cosine * image[2, i])
        by[2, i], by[3, i] = image[0, i], 1.0
        by[4, i], by[5, i] = a * image[3, i], a * image[4, i]
    if whole:
        _by_radius(pixels, disc, image, other, nodes, by, 4)
        kept = disc[BLUR]
        disc[BLUR] = kept + NUMERIC
        cut_image(pixels, disc, other, nodes)
        disc[BLUR] = kept
        for i in range(pixels.shape[1]):
            by[5, i] = a * (other[0, i] - image[0, i]) / NUMERIC


@bare_step
def _by_radius(pixels, disc, image, other, nodes, by, row):
    """Fill a row of ``by`` with the derivative by the radius; c is held where it is less than the radius."""
    kept, cut = disc[RADIUS], disc[CUT]
    disc[RADIUS] = kept + NUMERIC
    if cut >= kept:
        disc[CUT] = disc[RADIUS]
    cut_image(pixels, disc, other, nodes)
    disc[RADIUS], disc[CUT] = kept, cut
    for i in range(pixels.shape[1]):
        by[row, i] = disc[AMPLITUDE] * (other[0, i] - image[0, i]) / NUMERIC


@bare_step
def _moved(disc, change, whole, out):
    """Write to ``out`` the disc after a step, within bounds; return how far centre, edge and radius go [px]."""
    radius = disc[RADIUS]
    most = LARGEST_STEP * radius
    far = max(abs(change[0, 0]), abs(change[1, 0]), abs(change[4, 0]), abs(change[5, 0]) * (1.0 if whole else radius))
    held = min(1.0, most / far) if far > 0.0 else 1.0
    for k in range(8):
        out[k] = disc[k]
    out[CENTRE_X] += held * change[0, 0]
    out[CENTRE_Y] += held * change[1, 0]
    if whole:
        out[RADIUS] = max(radius + held * change[4, 0], 0.3)
        out[BLUR] = max(disc[BLUR] + held * change[5, 0], 0.2)
        out[CUT] = out[RADIUS]
    else:
        out[CUT] = min(max(disc[CUT] + held * change[4, 0], LEAST_CUT * radius), radius)
        out[ANGLE] += held * change[5, 0]
    return held * far


@bare_step
def _settle(pixels, disc, whole, work):
    """Improve a disc by Levenberg-Marquardt steps; return its squared residuals."""
    image, other, nodes, by, normal, right, tried = work
    cut_image(pixels, disc, image, nodes)
    least, damping = levels(pixels, image, disc), 1e-3
    for _ in range(STEPS):
        _columns(pixels, disc, whole, image, other, nodes, by)
        normal_equations(pixels, disc, image, by, damping, normal, right)
        if not solve(normal, right[:, :1], 6):
            break
        far = _moved(disc, right, whole, tried)
        cut_image(pixels, tried, other, nodes)
        error = levels(pixels, other, tried)
        if error <= least:
            gained = least - error
            least, damping = error, damping / 8.0
            for k in range(8):
                disc[k] = tried[k]
            for row in range(5):
                for i in range(pixels.shape[1]):
                    image[row, i] = other[row, i]
            if far < SETTLED_PX or gained < LEAST_GAIN * least:
                break
        else:
            damping *= 10.0
            if damping > 1e4:
                break
    return least


@bare_step(fastmath=FAST)
def normal_equations(pixels, disc, image, by, damping, normal, right):
    """Fill ``normal`` (k, k) and ``right`` (k, 1) of a step by the derivatives ``by`` (k, n)."""
    level, amplitude = f32(disc[LEVEL]), f32(disc[AMPLITUDE])
    for a in range(by.shape[0]):
        for b in range(a + 1):
            total = f32(0.0)
            for i in range(pixels.shape[1]):
                total += by[a, i] * by[b, i]
            normal[a, b] = total
        total = f32(0.0)
        for i in range(pixels.shape[1]):
            total += by[a, i] * (pixels[2, i] - level - amplitude * image[0, i])
        right[a, 0] = total
        normal[a, a] *= 1.0 + damping


@bare_step
def _write(pixels, disc, whole, error, usual, work, out):
    """Write a fit to a row (RESULT,); ``usual``: misfit that whole discs of the camera have."""
    image, other, nodes, by, normal, right, _ = work
    cut_image(pixels, disc, image, nodes)
    _columns(pixels, disc, whole, image, other, nodes, by)
    normal_equations(pixels, disc, image, by, 0.0, normal, right)
    for a in range(6):
        right[a, 0], right[a, 1], right[a, 2] = 1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 0.0
    if not whole:
        _by_radius(pixels, disc, image, other, nodes, other, 4)
        for a in range(6):
            for i in range(pixels.shape[1]):
                right[a, 2] -= by[a, i] * other[4, i]
    for k in range(8):
        out[k] = disc[k]
    a2 = disc[AMPLITUDE] * disc[AMPLITUDE]
    out[MISFIT] = error / max(pixels.shape[1] - 6, 1) / a2
    if not solve(normal, right, 6):
        out[MISFIT] = np.inf
        return
    variance = max(out[MISFIT], usual) * a2
    out[XX], out[XY], out[YY] = variance * right[0, 0], variance * right[1, 0], variance * right[1, 1]
    out[BY_RADIUS_X], out[BY_RADIUS_Y] = right[0, 2], right[1, 2]


@step
def fit_discs(patches, there, discs, whole, usual):
    """Fit discs to ``patches`` (n, h, w) of values [DN]; return (n, RESULT), MISFIT inf where there is no fit.

    ``there`` (n, h, w): pixels that count; ``discs`` (n, 8): centre from the patch's first pixel to start from (of a
    cut disc that of its visible part), RADIUS, BLUR and CUT; ``usual`` (n,): misfit of the camera's whole discs. For
    a cut disc ``DIRECTIONS`` are tried. The fit from the best one is taken, and beside it that from the best of those
    nearly opposite.
    """
    n, h, w = patches.shape
    out = np.full((n, RESULT), np.inf)
    pixels, at = np.empty((3, h * w), f32), np.empty(8)
    second = np.empty(8)
    work = (
        np.empty((7, h * w), f32), np.empty((7, h * w), f32), np.empty((3, MOST_NODES), f32),
        np.empty((6, h * w), f32),
        np.empty((6, 6)), np.empty((6, 3)), np.empty(8),
    )  # fmt: skip
    for r in range(n):
        count = gather(patches[r], there[r], pixels)
        if count < FEWEST_PX:
            continue
        seen = pixels[:, :count]
        for k in range(8):
            at[k] = discs[r, k]
        if whole:
            at[CUT] = at[RADIUS]
            error = _settle(seen, at, True, work)
            _write(seen, at, True, error, usual[r], work, out[r])
            continue
        first_angle, other_angle, ratio = _directions(seen, discs[r], work)
        _start(discs[r], first_angle, at)
        error = _settle(seen, at, False, work)
        _start(discs[r], other_angle, second)
        second[AMPLITUDE] = at[AMPLITUDE]
        other_error = ratio * error
        if (count - 6) * (ratio - 1.0) < CLEARLY_WORSE:
            other_error = _settle(seen, second, False, work)
        if other_error < error:
            error, other_error = other_error, error
            for k in range(8):
                at[k], second[k] = second[k], at[k]
        _write(seen, at, False, error, usual[r], work, out[r])
        out[r, OTHER_MISFIT] = other_error / max(count - 6, 1) / (second[AMPLITUDE] * second[AMPLITUDE])
        out[r, OTHER_X], out[r, OTHER_Y] = second[CENTRE_X], second[CENTRE_Y]
    return out


@step
def _directions(pixels, given, work):
    """Return the best direction to start from, the best of those nearly opposite, and their misfits' ratio."""
    errors, disc = np.empty(DIRECTIONS), np.empty(8)
    for k in range(DIRECTIONS):
        _start(given, 2.0 * math.pi * k / DIRECTIONS, disc)
        cut_image(pixels, disc, work[0], work[2])
        errors[k] = levels(pixels, work[0], disc)
    best = int(np.argmin(errors))
    other = best
    for k in range(3, 6):
        at = (best + k) % DIRECTIONS
        if other == best or errors[at] < errors[other]:
            other = at
    return 2.0 * math.pi * best / DIRECTIONS, 2.0 * math.pi * other / DIRECTIONS, errors[other] / errors[best]


@bare_step
def _start(given, turn, disc):
    """Write a disc cut in a direction, whose visible part has its centroid at the centre that is given."""
    for k in range(8):
        disc[k] = given[k]
    radius = disc[RADIUS]
    half = math.acos(min(max(disc[CUT] / radius, -1.0), 1.0))
    sine, cosine = math.sin(half), math.cos(half)
    away = 2.0 / 3.0 * radius * sine**3 / max(math.pi - half + sine * cosine, 1e-6)
    disc[CENTRE_X] += away * math.cos(turn)
    disc[CENTRE_Y] += away * math.sin(turn)
    disc[ANGLE] = turn


@bare_step
def gather(patch, there, pixels):
    """Fill ``pixels`` (3, n) with the places and values of the pixels that count; return how many there are."""
    count = 0
    for y in range(patch.shape[0]):
        for x in range(patch.shape[1]):
            if there[y, x]:
                pixels[0, count], pixels[1, count], pixels[2, count] = x, y, patch[y, x]
                count += 1
    return count
