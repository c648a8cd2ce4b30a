"""Search for hypotheses, which are sets of rays that meet: compiled steps of ``mosca.correspondence.match``.

For every pair of rays in one epipolar plane, the search intersects the rays, judges the images by their sizes, adds
the nearest rays of the other cameras and leaves out an outlier. Rays are whitened (``mosca.data.rays.RayTable``), so
that errors are counted in standard deviations. A hypothesis with too many rays to be due to chance explains its rays:
no further one is searched for with them. So the work grows with the number of rays and not with that of their pairs.
A second pass searches for the remaining rays as far beside their epipolar lines as half-hidden targets may lie.
"""

from typing import Any, NamedTuple

import numpy as np

from mosca.camera.ray_table import LONG
from mosca.correspondence.circle_fit import FEWEST_ELLIPSES, ellipses
from mosca.correspondence.hypothesis import (
    MOST_ODD,
    NONE,
    ODD_SHIFT,
    ONCE,
    TWICE,
    acceptable,
    image_size,
    inside,
    judge_sizes,
    larger,
    largest_image,
    limit,
    new_hypothesis,
    no_hypotheses,
    solve,
    store,
    too_large,
    trust2_of,
    wholeness,
    with_capacity,
)
from mosca.correspondence.nearest_ray import RayIndex, nearest_ray
from mosca.correspondence.spatial_index import buckets, cells, plane_angles, within
from mosca.data.rays import ANGLE, FLAGS, RADIUS, SIGMA, SPREAD, WHITE
from mosca.numba_support.decorators import bare_step, inlined_step, step
from mosca.triangulation.triangulate import DEPTH, SHARE, TRUST

CERTAIN = 1e-3
"""Expected number of equally good hypotheses by chance below which a hypothesis explains its rays."""
PLAIN = 3.0
"""Standard deviations up to which a hypothesis that a track predicts is taken without a search for others."""
EDGE_ON = 0.5
"""Uncertainty of an epipolar plane's angle [rad] beyond which the ray is near the base and meets every plane."""


class SearchState(NamedTuple):
    """State of the search."""

    rays: RayIndex
    """Spatial index of each camera's rays."""
    slack: Any
    """(n,) factor on each ray's variance if its target were mostly hidden."""
    explained: Any
    """(n,) whether the ray belongs to a hypothesis that is not due to chance."""
    joined: Any
    """(n,) whether the ray belongs to a hypothesis of three or more rays."""
    partner: Any
    """(n, c) ray of camera c that a hypothesis of three or more rays has joined with ray n; -1: none."""


