"""Exchange of cameras against all subsets, and what it tells of markers against the planner's prediction."""

from itertools import combinations

import numpy as np
import pytest
from test_planning import PILLAR, cloud, ring, room

from mosca.accuracy.planning.exchange import exchanged, information_of, variances_of
from mosca.accuracy.planning.objective import predict


@pytest.fixture(scope="module")
def candidates():
    rows = np.concatenate([ring(12)[0], ring(6, height=1.2, radius=3.0)[0]])
    return rows, room(cloud(25), subject=True, obstacles=(PILLAR,))


def rms(variances):
    """Return log rms sigma of what is measured, and a price of what is not."""
    seen = np.isfinite(variances)
    return 0.5 * np.log(1e-15 + np.where(seen, variances, 0.0).mean(axis=1)) + 5.0 * (1 - seen.mean(axis=1))


def test_variances_are_the_predicted_ones(candidates):
    rows, where = candidates
    chosen = [0, 3, 7, 13]
    found = variances_of(information_of(rows, where), chosen)
    expected = predict(rows[chosen], where).sigma_m.T.ravel()
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(expected))
    seen = np.isfinite(expected)
    np.testing.assert_allclose(np.sqrt(found[seen]), expected[seen], rtol=1e-4)


def test_no_single_exchange_is_better_and_the_best_of_all_subsets_is_found(candidates):
    rows, where = candidates
    information = information_of(rows, where)
    places = rows[:, :3]

    def apart(others):
        return (np.linalg.norm(places[:, None] - places[others], axis=2) > 1.5).all(axis=1)

    def cost(chosen):
        return float(rms(variances_of(information, chosen)[None])[0])

    possible = [
        one for one in combinations(range(len(rows)), 4)
        if all(apart([k])[j] for k, j in combinations(one, 2))
    ]  # fmt: skip
    least = min(cost(list(one)) for one in possible)
    draw = np.random.default_rng(2)
    ends = []
    for _ in range(6):
        start = list(possible[draw.integers(len(possible))])
        chosen, value = exchanged(information, start, rms, apart)
        assert value <= cost(start)
        assert value == pytest.approx(cost(chosen))
        assert tuple(sorted(chosen)) in possible
        for place in range(4):
            others = chosen[:place] + chosen[place + 1 :]
            best = min(cost([*others, int(c)]) for c in np.flatnonzero(apart(others)))
            assert best > value - 1e-5
        ends.append(value)
    assert min(ends) == pytest.approx(least, abs=1e-5)


def test_what_costs_more_is_kept(candidates):
    rows, where = candidates
    information = information_of(rows, where)
    free = np.ones(len(rows), bool)
    without, _ = exchanged(information, [0, 3, 6, 9], rms, lambda others: free)
    forbidden = without[0]
    chosen, _ = exchanged(
        information, [0, 3, 6, 9], rms, lambda others: free, more=lambda chosen: 10.0 * (forbidden in chosen)
    )
    assert forbidden not in chosen
