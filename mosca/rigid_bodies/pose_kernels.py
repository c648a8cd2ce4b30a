"""The compiled part of rigid bodies: the pose of a known constellation, and the search for one among points.

Pose: least squares with the points' full covariances. Start: Horn (1987), closed form by unit quaternions, with one
weight a point; then Gauss-Newton on (translation, rotation vector in world axes), R <- exp([r]) R.
Search: each triple of markers is looked for among the points by its three distances; the pose of a triple is
verified by all markers (hypothesise and verify; Fischler and Bolles 1981, exhaustive instead of random).
"""

import math

import numpy as np

from mosca.numba_support.decorators import kernel, step

STEPS = 6
SETTLED = 1e-11
SINGULAR = 1e-10
JACOBI_SWEEPS = 12
MOST_HYPOTHESES = 20000


@kernel
def fit_pose(place, xyz, covariance, sigma2, rotation, translation, spread, chi2):  # type: ignore[no-untyped-def]
    """Fit x_world = R place + t to points; fills R (3, 3), t (3,), covariance (6, 6) and chi2 (k,) of each point.

    ``place`` (k, 3) in the body's frame, ``xyz`` (k, 3) with ``covariance`` (k, 3, 3), ``sigma2`` [m^2] variance of
    a place on each axis. Returns the sum of chi2, or -1 where the points leave the pose open.
    """
    k = place.shape[0]
    if k < 3:
        return -1.0
    weight = np.empty((k, 3, 3))
    for i in range(k):
        _inverse3(covariance[i], sigma2, weight[i])
    _horn(place, xyz, weight, rotation, translation)
    normal, right, lever = np.empty((6, 6)), np.empty(6), np.empty((k, 3))
    total = 0.0
    for turn in range(STEPS):
        total = _normals(place, xyz, weight, rotation, translation, normal, right, lever, chi2)
        if not _cholesky(normal):
            return -1.0
        if turn == STEPS - 1:
            break
        _solve(normal, right)
        _turn(rotation, right[3], right[4], right[5])
        moved = 0.0
        for c in range(6):
            if c < 3:
                translation[c] += right[c]
            moved = max(moved, abs(right[c]))
        if moved < SETTLED:
            break
    column = np.empty(6)
    for c in range(6):
        for d in range(6):
            column[d] = 1.0 if c == d else 0.0
        _solve(normal, column)
        for d in range(6):
            spread[d, c] = column[d]
    return total


@step
def _normals(place, xyz, weight, rotation, translation, normal, right, lever, chi2):  # type: ignore[no-untyped-def]
    """Fill J'WJ and J'Wr of all points at a pose; returns r'Wr."""
    normal[:], right[:] = 0.0, 0.0
    r, wr, jac, wj = np.empty(3), np.empty(3), np.zeros((3, 6)), np.empty((3, 6))
    total = 0.0
    for i in range(place.shape[0]):
        for a in range(3):
            lever[i, a] = (
                rotation[a, 0] * place[i, 0] + rotation[a, 1] * place[i, 1] + rotation[a, 2] * place[i, 2]
            )
            r[a] = xyz[i, a] - lever[i, a] - translation[a]
            jac[a, a] = 1.0
        # d(R p) = w x (R p)
        jac[0, 4], jac[0, 5] = lever[i, 2], -lever[i, 1]
        jac[1, 3], jac[1, 5] = -lever[i, 2], lever[i, 0]
        jac[2, 3], jac[2, 4] = lever[i, 1], -lever[i, 0]
        for a in range(3):
            w = weight[i, a]
            wr[a] = w[0] * r[0] + w[1] * r[1] + w[2] * r[2]
            for c in range(6):
                wj[a, c] = w[0] * jac[0, c] + w[1] * jac[1, c] + w[2] * jac[2, c]
        chi2[i] = r[0] * wr[0] + r[1] * wr[1] + r[2] * wr[2]
        total += chi2[i]
        for c in range(6):
            right[c] += jac[0, c] * wr[0] + jac[1, c] * wr[1] + jac[2, c] * wr[2]
            for d in range(c + 1):
                normal[c, d] += jac[0, c] * wj[0, d] + jac[1, c] * wj[1, d] + jac[2, c] * wj[2, d]
    return total


