"""What a scenario's sections make of its tracks: a person's skeleton, labels of a face, modes of a panel."""

import logging
import time
from dataclasses import dataclass
from pathlib import Path

from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.vibration.analysis import Vibration
from scenarios.run.labels import surface_labels
from scenarios.run.people import Person, person_of
from scenarios.run.vibration import vibration_of
from scenarios.score.reference import ReferenceTrajectories
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected

LOG = logging.getLogger("scenarios.run.scenario")
"""A run's stages are logged under one name."""


@dataclass(frozen=True, eq=False)
class Applications:
    """Results of a scenario's sections; None where it has no such section, or the tracks are empty."""

    person: Person | None = None
    """[skeleton]"""
    named: Tracks | None = None
    """[labels]"""
    vibration: Vibration | None = None
    """[vibration]"""


def applications(
    spec: Scenario,
    folder: Path,
    collected: Collected,
    truth: Truth | ReferenceTrajectories | None,
    movement: MarkerFrames | None,
    timings: dict[str, float],
) -> Applications:
    """Return what the sections of ``spec`` ask for; ``movement``: labelled markers to which a skeleton is fitted."""
    person: Person | None = None
    named: Tracks | None = None
    vibration: Vibration | None = None
    if spec.skeleton is not None and isinstance(truth, Truth) and len(collected.tracks):
        with timed(timings, "skeleton"):
            person = person_of(spec, collected.tracks, truth, movement)
    if spec.labels is not None:
        with timed(timings, "labels"):
            named = surface_labels(spec, folder, collected.tracks)
    if spec.vibration is not None:
        with timed(timings, "vibration"):
            vibration = vibration_of(spec, collected)
    return Applications(person, named, vibration)


class timed:
    """Adds the seconds of a block to a dictionary, and logs them."""

    def __init__(self, timings: dict[str, float], name: str) -> None:
        self._timings, self._name = timings, name

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *exc: object) -> None:
        self._timings[self._name] = time.perf_counter() - self._start
        LOG.info("%s: %.2f s", self._name, self._timings[self._name])
