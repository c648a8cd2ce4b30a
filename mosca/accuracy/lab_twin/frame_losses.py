"""Frames that did not arrive: how many, and whether they are lost one by one or in bursts.

A frame is lost if its number is missing between the first and the last number that any camera sent. If frames are
lost one by one, a loss follows a loss as often as it follows a frame that arrived. In bursts of b frames, a run of
losses ends after b frames on average. A binomial test on the number of losses that follow a loss decides.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mosca.accuracy.lab_twin.estimates import ParameterEstimate, Told
from mosca.data.arrays import Array
from mosca.data.distributions import binom

BY_CHANCE = 1e-3
"""Losses are taken for bursts if the chance that losses one by one follow each other so often is below this."""


@dataclass(frozen=True, eq=False)
class FrameArrivals:
    """Lost and damaged frames of one camera in one recording."""

    lost: Array
    """(n,) bool, for each frame number of the recording."""
    corrupt: int
    """Number of frames that arrived damaged."""


def loss_estimates(camera: str, recordings: Sequence[FrameArrivals]) -> list[Told]:
    """Return the shares of a camera's frames that are lost and damaged, from all its recordings."""
    frames = sum(len(one.lost) for one in recordings)
    lost = sum(int(one.lost.sum()) for one in recordings)
    after = np.concatenate([one.lost[1:][one.lost[:-1]] for one in recordings] or [np.zeros(0, bool)])
    corrupt = sum(one.corrupt for one in recordings)
    share = lost / frames
    told: list[Told] = []
    followed, cases = int(after.sum()), len(after)
    if lost and cases and binom.sf(followed - 1, cases, share) < BY_CHANCE:
        length = max(round(1.0 / max(1.0 - followed / cases, 1.0 / cases)), 2)
        runs = max(lost / length, 1.0)
        sigma = share / math.sqrt(runs)
        why = f"{lost} of {frames} frames lost, in runs of {length} on average"
        told.append(ParameterEstimate(camera, "delivery.burst_share", share, sigma, why))
        told.append(ParameterEstimate(camera, "delivery.burst_frames", float(length), 0.0, why))
        told.append(ParameterEstimate(camera, "delivery.dropped_share", 0.0, 0.0, why))
    else:
        why = f"{lost} of {frames} frames lost"
        told.append(_share(camera, "delivery.dropped_share", lost, frames, why))
    told.append(
        _share(camera, "delivery.corrupt_share", corrupt, frames - lost, f"{corrupt} of {frames - lost} damaged")
    )
    return told


def arrived(numbers: Mapping[str, set[int]], damaged: Mapping[str, set[int]]) -> dict[str, FrameArrivals]:
    """Return each camera's lost and damaged frames, from the numbers of frames that arrived whole, and damaged."""
    every = set().union(*numbers.values(), *damaged.values())
    if not every:
        return {}
    span = range(min(every), max(every) + 1)
    return {
        name: FrameArrivals(np.array([n not in came and n not in damaged[name] for n in span]), len(damaged[name]))
        for name, came in numbers.items()
    }


def _share(camera: str, key: str, count: int, n: int, evidence: str) -> ParameterEstimate:
    """Return a share with the standard deviation of Jeffreys' posterior, which is above 0 also for a count of 0."""
    n = max(n, 1)
    a, b = count + 0.5, n - count + 0.5
    sigma = math.sqrt(a * b / ((a + b) ** 2 * (a + b + 1.0)))
    return ParameterEstimate(camera, key, count / n, sigma, evidence)