@step
def _horn(place, xyz, weight, rotation, translation):  # type: ignore[no-untyped-def]
    """Closed-form pose with one weight a point: the eigenvector of the largest eigenvalue (Horn 1987, eq. 4)."""
    k = place.shape[0]
    p, q = np.zeros(3), np.zeros(3)
    whole = 0.0
    for i in range(k):
        w = weight[i, 0, 0] + weight[i, 1, 1] + weight[i, 2, 2]
        whole += w
        for a in range(3):
            p[a] += w * place[i, a]
            q[a] += w * xyz[i, a]
    for a in range(3):
        p[a] /= whole
        q[a] /= whole
    s = np.zeros((3, 3))
    for i in range(k):
        w = (weight[i, 0, 0] + weight[i, 1, 1] + weight[i, 2, 2]) / whole
        for a in range(3):
            for b in range(3):
                s[a, b] += w * (place[i, a] - p[a]) * (xyz[i, b] - q[b])
    n = np.empty((4, 4))
    n[0, 0] = s[0, 0] + s[1, 1] + s[2, 2]
    n[0, 1] = n[1, 0] = s[1, 2] - s[2, 1]
    n[0, 2] = n[2, 0] = s[2, 0] - s[0, 2]
    n[0, 3] = n[3, 0] = s[0, 1] - s[1, 0]
    n[1, 1] = s[0, 0] - s[1, 1] - s[2, 2]
    n[2, 2] = -s[0, 0] + s[1, 1] - s[2, 2]
    n[3, 3] = -s[0, 0] - s[1, 1] + s[2, 2]
    n[1, 2] = n[2, 1] = s[0, 1] + s[1, 0]
    n[1, 3] = n[3, 1] = s[2, 0] + s[0, 2]
    n[2, 3] = n[3, 2] = s[1, 2] + s[2, 1]
    q4 = np.empty(4)
    _largest(n, q4)
    _matrix(q4[0], q4[1], q4[2], q4[3], rotation)
    for a in range(3):
        translation[a] = q[a] - rotation[a, 0] * p[0] - rotation[a, 1] * p[1] - rotation[a, 2] * p[2]


