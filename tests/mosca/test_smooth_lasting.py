"""Errors that last beside a gap are not averaged away in it."""

import numpy as np
import pytest
from track_points import made_tracks

from mosca.data.tracks import Tracks
from mosca.smoothing.gap_filling import CHI2_95, filled
from mosca.smoothing.rts import SmoothSettings

RATE, SIGMA_M, HIDDEN_M = 100.0, 2e-4, 2e-3


def track_with_gaps(rng: np.random.Generator, told: bool) -> tuple[Tracks, np.ndarray]:
    """Return a swinging target's track with gaps of 3 frames, half hidden for 6 frames on both sides of each.

    Half hidden, its error is the same all the time, 2 mm an axis; ``told``: its covariance includes that.
    """
    frame = np.arange(600)
    t = frame / RATE
    truth = np.stack([0.3 * np.sin(4 * t), 0.1 * np.cos(3 * t), 1 + 0.2 * np.sin(2.5 * t)], axis=1)
    error = rng.normal(0, SIGMA_M, truth.shape)
    sigma = np.full(len(frame), SIGMA_M)
    seen = np.ones(len(frame), bool)
    for start in range(60, 560, 60):
        for side in (slice(start - 6, start), slice(start + 3, start + 9)):
            error[side] += rng.normal(0, HIDDEN_M, 3)
            if told:
                sigma[side] = np.hypot(SIGMA_M, HIDDEN_M)
        seen[start : start + 3] = False
    # a second track shows all instants
    both = made_tracks(
        np.append(frame[seen], frame),
        np.repeat([0, 1], [seen.sum(), len(frame)]),
        np.concatenate([(truth + error)[seen], truth + 1]),
        covariance=np.eye(3) * np.append(sigma[seen], np.full(len(frame), SIGMA_M))[:, None, None] ** 2,
    )
    return both, truth


@pytest.mark.parametrize(("told", "least", "most"), [(True, 0.8, 1.0), (False, 0.0, 0.6)])
def test_coverage_beside_half_hidden_images(told: bool, least: float, most: float) -> None:
    """With covariances that include it nine of ten samples are covered; the control, without, is not."""
    covered = []
    for seed in range(6):
        tracks, truth = track_with_gaps(np.random.default_rng(seed), told)
        together = filled(tracks, SmoothSettings())
        fills = together.select(together.status == "filled")
        assert len(fills) == 27
        away = fills.xyz - truth[fills.frame]
        squares = np.einsum("ni,nij,nj->n", away, np.linalg.inv(fills.covariance), away)
        covered.append(np.mean(squares < CHI2_95))
    assert least <= np.mean(covered) <= most, covered
