"""Findings from the residuals of curves: stamps that do not fit, ambiguous clocks, images of no marker."""

from dataclasses import replace

import numpy as np

from mosca.camera.projection import project
from mosca.continuous.association.associate import Associated
from mosca.continuous.estimator.estimate import ContinuousEstimate
from mosca.continuous.model.observations import Curves, TimedObservations
from mosca.continuous.resample import residuals_px
from mosca.data.arrays import Array
from mosca.data.rig import Rig

GROSS = 16.0
"""Largest squared residual, relative to the stated variance, that is used to test stamps."""
LATE_SIGMA, LATE_S = 8.0, 1e-4
"""Least time offset that is reported: in standard deviations, and in seconds."""
STEP_S = 1e-3
"""Half the step of the numerical derivative of an image position by time [s]."""
PASSES = 5


def on_curves_clock(found: TimedObservations, estimated: ContinuousEstimate) -> TimedObservations:
    """Return the observations with times on the clock of the estimated curves."""
    at, rate, row = (
        np.array([getattr(one, name) for one in estimated.clocks])[found.camera]
        for name in ("offset_s", "drift", "row_time_s")
    )
    return replace(found, time_s=at + (1.0 + rate) * found.time_s + row * found.xy_px[:, 1])


def late_cameras(curves: Curves, observations: TimedObservations, rig: Rig) -> tuple[str, ...]:
    """Return a line for each camera whose stamps, assumed right, do not fit the images: points lie ahead or behind.

    The delay is estimated from the residuals along the images' motion. Curves follow all cameras, so it is the least
    difference of a camera from the others.
    """
    rest = residuals_px(curves, observations, rig)
    lines = []
    for c, camera in enumerate(rig.cameras):
        own = np.flatnonzero((observations.camera == c) & np.isfinite(rest).all(axis=1))
        if not len(own):
            continue
        times, at = np.unique(observations.time_s[own], return_inverse=True)
        point = observations.point[own]
        before, after = (project(camera, curves.at(times + d)[at, point]) for d in (-STEP_S, STEP_S))
        flow = (after - before) / (2 * STEP_S)
        covariance = observations.covariance_px2[own]
        usable = np.isfinite(flow).all(axis=1)
        delay, sigma = _delay(rest[own][usable], flow[usable], covariance[usable])
        if abs(delay) > LATE_SIGMA * sigma and abs(delay) > LATE_S:
            lines.append(
                f"camera '{camera.name}': its images show points {1e3 * abs(delay):.2f} ms (+- {1.96e3 * sigma:.1g}) "
                f"{'after' if delay > 0 else 'before'} its stamps: estimate the clocks (--clocks own)"
            )
    return tuple(lines)


def _delay(rest: Array, flow: Array, covariance: Array) -> tuple[float, float]:
    """Return the delay [s] of residuals (n, 2) along the points' flow (n, 2) [px/s], and its standard deviation [s].

    Gross errors are left out, by the residuals that remain after the delay.
    """
    delay, sigma = 0.0, np.inf
    for _pass in range(PASSES):
        left = rest - delay * flow
        squared = np.einsum("ni,ni->n", left, np.linalg.solve(covariance, left[:, :, None])[:, :, 0])
        held = squared < GROSS
        weighed = np.linalg.solve(covariance[held], flow[held][:, :, None])[:, :, 0]
        known = float((weighed * flow[held]).sum())
        if known <= 0.0:
            break
        delay, sigma = float((weighed * rest[held]).sum()) / known, known**-0.5
    return delay, sigma


def association_findings(gathered: Associated, found: TimedObservations) -> tuple[str, ...]:
    """Return lines about problems with frames, clocks and image points."""
    lines = [
        f"camera '{name}': {count} of {gathered.count.frames[name]} frames without a usable image"
        for name, count in gathered.count.unusable.items()
    ]
    for one, tie in zip(gathered.seen, gathered.ties, strict=True):
        if tie.rival_s is not None:
            lines.append(
                f"camera '{one.info.name}': started {tie.offset_s:+.4f} s against the first camera, but "
                f"{tie.rival_s:+.4f} s fits about as well: the motion repeats itself; say how far apart "
                "cameras were started at most (--search), or film a clap"
            )
    for c, one in enumerate(gathered.seen):
        share = float(np.mean(found.camera == c)) * len(found) / max(len(one.xy_px), 1)
        if share < 0.5:
            lines.append(
                f"camera '{one.info.name}': only {100 * share:.0f} % of its {len(one.xy_px)} image points belong to "
                "a marker; look for reflections, or a camera that was moved"
            )
    return tuple(lines)