@step
def _largest(n, vector):  # type: ignore[no-untyped-def]
    """Fill the unit eigenvector (4,) of the largest eigenvalue of n (4, 4): cyclic Jacobi rotations, n is used up."""
    turned = np.eye(4)
    for _sweep in range(JACOBI_SWEEPS):
        off = 0.0
        for p in range(3):
            for q in range(p + 1, 4):
                off += n[p, q] ** 2
                if n[p, q] == 0.0:
                    continue
                h = (n[q, q] - n[p, p]) / (2.0 * n[p, q])
                t = (1.0 if h >= 0.0 else -1.0) / (abs(h) + math.sqrt(h * h + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):
                    n[k, p], n[k, q] = c * n[k, p] - s * n[k, q], s * n[k, p] + c * n[k, q]
                for k in range(4):
                    n[p, k], n[q, k] = c * n[p, k] - s * n[q, k], s * n[p, k] + c * n[q, k]
                    turned[k, p], turned[k, q] = (
                        c * turned[k, p] - s * turned[k, q],
                        s * turned[k, p] + c * turned[k, q],
                    )
        if off < 1e-30:
            break
    best = 0
    for k in range(1, 4):
        if n[k, k] > n[best, best]:
            best = k
    for k in range(4):
        vector[k] = turned[k, best]


@step
def _matrix(w, x, y, z, rotation):  # type: ignore[no-untyped-def]
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@step
def _turn(rotation, u, v, w):  # type: ignore[no-untyped-def]
    """R <- exp([(u, v, w)]) R."""
    angle = math.sqrt(u * u + v * v + w * w)
    half = math.sin(angle / 2) / angle if angle > 1e-12 else 0.5
    change = np.empty((3, 3))
    _matrix(math.cos(angle / 2), half * u, half * v, half * w, change)
    for b in range(3):
        x, y, z = rotation[0, b], rotation[1, b], rotation[2, b]
        for a in range(3):
            rotation[a, b] = change[a, 0] * x + change[a, 1] * y + change[a, 2] * z


@step
def _moved(rotation, translation, place, out):  # type: ignore[no-untyped-def]
    for a in range(3):
        out[a] = (
            rotation[a, 0] * place[0] + rotation[a, 1] * place[1] + rotation[a, 2] * place[2] + translation[a]
        )


@step
def _inverse3(covariance, sigma2, out):  # type: ignore[no-untyped-def]
    """Inverse of covariance + sigma2 I, both symmetric."""
    a, b, c = covariance[0, 0] + sigma2, covariance[0, 1], covariance[0, 2]
    d, e, f = covariance[1, 1] + sigma2, covariance[1, 2], covariance[2, 2] + sigma2
    i, j, k = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * i + b * j + c * k
    out[0, 0], out[0, 1], out[0, 2] = i / det, j / det, k / det
    out[1, 0], out[1, 1], out[1, 2] = j / det, (a * f - c * c) / det, (b * c - a * e) / det
    out[2, 0], out[2, 1], out[2, 2] = k / det, (b * c - a * e) / det, (a * d - b * b) / det


@step
def _cholesky(n):  # type: ignore[no-untyped-def]
    """Factor the lower triangle of n (6, 6) in place; False where a pivot has all but vanished."""
    for j in range(6):
        own = n[j, j]
        s = own
        for k in range(j):
            s -= n[j, k] ** 2
        if not s > SINGULAR * own or not math.isfinite(s):
            return False
        n[j, j] = math.sqrt(s)
        for i in range(j + 1, 6):
            s = n[i, j]
            for k in range(j):
                s -= n[i, k] * n[j, k]
            n[i, j] = s / n[j, j]
    return True


@step
def _solve(factor, b):  # type: ignore[no-untyped-def]
    for i in range(6):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]


@kernel
def claim(place, rotation, translation, xyz, free, gate2, rows):  # type: ignore[no-untyped-def]
    """Give each marker the free point nearest to where it should be; fills rows (m,), -1 for none.

    ``gate2`` (n,) square of how far each point may lie [m^2]. A point wanted by two goes to the nearer. Markers
    that have a row keep it. Returns how many have one.
    """
    m, n = place.shape[0], xyz.shape[0]
    reach, p = np.empty(m), np.empty(3)
    owner = np.full(n, -1)
    for i in range(m):
        if rows[i] >= 0:
            owner[rows[i]] = i
            reach[i] = -1.0
    for i in range(m):
        if rows[i] >= 0:
            continue
        _moved(rotation, translation, place[i], p)
        best, at = np.inf, -1
        for a in range(n):
            if not free[a]:
                continue
            d2 = (xyz[a, 0] - p[0]) ** 2 + (xyz[a, 1] - p[1]) ** 2 + (xyz[a, 2] - p[2]) ** 2
            if d2 < gate2[a] and d2 < best:
                best, at = d2, a
        if at < 0:
            continue
        other = owner[at]
        if other >= 0 and reach[other] <= best:
            continue
        if other >= 0:
            rows[other] = -1
        owner[at], rows[i], reach[i] = i, at, best
    count = 0
    for i in range(m):
        count += rows[i] >= 0
    return count


