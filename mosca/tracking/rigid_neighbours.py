"""Which points may be whose, and what the neighbours say: compiled kernels of the tracker.

Markers of one limb keep their distances. Which neighbours those are is learned from the tracks: for each target the
mean and the variance of its distances to ``MATES`` others. They tell where a hidden target must be (the limb's
rigid motion since it was last seen carries it along) and whether a point can be a target that was lost.
"""

import numpy as np

from mosca.numba_support.decorators import bare_step, kernel, short_kernel, step
from mosca.tracking.state import BY_LIMB, BY_MOTION, CONFIRMED, FREE, MATES, NOWHERE, TICK, TOP

RIGID, UNPROVEN, PROVEN_S = 0.005, 0.15, 0.2
"""Standard deviation of a distance over its length: at least, before anything is known, and after how long
the latter's variance is halved [s]."""
UNFIT, LOOSE = 0.05, 0.15
"""Standard deviation of a distance over its length from which another mate is tried, and from which it tells
nothing."""
RELAXED_S = 0.5
"""How long a distance keeps its deviation from the mean [s]."""
WINDOW_S = 20.0
"""Time over which distances are learned [s]."""
TAUGHT, REFRESH, EXCHANGED = 1, 16, 3
"""Each target's distances are learned once in so many instants; after so many lessons it looks for better mates
and exchanges so many of the worst."""
SPIN_RADPS = 4.0
"""How fast a limb may turn about an axis that its visible markers do not show."""
FOREIGN = 0.05
"""Share of distances that break for no reason (a mate exchanged, a ghost)."""
SEEN_BONUS = 16.0
"""-2 log of the chance that a target seen last is not seen now."""
STRAINED = 16.0
"""Squared deviation of a distance, in variances, from which it is violated."""
WILD_COST = 9.0
"""-2 log of the chance that a target accelerates far beyond what it has shown."""
CONTRADICTED = -2.0
"""Log-likelihood ratio of distances below which a poor sighting is not a hidden target's."""


@step
def pairs(  # type: ignore[no-untyped-def]
    bank, limbs, xyz, covariance, trusted, used, state, gate_sigma, gate_m, wild_mps2, sure_from, time_s
):
    """Return which targets in ``state`` and which unused points may be one: slots, rows and worth (k,).

    Worth: log-likelihood ratio (times 2) of "this target's point" against "a point of its own", points of their own
    being as dense as one in a gate; at least 0 within the gates. ``wild_mps2``: acceleration beyond what a target has
    shown, now and then; what is likelier counts. ``sure_from``: cameras that count in full from which a sighting is
    no poor one.
    """
    top, m = bank.numbers[TOP], xyz.shape[0]
    room, n = 4 * (m + top) + 16, 0
    slots, rows, worth = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    if m == 0:
        return slots[:0], rows[:0], worth[:0]
    axis, widest = 0, -1.0
    for a in range(3):
        low, high = xyz[0, a], xyz[0, a]
        for r in range(m):
            low, high = min(low, xyz[r, a]), max(high, xyz[r, a])
        if high - low > widest:
            axis, widest = a, high - low
    along, order = _sorted(xyz, axis)
    loosest = 0.0
    for r in range(m):
        loosest = max(loosest, covariance[r, 0, 0] + covariance[r, 1, 1] + covariance[r, 2, 2])
    offset = gate_sigma**2 + 3.0 * np.log(gate_m**2)
    for i in range(top):
        if bank.state[i] != state or bank.source[i] == NOWHERE:
            continue
        p, place = bank.place_covariance[i], bank.place[i]
        wild = (0.5 * wild_mps2 * (time_s - bank.seen_s[i]) ** 2) ** 2 if bank.missed[i] == 0 else 0.0
        reach = min(gate_m, gate_sigma * np.sqrt(p[0, 0] + p[1, 1] + p[2, 2] + 3.0 * wild + loosest))
        for k in range(np.searchsorted(along, place[axis] - reach), m):
            if along[k] > place[axis] + reach:
                break
            r = order[k]
            x, y, z = xyz[r, 0] - place[0], xyz[r, 1] - place[1], xyz[r, 2] - place[2]
            away2 = x * x + y * y + z * z
            if away2 > reach * reach or used[r] >= 0:
                continue
            evidence = min(max((trusted[r] - 1.0) / 2.0, 0.25), 1.0) if state == CONFIRMED else 1.0
            if away2 > (gate_m * evidence) ** 2:
                continue
            value = -1.0
            away, log_det = _mahalanobis(p, covariance[r], 0.0, x, y, z)
            if away <= gate_sigma**2:
                value = offset - away - log_det
            if wild > 0.0 and away > WILD_COST:
                farther, wider = _mahalanobis(p, covariance[r], wild, x, y, z)
                if farther <= gate_sigma**2:
                    value = max(value, offset - farther - wider - WILD_COST)
            if value <= 0.0:
                continue
            if bank.missed[i] == 0 and away <= gate_sigma**2:
                # one that has no name yet gives way to one that was lost here
                value += SEEN_BONUS if state != CONFIRMED or bank.identity[i] >= 0 else 0.0
            elif bank.missed[i] > 0:
                # distances that break speak against it, as loudly as its place for it; but what two cameras with
                # an image of odd size see is too often there by chance
                fits = _fits(bank, limbs, i, xyz[r], covariance[r], time_s - bank.seen_s[i], gate_m)
                value += min(2.0 * fits, 0.0)
                if value <= 0.0 or (fits < CONTRADICTED and trusted[r] < sure_from):
                    continue
            if n == room:
                room *= 2
                slots, rows, worth = _longer(slots, rows, worth)
            slots[n], rows[n], worth[n] = i, r, value
            n += 1
    return slots[:n], rows[:n], worth[:n]


