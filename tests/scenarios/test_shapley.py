"""Shapley values against closed forms, against all orders by hand, and against SALib."""

from itertools import permutations

import numpy as np
import pytest

from scenarios.studies.budget.evaluate import Squares
from scenarios.studies.budget.intervals import BLOCKS, by_seed_and_block, interval95
from scenarios.studies.budget.shapley import Orders, exact_values


def game(players, value):
    return {mask: value([i for i in range(players) if mask >> i & 1]) for mask in range(1 << players)}


def test_an_additive_game_gives_each_player_its_own():
    worth = [3.0, 0.0, -1.5, 7.25]
    np.testing.assert_allclose(exact_values(game(4, lambda s: 2.0 + sum(worth[i] for i in s)), 4), worth, atol=1e-12)


def test_what_two_make_together_is_shared_between_them_by_hand():
    # v = 5 where 0 and 1 are both there, and 1 for player 2: by hand 2.5, 2.5, 1
    value = game(3, lambda s: 5.0 * (0 in s and 1 in s) + 1.0 * (2 in s))
    np.testing.assert_allclose(exact_values(value, 3), [2.5, 2.5, 1.0], atol=1e-12)


def test_the_glove_game_by_hand():
    # one left glove (0), two right ones (1, 2), a pair is worth 1: 2/3, 1/6, 1/6 (Shapley and Shubik 1969)
    value = game(3, lambda s: 1.0 * (0 in s and (1 in s or 2 in s)))
    np.testing.assert_allclose(exact_values(value, 3), [2 / 3, 1 / 6, 1 / 6], atol=1e-12)


@pytest.fixture
def any_game():
    rng = np.random.default_rng(5)
    return {mask: rng.normal(size=(2, 3)) for mask in range(1 << 5)}


def test_the_values_are_the_mean_over_all_orders(any_game):
    mean = np.zeros((5, 2, 3))
    orders = list(permutations(range(5)))
    for order in orders:
        mask = 0
        for i in order:
            mean[i] += (any_game[mask | 1 << i] - any_game[mask]) / len(orders)
            mask |= 1 << i
    np.testing.assert_allclose(exact_values(any_game, 5), mean, atol=1e-12)
    every = Orders(np.array(orders))
    np.testing.assert_allclose(every.values(any_game), mean, atol=1e-12)
    assert every.masks() == list(range(32))


def test_contributions_and_floor_add_up_to_the_whole(any_game):
    np.testing.assert_allclose(exact_values(any_game, 5).sum(axis=0) + any_game[0], any_game[31], atol=1e-12)


def test_salib_estimates_the_same():
    pytest.importorskip("SALib.analyze.shapley", reason="SALib 1.6 is not installed")
    rng = np.random.default_rng(3)
    worth = rng.normal(1.0, 1.0, 10)
    value = game(10, lambda s: sum(worth[i] for i in s) + 2.0 * (1 in s and 7 in s) - 1.0 * (4 in s))
    orders = Orders.drawn(10, 200, seed=1)
    assert sorted(orders.joined[0].tolist()) == list(range(10))
    effects, half = orders.by_salib(lambda mask: value[mask])
    np.testing.assert_allclose(effects, orders.values(value), atol=1e-9)
    exact = exact_values(value, 10)
    # a player without a share in the interaction has the same in all orders: an interval of no width
    assert half[0] == pytest.approx(0.0, abs=1e-6)
    assert (np.abs(effects - exact) <= 1.5 * half + 1e-9).all()
    assert effects.sum() == pytest.approx(value[1023] - value[0])


def test_more_players_than_exact_ones_without_salib_is_one_line(monkeypatch):
    import sys

    from mosca.errors import InputError

    monkeypatch.setitem(sys.modules, "SALib.analyze.shapley", None)
    with pytest.raises(InputError, match=r"need SALib.*pip install.*--sources"):
        Orders.drawn(9, 4)


def test_a_seeds_blocks_average_to_its_mean_square():
    rng = np.random.default_rng(0)
    runs = [Squares(rng.uniform(0, 2, 40), rng.integers(1, 9, 40).astype(float)) for _ in range(3)]
    found = by_seed_and_block(runs)
    assert found.shape == (3, BLOCKS)
    np.testing.assert_allclose(found.mean(axis=1), [one.sums.sum() / one.weights.sum() for one in runs])


@pytest.mark.parametrize(("seeds_sigma", "blocks_sigma"), [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_intervals_hold_the_mean_as_often_as_they_say(seeds_sigma, blocks_sigma):
    rng = np.random.default_rng(11)
    inside = 0
    for _ in range(600):
        own = rng.normal(size=(4, BLOCKS)) + seeds_sigma * rng.normal(size=(4, 1))
        low, high = interval95(own + blocks_sigma * rng.normal(size=(1, BLOCKS)))
        inside += low <= 0.0 <= high
    # on the safe side where only the cells differ; 0.95 within 3 standard errors of 600 draws elsewhere
    assert inside / 600 >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / 600)


def test_what_never_changes_has_an_interval_of_no_width():
    assert interval95(np.zeros((3, BLOCKS))) == (0.0, 0.0)
    assert interval95(np.ones((1, 1)), 0.5) == (0.5, 1.5)