@kernel
def find(place, triples, xyz, covariance, free, sigma2, slack2, sigmas, apart, rows, score):  # type: ignore[no-untyped-def]
    """Look for a constellation; fills rows (2, m) and score (2, 2) of the two best poses that are not the same.

    ``place`` (m, 3); ``triples`` (t, 3) of its markers; points as in ``fit_pose``, ``free`` (n,) those that may be
    used; ``slack2`` [m^2] added to the points' variance in gates of ``sigmas`` standard deviations. Two poses are the
    same when no marker lies farther apart than ``apart`` [m]. ``score``: markers found (0 for no pose), chi-square.
    """
    m, n = place.shape[0], xyz.shape[0]
    index = np.flatnonzero(free)
    f = len(index)
    away = np.empty((f, f))
    gate2 = np.empty(n)
    for a in range(n):
        variance = covariance[a, 0, 0] + covariance[a, 1, 1] + covariance[a, 2, 2] + sigma2 + slack2
        gate2[a] = sigmas**2 * variance
    span = 0.0
    for i in range(m):
        for j in range(i):
            span = max(span, _apart(place[i], place[j]))
    # all markers lie within a span of each other: only such points are looked at together
    near, count = np.empty((f, f), dtype=np.int64), np.zeros(f, dtype=np.int64)
    for a in range(f):
        for b in range(f):
            away[a, b] = _apart(xyz[index[a]], xyz[index[b]])
            if a != b and away[a, b] < span + math.sqrt(gate2[index[a]] + gate2[index[b]]):
                near[a, count[a]] = b
                count[a] += 1
    rows[:], score[:] = -1, 0.0
    keep = np.empty((2, m, 3))
    three, corner = np.empty((3, 3)), np.empty((3, 3))
    rotation, translation = np.empty((3, 3)), np.empty(3)
    tried = 0
    for t in range(triples.shape[0]):
        i, j, k = triples[t, 0], triples[t, 1], triples[t, 2]
        dij, dik, djk = _apart(place[i], place[j]), _apart(place[i], place[k]), _apart(place[j], place[k])
        for q in range(3):
            corner[0, q], corner[1, q], corner[2, q] = place[i, q], place[j, q], place[k, q]
        for a in range(f):
            ga = gate2[index[a]]
            for nb in range(count[a]):
                b = near[a, nb]
                gb = gate2[index[b]]
                if (away[a, b] - dij) ** 2 > ga + gb:
                    continue
                for nc in range(count[a]):
                    c = near[a, nc]
                    gc = gate2[index[c]]
                    if c == b or (away[a, c] - dik) ** 2 > ga + gc or (away[b, c] - djk) ** 2 > gb + gc:
                        continue
                    if tried == MOST_HYPOTHESES:
                        return
                    tried += 1
                    for q in range(3):
                        three[0, q], three[1, q] = xyz[index[a], q], xyz[index[b], q]
                        three[2, q] = xyz[index[c], q]
                    if not _triad(corner, three, rotation, translation):
                        continue
                    _verify(
                        place, xyz, covariance, gate2, free, sigma2 + slack2, apart, rotation, translation,
                        rows, score, keep,
                    )  # fmt: skip
        if score[0, 0] == m and score[1, 0] < m:
            return  # nothing can explain more


@step
def _verify(place, xyz, covariance, gate2, free, sigma2, apart, rotation, translation, rows, score, keep):  # type: ignore[no-untyped-def]
    """Claim points for all markers, fit them, and rank the pose among the two best."""
    m = place.shape[0]
    mine = np.full(m, -1)
    # a triple's pose is the less certain the farther a marker lies off it: a wide gate first, then a fit
    if claim(place, rotation, translation, xyz, free, 9.0 * gate2, mine) < 3:
        return
    spread, chi2, total = np.empty((6, 6)), np.empty(m), -1.0
    turned, moved = rotation.copy(), translation.copy()
    at, where, spreads = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 3, 3))
    for again in range(2):
        k = 0
        for i in range(m):
            if mine[i] >= 0:
                for a in range(3):
                    at[k, a], where[k, a] = place[i, a], xyz[mine[i], a]
                    for b in range(3):
                        spreads[k, a, b] = covariance[mine[i], a, b]
                k += 1
        if k < 3:
            return
        total = fit_pose(at[:k], where[:k], spreads[:k], sigma2, turned, moved, spread, chi2)
        if total < 0.0:
            return
        if again == 0:
            mine[:] = -1
            if claim(place, turned, moved, xyz, free, gate2, mine) < 3:
                return
    count = 0
    for i in range(m):
        count += mine[i] >= 0
    here = np.empty((m, 3))
    for i in range(m):
        _moved(turned, moved, place[i], here[i])
    _rank(here, mine, float(count), total, apart, rows, score, keep)


