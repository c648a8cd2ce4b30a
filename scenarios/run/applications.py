"""Results of a scenario's sections from its tracks: skeleton, labels, modes, a robot's model, virtual objects."""

from dataclasses import dataclass, field
from pathlib import Path

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.machines.identification.identify import IdentifiedModel
from mosca.machines.vibration.analysis import Vibration
from reports.viewer import RerunLog
from scenarios.run.identification import identified
from scenarios.run.labels import surface_labels
from scenarios.run.people import FitInputs, Person, person_of
from scenarios.run.timed import timed
from scenarios.run.vibration import vibration_of
from scenarios.run.virtual import virtual_objects
from scenarios.score.reference import ReferenceTrajectories
from scenarios.score.virtual_objects import shown_words
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected, Score
from scenarios.virtual.objects import ShownPoses
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
    """Scores of the model."""
    shown: ShownPoses | None = None
    """[virtual]"""


def applications(
    spec: Scenario,
    folder: Path,
    collected: Collected,
    truth: Truth | ReferenceTrajectories | None,
    fit_inputs: FitInputs | None,
    bodies: tuple[RigidBody, ...],
    poses: BodyPoses | None,
    scene: Scene | None,
    timings: dict[str, float],
    log: RerunLog | None,
) -> Applications:
    """Return the results of the sections of ``spec``.

    ``fit_inputs``: those of the skeleton; ``poses``: those of the rigid ``bodies`` in the tracks;
    ``scene``: that of the twin. ``log``: where virtual objects are shown.
    """
    person: Person | None = None
    named: Tracks | None = None
    vibration: Vibration | None = None
    model: IdentifiedModel | None = None
    model_scores: dict[str, Score] = {}
    shown: ShownPoses | None = None
    if fit_inputs is not None and isinstance(truth, Truth) and len(collected.tracks):
        with timed(timings, "skeleton"):
            person = person_of(spec, collected.tracks, truth, fit_inputs)
    if spec.labels is not None:
        with timed(timings, "labels"):
            named = surface_labels(spec, folder, collected.tracks)
    if spec.vibration is not None:
        with timed(timings, "vibration"):
            vibration = vibration_of(spec, collected)
    if spec.identification is not None and poses is not None and scene is not None:
        with timed(timings, "identification"):
            model, model_scores = identified(spec, folder, poses, bodies, scene)
    if spec.virtual is not None and bodies:
        with timed(timings, "virtual"):
            shown = virtual_objects(spec, folder, collected.tracks, bodies, log)
        collected.assembly.notes["virtual"] = shown_words(shown, None)
    return Applications(person, named, vibration, model, model_scores, shown)
