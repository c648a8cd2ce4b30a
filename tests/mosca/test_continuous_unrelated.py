"""Recordings that have nothing in common are not tied, whatever their points move like.

Camera 1 films one motion, camera 2 another one: no offset of their clocks is right.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from continuous_sessions import Motion, rig, seen_by, session
from scipy.stats import norm

from mosca.continuous.association import coarse_sync
from mosca.continuous.association.coarse_sync import log_chances, tied_clocks
from mosca.continuous.association.tracklets_2d import tracklets
from mosca.data.rig import Rig
from mosca.errors import InputError

PAIR, RATE_HZ, LENGTH_S, SEARCH_S = Rig(rig().cameras[:2]), 30.0, 2.0, 1.5
TAKES = 8


@dataclass(frozen=True)
class Together(Motion):
    """A small body whose points move alike: what one ray meets by chance the others meet, too, and for as long."""

    def at(self, time_s):
        begin = super().at(np.zeros(1))
        return 0.1 * begin + (super().at(time_s) - begin)[:, :1]


def filmed(camera, motion):
    return seen_by(PAIR.cameras[camera], camera, LENGTH_S, True, motion, RATE_HZ)[0]


def is_tied(seen, cameras=PAIR) -> bool:
    try:
        tied_clocks(seen, [tracklets(one) for one in seen], cameras, SEARCH_S)
    except InputError:
        return False
    return True


def by_spread(votes, count):
    """The planted bug: scores as if independent, normally distributed and equally uncertain at all shifts."""
    score = votes.sum(axis=0) / np.maximum(count.sum(axis=0), 1)
    away = score - np.median(score)
    return norm.logsf(away / max(1.4826 * np.median(np.abs(away)), 0.005))


@pytest.mark.parametrize("motion", [Motion, Together])
def test_only_related_recordings_are_tied(motion):
    first = [filmed(0, motion(k)) for k in range(TAKES)]
    second = [filmed(1, motion(k)) for k in range(TAKES)]
    assert all(is_tied([a, b]) for a, b in zip(first[:4], second, strict=False))
    assert not any(is_tied([a, b]) for a, b in zip(first, second[1:], strict=False))


def test_scores_taken_as_normally_distributed_tie_some_of_them(monkeypatch):
    monkeypatch.setattr(coarse_sync, "log_chances", by_spread)
    first = [filmed(0, Together(k)) for k in range(TAKES)]
    second = [filmed(1, Together(k)) for k in range(TAKES)]
    assert any(is_tied([a, b]) for a, b in zip(first, second[1:], strict=False))


@pytest.mark.parametrize("order", [(1, 0, 2), (2, 1, 0), (0, 2, 1)])
def test_exchanged_cameras_are_refused(order):
    seen = session(LENGTH_S, rate_hz=RATE_HZ)[0]
    assert not is_tied(seen, Rig(tuple(rig().cameras[k] for k in order)))


def test_chances_of_parts_are_those_of_their_ranks():
    """Best of 50 in one part of two: 1 / 50; in both: chi-square of four degrees at 4 ln 50, (1 + 2 ln 50) / 50^2."""
    votes = np.array([np.arange(50.0), np.arange(50.0)])
    both = log_chances(votes, np.ones((2, 50)))
    assert both[-1] == pytest.approx(np.log((1 + 2 * np.log(50)) / 50**2))
    # where a camera did not run in a part, that part says nothing
    count = np.ones((2, 50))
    count[1, 40:] = 0.0
    assert log_chances(votes * count, count)[-1] == pytest.approx(np.log(1 / 50))
