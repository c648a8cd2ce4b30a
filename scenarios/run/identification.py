"""The robot of a scenario: its linear model, identified from the measured poses and the commands, and its scores."""

from pathlib import Path

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.errors import InputError
from mosca.machines.identification.deck import PAPER, poses_in_axes
from mosca.machines.identification.held_inputs import HeldInputs
from mosca.machines.identification.identify import IdentifiedModel, IdentifySettings, identify
from mosca.machines.identification.velocities import planar_path
from scenarios.build.scene import build_scene
from scenarios.score.identification import TrueDrive, driven_inputs, fit_scores, true_drive, velocity_scores
from scenarios.spec.faults import LateCommandsFault
from scenarios.spec.scenario import Scenario
from scenarios.types import Score
from twin.scenes.scene import Scene

DRIVE_S = 60.0
"""Length of each drive to which the best linear model is fitted: longer drives take no less time."""
DRIVE_SEED = 0x1DE7
"""Added to the scenario's seed, with the number of the drive; no model is fitted to the first drive."""


def check_source(spec: Scenario, source: str) -> None:
    """Raise InputError where a model is requested from frames that are not the twin's."""
    if spec.identification is not None and source != "twin":
        raise InputError(
            f"--source {source}: [identification] is scored against drives of the twin; run a scenario without it, "
            "and take tracks and commands to 'mosca identify'"
        )


def identified(
    spec: Scenario, folder: Path, poses: BodyPoses, bodies: tuple[RigidBody, ...], scene: Scene
) -> tuple[IdentifiedModel, dict[str, Score]]:
    """Return the model of the robot in ``poses``, and its scores."""
    assert spec.identification is not None
    (robot,) = bodies
    path = planar_path(poses_in_axes(poses, robot, PAPER), f"body '{robot.name}'")
    late = spec.fault.delay_s if isinstance(spec.fault, LateCommandsFault) else 0.0
    given = driven_inputs(scene, late)
    inputs = HeldInputs(given.names, given.time_s - int(path.time_ns[0]) * 1e-9, given.values)
    model = identify(path, inputs, IdentifySettings(most_order=spec.identification.most_order))
    scores = velocity_scores(model.velocities, scene, path.period_s)
    drives = max(1, round(spec.identification.reference_s / DRIVE_S))
    lengths = [spec.identification.unseen_s, *[spec.identification.reference_s / drives] * drives]
    unseen, *reference = (_drive(spec, folder, k, length) for k, length in enumerate(lengths))
    return model, scores | fit_scores(model, unseen, reference)


def _drive(spec: Scenario, folder: Path, number: int, duration_s: float) -> TrueDrive:
    """Return a drive with other noise of the same kind; it is not rendered."""
    other = spec.model_copy(
        update={
            "seed": spec.seed + DRIVE_SEED + number,
            "capture": spec.capture.model_copy(update={"duration_s": duration_s}),
        }
    )
    return true_drive(build_scene(other, folder), spec.capture.frame_rate_hz)