@step
def _rank(here, mine, count, total, apart, rows, score, keep):  # type: ignore[no-untyped-def]
    """Keep the two best poses that are not the same, the better one first."""
    for s in range(2):
        if score[s, 0] > 0 and _farthest(here, keep[s]) < apart:
            if not _better(count, total, score[s]):
                return
            if s == 1 and _better(count, total, score[0]):
                _keep(1, keep[0], rows[0], score[0, 0], score[0, 1], rows, score, keep)
                s = 0
            _keep(s, here, mine, count, total, rows, score, keep)
            return
    if _better(count, total, score[0]):
        _keep(1, keep[0], rows[0], score[0, 0], score[0, 1], rows, score, keep)
        _keep(0, here, mine, count, total, rows, score, keep)
    elif _better(count, total, score[1]):
        _keep(1, here, mine, count, total, rows, score, keep)


@step
def _keep(s, here, mine, count, total, rows, score, keep):  # type: ignore[no-untyped-def]
    score[s, 0], score[s, 1] = count, total
    for i in range(len(mine)):
        rows[s, i] = mine[i]
        for a in range(3):
            keep[s, i, a] = here[i, a]


@step
def _better(count, total, than):  # type: ignore[no-untyped-def]
    return count > than[0] or (count == than[0] and total < than[1])


@step
def _farthest(here, there):  # type: ignore[no-untyped-def]
    far = 0.0
    for i in range(here.shape[0]):
        far = max(far, _apart(here[i], there[i]))
    return far


@step
def _apart(p, q):  # type: ignore[no-untyped-def]
    return math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


@step
def _triad(corner, three, rotation, translation):  # type: ignore[no-untyped-def]
    """Pose that lays a triangle on another: their first edges and planes agree; False for triangles that are flat."""
    one, two = np.empty((3, 3)), np.empty((3, 3))
    if not (_axes(corner, one) and _axes(three, two)):
        return False
    for a in range(3):
        for b in range(3):
            rotation[a, b] = two[a, 0] * one[b, 0] + two[a, 1] * one[b, 1] + two[a, 2] * one[b, 2]
    shift = np.zeros(3)
    for i in range(3):
        for a in range(3):
            turned = (
                rotation[a, 0] * corner[i, 0] + rotation[a, 1] * corner[i, 1] + rotation[a, 2] * corner[i, 2]
            )
            shift[a] += (three[i, a] - turned) / 3
    for a in range(3):
        translation[a] = shift[a]
    return True


@step
def _axes(points, axes):  # type: ignore[no-untyped-def]
    """Fill the columns of axes (3, 3): the first edge, the plane's other direction, its normal."""
    x0, x1, x2 = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    y0, y1, y2 = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    lx, ly = math.sqrt(x0**2 + x1**2 + x2**2), math.sqrt(y0**2 + y1**2 + y2**2)
    lz = math.sqrt(z0**2 + z1**2 + z2**2)
    if not lz > 1e-3 * lx * ly:
        return False
    axes[0, 0], axes[1, 0], axes[2, 0] = x0 / lx, x1 / lx, x2 / lx
    axes[0, 2], axes[1, 2], axes[2, 2] = z0 / lz, z1 / lz, z2 / lz
    axes[0, 1] = axes[1, 2] * axes[2, 0] - axes[2, 2] * axes[1, 0]
    axes[1, 1] = axes[2, 2] * axes[0, 0] - axes[0, 2] * axes[2, 0]
    axes[2, 1] = axes[0, 2] * axes[1, 0] - axes[1, 2] * axes[0, 0]
    return True
