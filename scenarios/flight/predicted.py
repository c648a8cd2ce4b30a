"""Flights on poses that are drawn, not rendered: their covariance is predicted from the rig's geometry.

Fisher information of a pose from the images of its markers: each image adds J' J / s^2, with the Jacobian J of the
projection and s the standard deviation of an image coordinate (Luhmann et al., Close-Range Photogrammetry, 3rd ed.,
section 4.4). An error that all images of a camera share at an instant (a shaken body, the lens model's misfit in a
small part of the image) is one more unknown shift of each camera, with its variance as prior. The error of the
calibration is common to all poses of a flight and is drawn once for each flight.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mosca.camera.projection import cross_matrices, project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.machines.closed_loop.delay import DelayEstimate, estimate_delay
from scenarios.build.scene import build_scene
from scenarios.flight.loop import PoseLink, live_flight, pilot_of
from scenarios.flight.pilot import Pilot
from scenarios.score.flight import FlownPath, joined
from scenarios.spec.scenario import Scenario
from twin.scenes.live_flight import LiveFlight
from twin.streams import rng

_CELL_M = 0.05
"""Edge of the cells in which the covariance is constant: it changes by a few percent over a metre."""


@dataclass(frozen=True, eq=False)
class PoseNoise:
    """Errors of a rig's poses of a body."""

    rig: Rig
    markers: Array
    """(m, 3) markers from the body's origin, at the attitude of the start [m]."""
    sigma_px: Array
    """(m, c) standard deviation of an image coordinate; infinite where a camera does not see a marker [px]."""
    shared_px: Array
    """(c,) standard deviation, on each axis, of the error that all images of a camera share at an instant [px]."""
    calibration_m2: Array
    """(3, 3) covariance of the error that all poses share [m^2]."""
    _known: dict[tuple[float, float, float], Array] = field(default_factory=dict)

    def at(self, position: Array) -> Array:
        """Return the covariance (3, 3) [m^2] of a position measured at ``position`` (3,), to the nearest 5 cm."""
        cell = np.round(position / _CELL_M)
        key = (float(cell[0]), float(cell[1]), float(cell[2]))
        if key not in self._known:
            self._known[key] = self._computed(_CELL_M * cell)
        return self._known[key]

    def _computed(self, position: Array) -> Array:
        unknowns = 6 + 2 * len(self.rig.cameras)
        information = np.diag(np.concatenate([np.zeros(6), np.repeat(self.shared_px, 2) ** -2.0]))
        points, arms = position + self.markers, cross_matrices(self.markers)
        for c, camera in enumerate(self.rig.cameras):
            slope = project_with_jacobians(camera, points).by_point
            for arm, jacobian, sigma in zip(arms, slope, self.sigma_px[:, c], strict=True):
                if np.isfinite(sigma) and np.isfinite(jacobian).all():
                    row = np.zeros((2, unknowns))
                    row[:, :6] = np.hstack([jacobian, -jacobian @ arm])
                    row[:, 6 + 2 * c : 8 + 2 * c] = np.eye(2)
                    information += row.T @ row / sigma**2
        covariance: Array = np.linalg.pinv(information, hermitian=True)[:3, :3]
        if np.linalg.matrix_rank(information) < unknowns:
            raise InputError(f"flight: the cameras do not give a pose at {np.round(position, 3).tolist()} m")
        return covariance


@dataclass(frozen=True, eq=False)
class Flown:
    """A flight and the estimate of its delay."""

    path: FlownPath
    delay: DelayEstimate | None
    """None where the delay could not be estimated; ``delay_note`` states the reason."""
    delay_note: str = ""


def fly_predicted(spec: Scenario, folder: Path, noise: PoseNoise, with_delay: bool = True) -> Flown:
    """Return a flight on poses drawn from ``noise``, without rendering. ``with_delay``: to estimate the delay."""
    pilot = pilot_of(spec, with_delay)
    flight = live_flight(build_scene(spec, folder, pilot))
    link, random = PoseLink(spec), rng(spec.seed, "flight/pose_noise")
    common = random.multivariate_normal(np.zeros(3), noise.calibration_m2)
    for pulse in range(spec.capture.pulses):
        exposed_s = pulse / spec.capture.frame_rate_hz + 0.5 * spec.capture.exposure_s
        position = flight.position(exposed_s)
        if flight.crash:
            break
        covariance = noise.at(position)
        measured = position + common + random.multivariate_normal(np.zeros(3), covariance)
        link.send(pilot, pulse, exposed_s, measured, covariance, flight.now_s)
    if not flight.crash:
        flight.advance(spec.capture.duration_s)
    return flown(spec, pilot, flight, noise.calibration_m2, with_delay)


def flown(spec: Scenario, pilot: Pilot, flight: LiveFlight, calibration_m2: Array, with_delay: bool = True) -> Flown:
    """Return a finished flight with its delay; ``calibration_m2`` (3, 3): covariance of the error all poses share."""
    assert spec.flight is not None
    delay_s = spec.flight.delay_s(spec.capture.exposure_s)
    stated = [float(np.trace(one.covariance + one.lasting)) for one in pilot.arrived]
    path = joined(
        pilot.steps,
        calibration_m2=calibration_m2,
        pose_sigma_m=float(np.sqrt(np.mean(stated))) if stated else 0.0,
        true_delay_s=delay_s,
        believed_delay_s=delay_s - pilot.shift_s,
        crash=flight.crash,
        crashed_s=flight.crashed_s,
        scored_from_s=spec.flight.handover_s + spec.flight.settle_s,
    )
    if not with_delay:
        return Flown(path, None)
    try:
        return Flown(path, estimate_delay(pilot.log(), pilot.noise.correlation_s, pilot.noise.white))
    except InputError as error:
        return Flown(path, None, str(error))
