"""Data association: the one-to-one assignment of greatest total score, connected component by component.

Most tracks have one point in their gate, which lies in no other gate: those need no search. The rest falls into small
groups that share no track and no point; each is solved by shortest augmenting paths (Jonker and Volgenant 1987).
``scipy.optimize.linear_sum_assignment`` is the same algorithm, but cannot be called from compiled code: a return to
Python in the middle of a frame set would wait for the GIL. Tests compare the two.
"""

import numpy as np

from mosca.numba_support.decorators import step
from mosca.numba_support.union_find import root_of, unite

FORBIDDEN = 1e12
"""Cost of a pair that is not allowed."""


@step
def best_pairs(left, right, score, n_left, n_right):
    """Return the left partner of each right (n_right,), or -1: one to one, with the greatest sum of ``score`` > 0.

    Pair k: ``left[k]``, ``right[k]``, ``score[k]``.
    """
    partner = np.full(n_right, -1, np.int64)
    root = np.arange(n_left + n_right)
    for k in range(left.shape[0]):
        unite(root, left[k], n_left + right[k])
    # pairs by component: a counting sort over the roots
    start = np.zeros(n_left + n_right + 1, np.int64)
    for k in range(left.shape[0]):
        start[root_of(root, left[k]) + 1] += 1
    for c in range(n_left + n_right):
        start[c + 1] += start[c]
    fill, order = start[:-1].copy(), np.empty(left.shape[0], np.int64)
    for k in range(left.shape[0]):
        c = root_of(root, left[k])
        order[fill[c]] = k
        fill[c] += 1
    row_of_left, column_of_right = np.full(n_left, -1, np.int64), np.full(n_right, -1, np.int64)
    for c in range(n_left + n_right):
        if start[c + 1] - start[c] == 1:
            k = order[start[c]]
            partner[right[k]] = left[k]
        elif start[c + 1] > start[c]:
            _solve(order[start[c] : start[c + 1]], left, right, score, row_of_left, column_of_right, partner)
    return partner


@step
def _solve(pairs, left, right, score, row_of_left, column_of_right, partner):
    """Solve one component; rows are its lefts, columns its rights and, for each row, a dummy for "unassigned"."""
    lefts, rights = np.empty(pairs.shape[0], np.int64), np.empty(pairs.shape[0], np.int64)
    n = m = 0
    for k in pairs:
        if row_of_left[left[k]] < 0:
            row_of_left[left[k]], lefts[n] = n, left[k]
            n += 1
        if column_of_right[right[k]] < 0:
            column_of_right[right[k]], rights[m] = m, right[k]
            m += 1
    cost = np.full((n, m + n), FORBIDDEN)
    for k in pairs:
        cost[row_of_left[left[k]], column_of_right[right[k]]] = -score[k]
    for r in range(n):
        cost[r, m + r] = 0.0
    row_of = _augment(cost)
    for c in range(m):
        if row_of[c] >= 0 and cost[row_of[c], c] < 0.1 * FORBIDDEN:
            partner[rights[c]] = lefts[row_of[c]]


@step
def _augment(cost):
    """Return the row of each column (-1: none) of the assignment of all rows with the least cost."""
    n, m = cost.shape
    u, v = np.zeros(n + 1), np.zeros(m + 1)
    row_of, way = np.zeros(m + 1, np.int64), np.zeros(m + 1, np.int64)
    for r in range(1, n + 1):
        row_of[0] = r
        at = 0
        least, used = np.full(m + 1, np.inf), np.zeros(m + 1, np.bool_)
        while True:
            used[at] = True
            row, delta, ahead = row_of[at], np.inf, 0
            for c in range(1, m + 1):
                if not used[c]:
                    reduced = cost[row - 1, c - 1] - u[row] - v[c]
                    if reduced < least[c]:
                        least[c], way[c] = reduced, at
                    if least[c] < delta:
                        delta, ahead = least[c], c
            for c in range(m + 1):
                if used[c]:
                    u[row_of[c]] += delta
                    v[c] -= delta
                else:
                    least[c] -= delta
            at = ahead
            if row_of[at] == 0:
                break
        while at != 0:
            row_of[at] = row_of[way[at]]
            at = way[at]
    return row_of[1:] - 1