@step
def search(data, pairs, bases, start, xyz, covariance):
    """Return all hypotheses (``Hypotheses``) and how many there are.

    ``pairs``, ``bases``, ``start``: of the ``RayTable``. ``xyz`` (k, 3), ``covariance`` (k, 3, 3): predictions of the
    tracks, where hypotheses are tried first.
    """
    cameras, total, rules = data.views.shape[0], data.rays.shape[0], data.rules[0]
    kept, count = no_hypotheses(max(64, 2 * total // max(cameras, 1)), cameras), NONE
    state, hypothesis = _begun(data, start), new_hypothesis(cameras)
    for track in range(xyz.shape[0] if rules.typical_m > 0.0 else 0):
        size, error, diameter, chance = _expected(track, xyz, covariance, hypothesis, state, data)
        if size > 0:
            kept = with_capacity(kept, count)
            store(hypothesis, error, diameter, data.rays, count, kept)
            count += 1
            _note(hypothesis, chance, state, data)
    for stage in range(2 if rules.judge > 0.0 else 1):
        if stage == 1:
            # half-hidden targets: only for rays that the first stage has not joined in three cameras
            for i in range(total):
                state.explained[i] |= state.joined[i]
        for pair in range(pairs.shape[0]):
            if bases[pair, 0, 0] != np.inf:
                kept, count = _search_pair(
                    pairs[pair], bases[pair], stage, start, hypothesis, state, data, kept, count
                )
    return kept, count


@step
def _begun(data, start):
    """Return the state before the search."""
    cameras, total = data.views.shape[0], data.rays.shape[0]
    slack, reach = _slack(data.rays, start, data.rules[0])
    explained = np.empty(total, dtype=np.bool_)
    for i in range(total):
        explained[i] = not np.isfinite(data.rays[i, ANGLE])
    joined, partner = np.zeros(total, dtype=np.bool_), np.full((total, cameras), -1, dtype=np.int32)
    index = RayIndex(cells(data.rays, data.views, start), reach)
    return SearchState(index, slack, explained, joined, partner)


@step
def _search_pair(pair, across, stage, start, hypothesis, state, data, kept, count):
    """Add the hypotheses that begin with a ray of each of two cameras; returns the hypotheses and their number.

    ``across`` (2, 3): of ``RayTable.bases``. ``stage``: 1 searches for half-hidden targets, outside the gates of
    stage 0.
    """
    rays, gate = data.rays, data.rules[0].gate_sigma
    explained, slack, partner = state.explained, state.slack, state.partner
    a, b = pair[0], pair[1]
    active = np.empty(start[a + 1] - start[a] + start[b + 1] - start[b], dtype=np.int64)
    n_a = _unexplained(start[a], start[a + 1], explained, active, NONE)
    n_b = _unexplained(start[b], start[b + 1], explained, active, n_a) if n_a > 0 else NONE
    if n_b == 0:
        return kept, count
    angle, variance, half = np.empty(n_a + n_b), np.empty(n_a + n_b), np.empty(n_a + n_b)
    plane_angles(rays, active[: n_a + n_b], across, angle, variance)
    for n in range(n_a + n_b):
        half[n] = gate * np.sqrt(variance[n] * (slack[active[n]] if stage == 1 else 1.0))
        if not (half[n] < EDGE_ON and half[n] + abs(angle[n]) < np.pi):
            half[n] = np.inf
    gate_2 = 1.0 / gate**2
    line, found = buckets(angle[n_a : n_a + n_b], half[n_a : n_a + n_b]), np.empty(n_b, dtype=np.int64)
    width = max(line.step * (n_b + 1), 1e-300)
    for n in range(n_a):
        i = active[n]
        for f in range(within(line, angle[n], half[n], found)):
            if explained[i]:
                break
            m = n_a + found[f]
            j = active[m]
            if explained[j] or partner[i, b] == j:
                continue
            away2 = gate_2 * (angle[n] - angle[m]) ** 2
            if not np.isfinite(half[n] + half[m]):
                away2 = 0.0
            both = variance[n] + variance[m]
            if (away2 <= both) == (stage == 1) or (
                stage == 1 and away2 > slack[i] * variance[n] + slack[j] * variance[m]
            ):
                continue
            if not _meet(i, j, a, b, away2, variance[n], variance[m], hypothesis, data):
                continue
            chance = n_a * n_b * min(1.0, 2.0 * gate * np.sqrt(both) / width)
            size, error, diameter, chance = _grown(a, b, chance, hypothesis, state, data)
            if size == 0:
                continue
            kept = with_capacity(kept, count)
            store(hypothesis, error, diameter, rays, count, kept)
            count += 1
            if size > 2:
                _note(hypothesis, chance, state, data)
    return kept, count


@inlined_step
def _expected(track, xyz, covariance, hypothesis, state, data):
    """Join the rays nearest to a track's prediction; return what ``_grown`` does.

    The hypothesis is judged like any other; the track only saves the search. Nothing is found (size 0) where the
    hypothesis is doubtful and must compete with others: where its rays meet poorly, may meet by chance, or are not
    the nearest to their point.
    """
    members, ranks, values, _ = hypothesis
    rules, cameras = data.rules[0], data.views.shape[0]
    for p in range(3):
        values[p] = xyz[track, p]
        for q in range(3):
            values[3 + 3 * p + q] = covariance[track, p, q]
    size, chance, doubtful = NONE, float(xyz.shape[0]), False
    for c in range(cameras):
        k, trust, share, admitted = nearest_ray(c, rules.typical_m, state.rays, values, data)
        members[c], ranks[c, TRUST] = k, trust
        if k >= 0:
            if state.explained[k]:
                return 0, 0.0, 0.0, 1.0
            size += 1
            chance *= min(1.0, share)
            doubtful |= admitted > 1
    if size < 3 or size < rules.minimum_cameras or not chance < CERTAIN:
        return 0, 0.0, 0.0, 1.0
    # nearest_ray has set the trusts of round images by their sizes, since the typical one is known
    flat = rules.discs > 0 and ellipses(members, data.rays) >= FEWEST_ELLIPSES
    diameter = judge_sizes(hypothesis, data)[0] if flat else 0.0
    error = solve(hypothesis, TWICE, data)
    if not 0.0 <= error <= limit(2 * size - 3, PLAIN):
        return 0, 0.0, 0.0, 1.0
    if not flat:
        diameter = largest_image(members, values, data)[0]
    if not acceptable(hypothesis, size, error, data):
        return 0, 0.0, 0.0, 1.0
    for c in range(cameras if doubtful else 0):
        if members[c] != nearest_ray(c, rules.typical_m, state.rays, values, data)[0]:
            return 0, 0.0, 0.0, 1.0
    return size, error, diameter, chance


@inlined_step
def _note(hypothesis, chance, state, data):
    """Record which rays a hypothesis joins, and whether it explains them because it is not due to chance.

    Images that are less than half visible agree with many others: in some takes, once with two that met by chance.
    """
    members, ranks, values, _ = hypothesis
    explained, partner = state.explained, state.partner
    cameras, plain = members.shape[0], NONE
    for c in range(cameras):
        plain += members[c] >= 0 and wholeness(members[c], ranks[c, TRUST], data.rays) > 0.0
    for c in range(cameras):
        k = members[c]
        if k < 0:
            continue
        # an image of two targets may belong to another hypothesis too
        if not too_large(k, c, values, data):
            state.joined[k] = True
            explained[k] |= chance < CERTAIN and plain > 2
        for d in range(0 if explained[k] else cameras):
            if members[d] >= 0:
                partner[k, d] = members[d]


@step
def _slack(rays, start, rules):
    """Return the rays' factors (n,) on variance for mostly hidden targets, and the largest variances (c,) with them.

    The latter are those of a ray's direction [rad^2], one for each camera.
    """
    slack, reach = np.ones(rays.shape[0]), np.zeros(start.shape[0] - 1)
    for c in range(reach.shape[0]):
        for i in range(start[c], start[c + 1]):
            if not np.isfinite(rays[i, ANGLE]):
                continue
            if rules.judge > 0.0 or rays[i, FLAGS] % LONG > 0.0:
                slack[i] = 1.0 + 0.5 * (ODD_SHIFT * MOST_ODD * rays[i, RADIUS] / rays[i, SIGMA]) ** 2
            variance = 0.0
            for p in range(6):
                variance += rays[i, SPREAD + p] ** 2
            reach[c] = max(reach[c], variance * slack[i])
    return slack, reach


@bare_step
def _unexplained(first, last, explained, active, at):
    """Write the rays that no hypothesis explains into ``active`` from ``at`` on; return how many."""
    n = 0
    for i in range(first, last):
        if not explained[i]:
            active[at + n] = i
            n += 1
    return n


@inlined_step
def _meet(i, j, a, b, away2, variance_i, variance_j, hypothesis, data):
    """Begin a hypothesis with the rays i and j of cameras a and b; False where they do not meet."""
    members, ranks, solved, _ = hypothesis
    rays, views, rules = data.rays, data.views, data.rules[0]
    d0, d1, d2 = rays[i, 0], rays[i, 1], rays[i, 2]
    e0, e1, e2 = rays[j, 0], rays[j, 1], rays[j, 2]
    x = views[b, 0] - views[a, 0]
    y = views[b, 1] - views[a, 1]
    z = views[b, 2] - views[a, 2]
    cosine = d0 * e0 + d1 * e1 + d2 * e2
    along_d, along_e = d0 * x + d1 * y + d2 * z, e0 * x + e1 * y + e2 * z
    sine2 = 1.0 - cosine * cosine
    if not sine2 > 1e-12:
        return False
    s, t = (along_d - cosine * along_e) / sine2, (cosine * along_d - along_e) / sine2
    if not (s > 0.0 and t > 0.0):
        return False
    size_i, size_j = rays[i, ANGLE] * s, rays[j, ANGLE] * t
    whole = rules.typical_m if rules.typical_m > 0.0 else larger(i, size_i, j, size_j, rays)
    trust_i = trust2_of(i, size_i, whole, rays, rules.judge, rules)
    trust_j = trust2_of(j, size_j, whole, rays, rules.judge, rules)
    if away2 > variance_i / trust_i + variance_j / trust_j:
        return False
    for c in range(members.shape[0]):
        members[c], ranks[c, TRUST] = -1, 1.0
    members[a], members[b] = i, j
    ranks[a, TRUST], ranks[b, TRUST] = np.sqrt(trust_i), np.sqrt(trust_j)
    solved[0] = 0.5 * (views[a, 0] + s * d0 + views[b, 0] + t * e0)
    solved[1] = 0.5 * (views[a, 1] + s * d1 + views[b, 1] + t * e1)
    solved[2] = 0.5 * (views[a, 2] + s * d2 + views[b, 2] + t * e2)
    error = solve(hypothesis, ONCE, data)
    if not 0.0 <= error <= rules.gate_sigma**2:
        return False
    return inside(solved, rules)


@inlined_step
def _grown(a, b, chance, hypothesis, state, data):
    """Extend a pair to all cameras, drop outliers and judge the hypothesis.

    Returns its number of rays (0: rejected), its squared error, its diameter [m] and the expected number of equally
    good hypotheses by chance.
    """
    members, ranks, values, _ = hypothesis
    rules, cameras = data.rules[0], members.shape[0]
    i, j = members[a], members[b]
    size_i, size_j = image_size(i, a, values, data), image_size(j, b, values, data)
    seen = larger(i, size_i, j, size_j, data.rays)
    whole = rules.typical_m if rules.typical_m > 0.0 else seen
    size = TWICE
    for c in range(cameras):
        if c in (a, b):
            continue
        nearest, trust, share, _ = nearest_ray(c, whole, state.rays, values, data)
        if nearest >= 0:
            members[c], ranks[c, TRUST], ranks[c, SHARE] = nearest, trust, share
            size += 1
    diameter, _ = judge_sizes(hypothesis, data)
    error = solve(hypothesis, TWICE, data)
    while size > 2 and not 0.0 <= error <= limit(2 * size - 3, rules.outlier_sigma):
        # an outlier pulls the point towards itself: judge each by the error that remains without it
        at = worst_ray(hypothesis, data) if error >= 0.0 else -1
        if at < 0:
            return 0, 0.0, 0.0, 1.0
        members[at] = -1
        size -= 1
        # if one of three rays is wrong, this pair or another is right: each is a hypothesis of its own
        if size == 2 and at in (a, b):
            return 0, 0.0, 0.0, 1.0
        error = solve(hypothesis, TWICE, data)
    if size > 2 and (members[a] < 0 or members[b] < 0) and _joined(members, state.partner):
        return 0, 0.0, 0.0, 1.0
    if size < rules.minimum_cameras or not acceptable(hypothesis, size, error, data):
        return 0, 0.0, 0.0, 1.0
    added = 0
    for c in range(cameras):
        if members[c] >= 0 and c != a and c != b:
            # the added rays may be of any of the other cameras: count the choices
            chance *= min(1.0, ranks[c, SHARE]) * (cameras - 2 - added) / (added + 1)
            added += 1
    return size, error, diameter, chance


@inlined_step
def worst_ray(hypothesis, data):
    """Return the camera whose ray, if left out, lowers the hypothesis's squared error most.

    The decrease is e' (I - H)^-1 e with the ray's whitened error e and its leverage H = A P A'. It is exact for fixed
    depths, for which the problem is linear (Cook and Weisberg 1982, section 2.2).
    """
    members, ranks, solved, _ = hypothesis
    rays, views = data.rays, data.views
    worst, at = -1.0, -1
    for c in range(members.shape[0]):
        k = members[c]
        if k < 0:
            continue
        scale = ranks[c, TRUST] / ranks[c, DEPTH]
        e0 = e1 = h00 = h01 = h11 = 0.0
        for p in range(3):
            m0, m1 = scale * rays[k, WHITE + p], scale * rays[k, WHITE + 3 + p]
            e0 += m0 * (solved[p] - views[c, p])
            e1 += m1 * (solved[p] - views[c, p])
            for q in range(3):
                shared = scale * solved[3 + 3 * p + q]
                h00 += m0 * rays[k, WHITE + q] * shared
                h01 += m0 * rays[k, WHITE + 3 + q] * shared
                h11 += m1 * rays[k, WHITE + 3 + q] * shared
        r00, r11 = 1.0 - h00, 1.0 - h11
        det = max(r00 * r11 - h01 * h01, 1e-12)
        lowered = (r11 * e0 * e0 + 2.0 * h01 * e0 * e1 + r00 * e1 * e1) / det
        if lowered > worst:
            worst, at = lowered, c
    return at


@inlined_step
def _joined(members, partner):
    """Whether the first two rays of a hypothesis are already joined in one of three rays or more."""
    first = -1
    for c in range(members.shape[0]):
        if members[c] >= 0:
            if first >= 0:
                return partner[first, c] == members[c]
            first = members[c]
    return False
