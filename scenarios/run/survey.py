"""The survey flight within a run: prepared before the rig's take, watched during it, scored after it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.frames import FrameSource
from mosca.errors import InputError
from scenarios.run.timed import timed
from scenarios.session.estimated import SessionCalibration
from scenarios.spec.scenario import Scenario
from twin.cameras.virtual_camera import VirtualCamera

if TYPE_CHECKING:
    from mosca.diagnostics.light_marker.window import LampWatch
    from scenarios.score.self_orientation import SelfOrientationScores
    from scenarios.session.self_orientation import Prepared


def check_source(spec: Scenario, source: str) -> None:
    """Raise InputError where a self-orientation is requested from frames that are not the twin's."""
    if spec.self_orientation is not None and source != "twin":
        raise InputError(
            f"--source {source}: [self_orientation] is scored against the twin's flight; run a scenario without it, "
            "and take the drone's recording to 'mosca self-orient'"
        )


class Survey:
    """A scenario's survey flight."""

    def __init__(self, spec: Scenario, prepared: Prepared, rig: SessionCalibration, workers: int) -> None:
        self._spec, self.prepared, self._rig, self._workers = spec, prepared, rig, workers
        self._watch: LampWatch | None = None

    def watched(self, source: FrameSource) -> FrameSource:
        """Return the rig's source, watched for the lamp."""
        from scenarios.session.self_orientation import watched

        self._watch = watched(source, self.prepared, self._rig)
        return self._watch

    def scored(
        self, poses: BodyPoses, bodies: tuple[RigidBody, ...], timings: dict[str, float]
    ) -> SelfOrientationScores:
        """Fly, compare both sides, and score them."""
        from scenarios.score.self_orientation import self_orientation_scores
        from scenarios.session.self_orientation import self_orientation

        assert self._watch is not None
        with timed(timings, "self_orientation"):
            found = self_orientation(self._spec, self.prepared, self._watch, poses, bodies, self._rig, self._workers)
        with timed(timings, "error_budget"):
            return self_orientation_scores(self._spec, found)


def surveyed(
    spec: Scenario,
    cameras: tuple[VirtualCamera, ...],
    rig: SessionCalibration | None,
    workers: int,
    timings: dict[str, float],
) -> Survey | None:
    """Return the survey of a scenario with ``[self_orientation]``, prepared; None without."""
    if spec.self_orientation is None or rig is None:
        return None
    from scenarios.session.self_orientation import prepare

    with timed(timings, "camera_calibration"):
        return Survey(spec, prepare(spec, cameras, rig, workers), rig, workers)
