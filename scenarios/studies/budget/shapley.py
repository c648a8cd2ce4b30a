"""Shapley values: the share of each player in a game's value, over all orders in which players may join.

A coalition is a mask, bit i set where player i takes part. With k players, v the value and
w(s) = s! (k - s - 1)! / k!,

    phi_i = sum over S without i of w(|S|) (v(S + i) - v(S))

(Shapley 1953). The values sum to v(all) - v(none); a player that changes nothing has 0. Values may be arrays: the
formula is linear, so that seeds and blocks of a take have Shapley values of their own.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError

MOST_EXACT = 8
"""Largest number of players for which all 2^k coalitions are computed."""


def exact_values(values: Mapping[int, Array], players: int) -> Array:
    """Return the Shapley values (players, ...) of a game whose value is known for all 2^players masks."""
    shape = np.shape(values[0])
    phi = np.zeros((players, *shape))
    for mask in range(1 << players):
        size = mask.bit_count()
        for i in range(players):
            if not mask >> i & 1:
                phi[i] += (values[mask | 1 << i] - values[mask]) / (players * comb(players - 1, size))
    return phi


@dataclass(frozen=True, eq=False)
class Orders:
    """Orders (n, players) in which the players join, drawn by SALib, to estimate Shapley values of many players.

    Each order gives every player's change of the value; the mean over orders is unbiased (Castro et al. 2009).
    """

    joined: Array

    @classmethod
    def drawn(cls, players: int, count: int, seed: int = 0) -> "Orders":
        """Return ``count`` random orders. InputError where SALib is not installed."""
        sample = _salib()[0]
        rows = sample(_problem(players), count, seed=seed).reshape(count, players + 1, players)
        return cls((rows[:, 1:] != rows[:, :-1]).argmax(axis=2))

    def masks(self) -> list[int]:
        """Return the coalitions whose value is needed, each once."""
        return sorted({mask for order in self.joined.tolist() for mask in _growing(order)})

    def values(self, values: Mapping[int, Array]) -> Array:
        """Return the estimated Shapley values (players, ...)."""
        players = self.joined.shape[1]
        phi = np.zeros((players, *np.shape(values[0])))
        for order in self.joined.tolist():
            grown = _growing(order)
            for i, before, after in zip(order, grown, grown[1:], strict=False):
                phi[i] += (values[after] - values[before]) / len(self.joined)
        return phi

    def by_salib(self, value: Callable[[int], float]) -> tuple[Array, Array]:
        """Return Shapley values (players,) and the half-widths of their 95 % intervals over orders, by SALib.

        SALib's estimator (Goda 2021) is for a variance: a step from y to y' counts ((y' - y0)^2 - (y - y0)^2) / 2
        with y0 the output at the trajectory's start. With y0 = 0 at the empty coalition and y = sqrt(2 (v(S) -
        v(none))) that is v(S + i) - v(S). To avoid roots of negative numbers, an additive game c |S| is added, which
        adds c to the value of each player, and is subtracted again.
        """
        players = self.joined.shape[1]
        masks = [_growing(order) for order in self.joined.tolist()]
        floor = value(0)
        lift = max(0.0, *((floor - value(m)) / m.bit_count() for grown in masks for m in grown[1:]))
        squares = np.array([[value(m) - floor + lift * m.bit_count() for m in grown] for grown in masks])
        inputs = np.array([[[m >> i & 1 for i in range(players)] for m in grown] for grown in masks], float)
        found = _salib()[1](
            _problem(players), inputs.reshape(-1, players), np.sqrt(2 * np.maximum(squares, 0.0)).ravel()
        )
        return np.asarray(found["shapley"]) - lift, np.asarray(found["shapley_conf"])


def _growing(order: Sequence[int]) -> list[int]:
    """Return the coalitions of an order, from none to all."""
    masks = [0]
    for i in order:
        masks.append(masks[-1] | 1 << i)
    return masks


def _problem(players: int) -> dict[str, object]:
    return {"num_vars": players, "names": [str(i) for i in range(players)], "bounds": [[0.0, 1.0]] * players}


def _salib() -> tuple[Callable[..., Array], Callable[..., Mapping[str, Array]]]:
    try:
        from SALib.analyze.shapley import analyze
        from SALib.sample.shapley import sample
    except ImportError:
        raise InputError(
            f"budget: more than {MOST_EXACT} sources need SALib, which is not installed; run "
            "'pip install \"mosca-testbench[budget]\"', or name fewer sources with --sources"
        ) from None
    return sample, analyze
