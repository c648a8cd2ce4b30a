"""Keys of a scenario file: the model that is identified for a driven robot."""

from collections.abc import Iterable

from pydantic import Field

from mosca.data.files.toml import Positive, Table
from scenarios.spec.faults import LateCommandsFault
from scenarios.spec.scenes import RobotScene, SceneSpec

METRICS = tuple(f"{output}_{what}" for output in ("v_x", "yaw_rate") for what in ("rms", "nees", "fit_ratio"))
"""Metrics that only a scenario with ``[identification]`` has."""


class IdentificationSpec(Table):
    """``[identification]``: linear models from the commands to v_x and yaw rate, as of ``mosca identify``.

    Scored against the true velocities, and on another drive against the best linear model of the true motion.
    """

    most_order: int = Field(3, ge=1, le=6, description="orders from 1 to this are tried")
    unseen_s: Positive = Field(30.0, le=600, description="length of the drive that the model is tried on [s]")
    reference_s: Positive = Field(
        180.0, le=3600, description="length of the drives whose true motion gives the best linear model [s]"
    )


def check_identification(
    given: IdentificationSpec | None, scene: SceneSpec, limits: Iterable[str], bodies: bool, fault: Table | None
) -> None:
    """Raise ValueError where a scenario's keys and its ``[identification]`` cannot be combined."""
    if given is None:
        for name in limits:
            if name in METRICS:
                raise ValueError(f"limits.{name} needs a model; add [identification], or take the limit away")
        if isinstance(fault, LateCommandsFault):
            raise ValueError("fault.kind = 'late_commands' needs a model of the commands; add [identification]")
        return
    if not isinstance(scene, RobotScene) or scene.commands is not None:
        raise ValueError("[identification] needs scene.kind = 'robot' driven by noise; leave it out, or change that")
    if not bodies:
        raise ValueError("[identification] needs the robot's poses; set pipeline.bodies = true")