@kernel
def learn(bank, limbs, step_s, reach_m):  # type: ignore[no-untyped-def]
    """Learn the distances of all targets just seen; take the photo; look for mates now and then."""
    bank.numbers[TICK] += 1
    tick = bank.numbers[TICK]
    lesson_s = TAUGHT * max(step_s, 1e-6)
    for i in range(bank.numbers[TOP]):
        if bank.state[i] != CONFIRMED or bank.missed[i] != 0:
            continue
        lesson = (i + tick) % TAUGHT == 0
        if limbs.mate[i, 0] < 0 or (lesson and (i + tick) // TAUGHT % REFRESH == 0):
            _look_for_mates(bank, limbs, i, reach_m, tick // (TAUGHT * REFRESH))
        if not bank.sure[i]:
            continue
        # numbers, not rows: of each row that is cut out somebody counts the users
        x, y, z = bank.mean[i, 0], bank.mean[i, 1], bank.mean[i, 2]
        limbs.own[i, 0], limbs.own[i, 1], limbs.own[i, 2] = x, y, z
        for a in range(3):
            for b in range(3):
                limbs.turn[i, a, b] = 1.0 if a == b else 0.0
        for k in range(MATES):
            j = limbs.mate[i, k]
            taken = (
                j >= 0 and bank.serial[j] == limbs.mate_serial[i, k] and bank.missed[j] == 0 and bank.sure[j]
            )
            limbs.taken[i, k] = taken
            if not taken:
                continue
            u, v, w = bank.mean[j, 0], bank.mean[j, 1], bank.mean[j, 2]
            limbs.photo[i, k, 0], limbs.photo[i, k, 1], limbs.photo[i, k, 2] = u, v, w
            if not lesson:
                continue
            length, variance, shown_s = limbs.length[i, k], limbs.variance[i, k], limbs.shown_s[i, k]
            away = np.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2) - length
            rate = min(lesson_s / min(shown_s + lesson_s, WINDOW_S), 1.0)
            # a sudden change is rather a wrong point than a new limb
            if shown_s > 2 * PROVEN_S and away * away > STRAINED * _spread2(length, variance, shown_s):
                rate *= 0.2
            limbs.variance[i, k] = (1.0 - rate) * (variance + rate * away * away)
            limbs.length[i, k] = length + rate * away
            limbs.shown_s[i, k] = shown_s + lesson_s


@step
def expect(bank, limbs, time_s, step_s, widest_m):  # type: ignore[no-untyped-def]
    """Set the expected place of each hidden target to what its limb says, where that is more certain.

    Places whose standard deviation exceeds ``widest_m`` [m, of the 3D distance] are none.
    """
    place, covariance = np.empty(3), np.empty((3, 3))
    for i in range(bank.numbers[TOP]):
        if bank.state[i] != CONFIRMED or bank.missed[i] == 0:
            continue
        size2 = _carried_along(bank, limbs, i, time_s - bank.seen_s[i], step_s, place, covariance)
        if not size2 < widest_m * widest_m:
            continue
        p = bank.place_covariance[i]
        if bank.source[i] == BY_MOTION and p[0, 0] + p[1, 1] + p[2, 2] < size2:
            continue
        bank.source[i] = BY_LIMB
        for a in range(3):
            bank.place[i, a] = place[a]
            for b in range(3):
                bank.place_covariance[i, a, b] = covariance[a, b]


@short_kernel
def recall(bank, limbs, i, time_s, least, range_m, speed_mps):  # type: ignore[no-untyped-def]
    """Return the lost target whose distances slot ``i``, not named yet, fulfils, and whether any can be meant.

    The former is -1 where none convinces: ``least`` is the log-likelihood ratio that does, the second best must be
    behind by 3. A target can be meant if it has a limb and
    could have come here from where it was lost.
    """
    best, second, at, possible = -np.inf, -np.inf, -1, False
    for j in range(bank.numbers[TOP]):
        if bank.state[j] != CONFIRMED or bank.identity[j] < 0 or bank.missed[j] == 0:
            continue
        hidden_s = time_s - bank.seen_s[j]
        if (
            _distance(bank.mean[i], limbs.own[j]) > range_m + speed_mps * hidden_s
            or bank.born_s[i] < bank.seen_s[j]
        ):
            continue
        possible |= _has_limb(limbs.length[j], limbs.variance[j], limbs.shown_s[j])
        fits = _fits(bank, limbs, j, bank.mean[i], bank.covariance[i], hidden_s, range_m)
        if fits > best:
            best, second, at = fits, best, j
        elif fits > second:
            second = fits
    return (at if best >= least and best > second + 3.0 else -1), possible


@short_kernel
def found_instead(bank, i, time_s, near_m):  # type: ignore[no-untyped-def]
    """Return the lost target that was found again now where slot ``i``, without a name, should have been, or -1.

    Only one that was lost before ``i`` was born: then ``i`` was it all the time.
    """
    for j in range(bank.numbers[TOP]):
        known = bank.state[j] == CONFIRMED and bank.identity[j] >= 0
        back = bank.back_s[j] == time_s and bank.born_s[i] > bank.gone_s[j]
        if known and back and _distance(bank.mean[i], bank.mean[j]) < near_m:
            return j
    return -1


@short_kernel
def take_over(bank, old, new):  # type: ignore[no-untyped-def]
    """Let slot ``old`` go on with the filter of slot ``new``, which becomes free."""
    for a in range(9):
        bank.mean[old, a] = bank.mean[new, a]
        for b in range(9):
            bank.covariance[old, a, b] = bank.covariance[new, a, b]
    bank.seen_s[old], bank.missed[old], bank.sure[old] = bank.seen_s[new], bank.missed[new], bank.sure[new]
    bank.variance[old] = bank.variance[new]
    bank.state[new], bank.serial[new], bank.identity[new] = FREE, -1, -1


@bare_step
def _fits(bank, limbs, i, point, noise, hidden_s, range_m):  # type: ignore[no-untyped-def]
    """Log-likelihood ratio that ``point`` is target ``i``, by its distances to the mates seen now.

    ``noise``: covariance of the point; ``hidden_s``: since the target was last seen.
    """
    own = (noise[0, 0] + noise[1, 1] + noise[2, 2]) / 3.0
    # a distance goes back from what it was when last seen to its mean, and its variance grows (Ornstein-Uhlenbeck)
    kept = np.exp(-hidden_s / RELAXED_S)
    total = 0.0
    for k in range(MATES):
        if limbs.shown_s[i, k] > PROVEN_S and _seen(
            bank.serial, bank.missed, limbs.mate[i, k], limbs.mate_serial[i, k]
        ):
            length, spread2 = (
                limbs.length[i, k],
                _spread2(limbs.length[i, k], limbs.variance[i, k], limbs.shown_s[i, k]),
            )
            if limbs.taken[i, k]:
                length += kept * (_distance(limbs.own[i], limbs.photo[i, k]) - length)
                spread2 -= kept * kept * limbs.variance[i, k]
            spread2 += own
            if spread2 > (LOOSE * length) ** 2:
                continue
            away = _distance(point, bank.mean[limbs.mate[i, k]]) - length
            likely = np.exp(-0.5 * away * away / spread2) * range_m / np.sqrt(2.0 * np.pi * spread2)
            total += np.log((1.0 - FOREIGN) * min(likely, 1e6) + FOREIGN)
    return total


@bare_step
def _seen(serial, missed, mate, owner):  # type: ignore[no-untyped-def]
    return mate >= 0 and serial[mate] == owner and missed[mate] == 0


@bare_step
def _has_limb(length, variance, shown_s):  # type: ignore[no-untyped-def]
    """Whether at least two distances of a target are known to be kept."""
    kept = 0
    for k in range(MATES):
        kept += (
            shown_s[k] > PROVEN_S and _spread2(length[k], variance[k], shown_s[k]) < (LOOSE * length[k]) ** 2
        )
    return kept >= 2


@bare_step
def _spread2(length, variance, shown_s):  # type: ignore[no-untyped-def]
    """Variance with which a distance is known to be kept."""
    shown = shown_s / PROVEN_S
    return variance + (RIGID**2 + UNPROVEN**2 / (1.0 + shown * shown)) * length * length


@bare_step
def _look_for_mates(bank, limbs, i, reach_m, turn):  # type: ignore[no-untyped-def]
    """Fill empty places with the nearest others, and exchange the worst for the nearest that is not one yet."""
    empty = limbs.mate[i, 0] < 0
    for k in range(MATES):
        j = limbs.mate[i, k]
        if j >= 0 and bank.serial[j] != limbs.mate_serial[i, k]:
            limbs.mate[i, k] = -1
    for _ in range(MATES if empty else EXCHANGED):
        worst, at = -1.0, -1
        for k in range(MATES):
            if limbs.mate[i, k] < 0:
                worst, at = np.inf, k
            elif limbs.shown_s[i, k] > 2 * PROVEN_S and limbs.variance[i, k] > worst:
                worst, at = limbs.variance[i, k], k
        if at < 0 or (limbs.mate[i, at] >= 0 and worst < (UNFIT * limbs.length[i, at]) ** 2):
            return
        nearest, found = reach_m * reach_m, -1
        # a third of the others at a time, so that a neighbour that was dropped does not come back at once
        for j in range(0 if empty else -turn % 3, bank.numbers[TOP], 1 if empty else 3):
            if j == i or bank.state[j] != CONFIRMED or bank.missed[j] != 0:
                continue
            x, y, z = (
                bank.mean[j, 0] - bank.mean[i, 0],
                bank.mean[j, 1] - bank.mean[i, 1],
                bank.mean[j, 2] - bank.mean[i, 2],
            )
            away2 = x * x + y * y + z * z
            if away2 < nearest:
                mate = False
                for k in range(MATES):
                    mate |= limbs.mate[i, k] == j
                if not mate:
                    nearest, found = away2, j
        if found < 0:
            return
        limbs.mate[i, at], limbs.mate_serial[i, at] = found, bank.serial[found]
        limbs.length[i, at], limbs.variance[i, at], limbs.shown_s[i, at] = np.sqrt(nearest), 0.0, 0.0
        limbs.taken[i, at] = False


@step
def _carried_along(bank, limbs, i, hidden_s, step_s, place, covariance):  # type: ignore[no-untyped-def]
    """Rigid motion of the limb since the photo, and where it brings target ``i``; returns the variance's trace.

    The rotation goes on from that of the instant before, by Gauss-Newton steps held back where the mates do not
    show it. Covariance: of the limb's translation, of its rotation times the lever, of the target's own rigidity; all
    larger where the mates do not move as one body. ``inf`` where no mate is seen.
    """
    total, kept, seen = 0.0, 0.0, 0
    then, now, own = np.zeros(3), np.zeros(3), limbs.own[i]
    for k in range(MATES):
        if limbs.taken[i, k] and _seen(bank.serial, bank.missed, limbs.mate[i, k], limbs.mate_serial[i, k]):
            w = 1.0 / _spread2(limbs.length[i, k], limbs.variance[i, k], limbs.shown_s[i, k])
            total += w
            seen += 1
            for a in range(3):
                then[a] += w * limbs.photo[i, k, a]
                now[a] += w * bank.mean[limbs.mate[i, k], a]
    if seen == 0:
        return np.inf
    kept = total / seen
    for a in range(3):
        then[a] /= total
        now[a] /= total
    turn, normal, right, spin = limbs.turn[i], np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    held = 1.0 / (SPIN_RADPS * max(step_s, 1e-4)) ** 2
    misfit = 0.0
    for _ in range(3):
        normal[:] = 0.0
        right[:] = 0.0
        misfit = 0.0
        for k in range(MATES):
            if limbs.taken[i, k] and _seen(
                bank.serial, bank.missed, limbs.mate[i, k], limbs.mate_serial[i, k]
            ):
                w, j = (
                    1.0 / _spread2(limbs.length[i, k], limbs.variance[i, k], limbs.shown_s[i, k]),
                    limbs.mate[i, k],
                )
                r = _turned(turn, limbs.photo[i, k], then)
                x, y, z = (
                    bank.mean[j, 0] - now[0] - r[0],
                    bank.mean[j, 1] - now[1] - r[1],
                    bank.mean[j, 2] - now[2] - r[2],
                )
                misfit += w * (x * x + y * y + z * z)
                right[0] += w * (r[1] * z - r[2] * y)
                right[1] += w * (r[2] * x - r[0] * z)
                right[2] += w * (r[0] * y - r[1] * x)
                square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
                for a in range(3):
                    normal[a, a] += w * square
                    for b in range(3):
                        normal[a, b] -= w * r[a] * r[b]
        _inverse(normal, held, spin)
        _turn_by(turn, spin, right)
    lever = _turned(turn, own, then)
    for a in range(3):
        place[a] = now[a] + lever[a]
    looser = max(1.0, misfit / max(3.0 * seen - 6.0, 1.0)) if seen > 2 else 1.0
    _inverse(normal, 1.0 / min((SPIN_RADPS * hidden_s) ** 2, 3.0), spin)
    own_and_common = 1.0 / total + 1.0 / kept
    for a in range(3):
        # rows of the lever's cross matrix: a rotation vector moves the target by it times the vector
        p, q = (a + 1) % 3, (a + 2) % 3
        for b in range(3):
            r, s = (b + 1) % 3, (b + 2) % 3
            value = lever[q] * (spin[p, r] * lever[s] - spin[p, s] * lever[r])
            value -= lever[p] * (spin[q, r] * lever[s] - spin[q, s] * lever[r])
            covariance[a, b] = looser * (value + (own_and_common if a == b else 0.0))
    return covariance[0, 0] + covariance[1, 1] + covariance[2, 2]


@bare_step
def _turned(turn, point, centre):  # type: ignore[no-untyped-def]
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@bare_step
def _turn_by(turn, spin, right):  # type: ignore[no-untyped-def]
    """Turn a rotation matrix further by the rotation vector ``spin`` @ ``right`` (Rodrigues, column by column)."""
    x = spin[0, 0] * right[0] + spin[0, 1] * right[1] + spin[0, 2] * right[2]
    y = spin[1, 0] * right[0] + spin[1, 1] * right[1] + spin[1, 2] * right[2]
    z = spin[2, 0] * right[0] + spin[2, 1] * right[1] + spin[2, 2] * right[2]
    size = np.sqrt(x * x + y * y + z * z)
    if size > 0.0:
        s, c = np.sin(size) / size, (1.0 - np.cos(size)) / (size * size)
        for b in range(3):
            u, v, w = turn[0, b], turn[1, b], turn[2, b]
            k, m, n = y * w - z * v, z * u - x * w, x * v - y * u
            turn[0, b] = u + s * k + c * (y * n - z * m)
            turn[1, b] = v + s * m + c * (z * k - x * n)
            turn[2, b] = w + s * n + c * (x * m - y * k)


@bare_step
def _inverse(a, more, out):  # type: ignore[no-untyped-def]
    """Inverse of the symmetric 3 x 3 matrix ``a`` + ``more`` x identity, into ``out``."""
    d0, d1, d2 = a[0, 0] + more, a[1, 1] + more, a[2, 2] + more
    e01, e02, e12 = a[0, 1], a[0, 2], a[1, 2]
    c00, c01, c02 = d1 * d2 - e12 * e12, e02 * e12 - e01 * d2, e01 * e12 - e02 * d1
    det = d0 * c00 + e01 * c01 + e02 * c02
    out[0, 0], out[1, 1], out[2, 2] = c00 / det, (d0 * d2 - e02 * e02) / det, (d0 * d1 - e01 * e01) / det
    out[0, 1], out[0, 2], out[1, 2] = c01 / det, c02 / det, (e01 * e02 - d0 * e12) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@bare_step
def _mahalanobis(p, r, extra, x, y, z):  # type: ignore[no-untyped-def]
    """Squared distance (x, y, z) in units of p + r + extra x identity, and the logarithm of that's determinant."""
    d0, d1, d2 = p[0, 0] + r[0, 0] + extra, p[1, 1] + r[1, 1] + extra, p[2, 2] + r[2, 2] + extra
    e01, e02, e12 = p[0, 1] + r[0, 1], p[0, 2] + r[0, 2], p[1, 2] + r[1, 2]
    c00, c01, c02 = d1 * d2 - e12 * e12, e02 * e12 - e01 * d2, e01 * e12 - e02 * d1
    det = d0 * c00 + e01 * c01 + e02 * c02
    c11, c12, c22 = d0 * d2 - e02 * e02, e01 * e02 - d0 * e12, d0 * d1 - e01 * e01
    form = c00 * x * x + c11 * y * y + c22 * z * z + 2.0 * (c01 * x * y + c02 * x * z + c12 * y * z)
    return form / det, np.log(det)


@bare_step
def _distance(a, b):  # type: ignore[no-untyped-def]
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@step
def _sorted(xyz, axis):  # type: ignore[no-untyped-def]
    """Return the points' places along an axis, rising, and whose they are (Shell's sort with Ciura's gaps)."""
    n = xyz.shape[0]
    along, order = np.empty(n), np.empty(n, np.int64)
    for r in range(n):
        along[r], order[r] = xyz[r, axis], r
    for gap in (701, 301, 132, 57, 23, 10, 4, 1):
        for r in range(gap, n):
            value, row, at = along[r], order[r], r
            while at >= gap and along[at - gap] > value:
                along[at], order[at] = along[at - gap], order[at - gap]
                at -= gap
            along[at], order[at] = value, row
    return along, order


@step
def _longer(slots, rows, worth):  # type: ignore[no-untyped-def]
    """Return the columns of the pairs with twice the room."""
    n = slots.shape[0]
    more = np.empty(2 * n, np.int64), np.empty(2 * n, np.int64), np.empty(2 * n)
    for k in range(n):
        more[0][k], more[1][k], more[2][k] = slots[k], rows[k], worth[k]
    return more
