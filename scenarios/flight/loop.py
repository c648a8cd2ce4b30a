"""The loop of a flight: poses from frames arrive late or never, and the pilot steers by them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.camera.projection import cross_matrices
from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.rig import Rig
from mosca.data.rotations import rotation_from_quaternion
from mosca.errors import InputError
from mosca.pipeline import Step
from mosca.rigid_bodies.shared_errors import position_errors
from mosca.rigid_bodies.tracker import BodyTracker
from scenarios.flight.pilot import ArrivedPose, Pilot
from scenarios.spec.faults import WrongDelayFault
from scenarios.spec.scenario import Scenario
from twin.scenes.live_flight import LiveFlight
from twin.scenes.scene import Scene
from twin.streams import rng


def pilot_of(spec: Scenario, keeps_log: bool = True) -> Pilot:
    """Return the pilot of a scenario's ``[flight]``; ``keeps_log``: as in ``Pilot``."""
    assert spec.flight is not None
    shift_s = 0.0 if spec.flight.compensate else spec.flight.delay_s(spec.capture.exposure_s)
    if isinstance(spec.fault, WrongDelayFault):
        shift_s -= spec.fault.offset_s
    return Pilot(spec.flight, shift_s, spec.seed, keeps_log)


def check_flight_source(spec: Scenario, source: str) -> None:
    """Raise InputError where a flight in closed loop has another source of frames than the twin."""
    if spec.flight is not None and source != "twin":
        raise InputError(
            f"--source {source}: [flight] steers the twin's drone by what its frames give; frames of another source "
            "were taken before: run a scenario without it"
        )


def live_flight(scene: Scene) -> LiveFlight:
    """Return the flight of a scene that is steered while it is filmed."""
    assert isinstance(scene.configuration_at, LiveFlight)
    return scene.configuration_at


@dataclass(frozen=True, eq=False)
class PoseLink:
    """Delay and loss of poses on their way to the pilot."""

    spec: Scenario

    def send(
        self,
        pilot: Pilot,
        pulse: int,
        frame_s: float,
        position: Array,
        covariance: Array,
        now_s: float,
        lasting: Array | None = None,
    ) -> None:
        """Send the pose of a pulse, exposed at ``frame_s`` and not available before ``now_s`` [s].

        ``covariance``, ``lasting`` (none by default): as in ``ArrivedPose``.
        """
        flight = self.spec.flight
        assert flight is not None
        random = rng(self.spec.seed, "flight/link", pulse)
        lost, extra = random.uniform() < flight.dropout, random.exponential(flight.jitter_s)
        arrival_s = frame_s + flight.delay_s(self.spec.capture.exposure_s) - flight.jitter_s + extra
        out = flight.outage_s is not None and flight.outage_s[0] <= arrival_s < flight.outage_s[1]
        if not lost and not out:
            stays = np.zeros((3, 3)) if lasting is None else lasting
            pilot.receive(ArrivedPose(max(arrival_s, now_s), frame_s, position, covariance, stays))


class RenderedPoses:
    """Sends poses from the pipeline's steps to the pilot.

    ``body``: the drone's definition; ``rig``: the rig that measures its points; ``origin`` (3,): the steered point of
    the body, in its axes [m].
    """

    def __init__(self, spec: Scenario, scene: Scene, pilot: Pilot, bodies: Sequence[RigidBody], rig: Rig) -> None:
        (self._body,) = bodies
        self._tracker, self._rig = BodyTracker((self._body,)), rig
        self._origin = steered_point(scene)
        self._link, self._pilot, self._flight = PoseLink(spec), pilot, live_flight(scene)

    def attend(self, step: Step) -> None:
        """Take a step of the pipeline."""
        pulse, time_ns = step.frame_set.pulse, step.frame_set.time_ns
        found = self._tracker.update(step.points, pulse, time_ns).of(self._body.name)
        if len(found):
            position, covariance = at_point(found, self._origin)
            passing, lasting = split_errors(step, self._rig, self._body, found, position, covariance)
            frame_s = time_ns * 1e-9
            self._link.send(self._pilot, pulse, frame_s, position, passing, self._flight.now_s, lasting)


def split_errors(
    step: Step, rig: Rig, body: RigidBody, pose: BodyPoses, position: Array, covariance: Array
) -> tuple[Array, Array]:
    """Return the covariances of the passing and of the lasting errors (3, 3) [m^2] of a single pose's ``position``.

    ``covariance`` (3, 3): the stated covariance, for independent errors of all images. Where images were doubted, it
    is larger than by their errors, and both parts are enlarged likewise.
    """
    markers = np.asarray(body.positions) @ rotation_from_quaternion(pose.quaternion[0]).T + pose.position[0]
    if step.noise is None or not len(step.points):
        return covariance, np.zeros((3, 3))
    away = np.linalg.norm(markers[:, None] - step.points.xyz[None], axis=-1)
    nearest, gap = away.argmin(axis=1), body.distances()
    images = np.full((len(markers), len(rig.cameras), 2, 2), np.nan)
    for m in np.flatnonzero(away.min(axis=1) < gap[gap > 0].min() / 2):
        for c, camera in enumerate(rig.cameras):
            ray = int(step.points.rays[nearest[m], c])
            if ray >= 0:
                images[m, c] = step.detections[camera.name].covariance_px2[ray]
    errors = position_errors(rig, markers, position, images, step.noise.sigma_px)
    if errors is None:
        return covariance, np.zeros((3, 3))
    doubted = max(1.0, float(np.trace(covariance) / np.trace(errors.independent)))
    return doubted * errors.passing, doubted * errors.lasting


def steered_point(scene: Scene) -> Array:
    """Return the drone's origin (3,) [m] in its definition's frame (markers' middle, axes of the world at 0 s)."""
    sampler = scene.sampler()
    middle = sampler.at(0.0).marker_xyz.mean(axis=0)
    origin: Array = np.asarray(scene.configuration_at(0.0))[:3] - middle
    return origin


def at_point(pose: BodyPoses, point: Array) -> tuple[Array, Array]:
    """Return position (3,) [m] and covariance (3, 3) [m^2] of a body's ``point`` (3,), for a single pose."""
    arm = rotation_from_quaternion(pose.quaternion[0]) @ point
    by = np.hstack([np.eye(3), -cross_matrices(arm[None])[0]])
    return pose.position[0] + arm, by @ pose.covariance[0] @ by.T
