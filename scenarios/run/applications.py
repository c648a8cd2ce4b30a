"""What a scenario's sections make of its tracks: a skeleton, labels of a face, modes of a panel, a robot's model."""

from dataclasses import dataclass, field
from pathlib import Path

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.identification.identify import IdentifiedModel
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.vibration.analysis import Vibration
from scenarios.run.identification import identified
from scenarios.run.labels import surface_labels
from scenarios.run.people import Person, person_of
from scenarios.run.timed import timed
from scenarios.run.vibration import vibration_of
from scenarios.score.reference import ReferenceTrajectories
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected, Score
from twin.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Applications:
    """Results of a scenario's sections; None where it has no such section, or the tracks are empty."""

    person: Person | None = None
    """[skeleton]"""
    named: Tracks | None = None
    """[labels]"""
    vibration: Vibration | None = None
    """[vibration]"""
    model: IdentifiedModel | None = None
    """[identification]"""
    model_scores: dict[str, Score] = field(default_factory=dict)
    """Of the model."""


def applications(
    spec: Scenario,
    folder: Path,
    collected: Collected,
    truth: Truth | ReferenceTrajectories | None,
    movement: MarkerFrames | None,
    bodies: tuple[RigidBody, ...],
    poses: BodyPoses | None,
    scene: Scene | None,
    timings: dict[str, float],
) -> Applications:
    """Return what the sections of ``spec`` ask for.

    ``movement``: labelled markers to which a skeleton is fitted; ``poses`` of the rigid ``bodies`` in the tracks;
    ``scene``: the twin's.
    """
    person: Person | None = None
    named: Tracks | None = None
    vibration: Vibration | None = None
    model: IdentifiedModel | None = None
    model_scores: dict[str, Score] = {}
    if spec.skeleton is not None and isinstance(truth, Truth) and len(collected.tracks):
        with timed(timings, "skeleton"):
            person = person_of(spec, collected.tracks, truth, movement)
    if spec.labels is not None:
        with timed(timings, "labels"):
            named = surface_labels(spec, folder, collected.tracks)
    if spec.vibration is not None:
        with timed(timings, "vibration"):
            vibration = vibration_of(spec, collected)
    if spec.identification is not None and poses is not None and scene is not None:
        with timed(timings, "identification"):
            model, model_scores = identified(spec, folder, poses, bodies, scene)
    return Applications(person, named, vibration, model, model_scores)
