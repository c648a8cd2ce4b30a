"""A loss of about 5 % planted in a stage is found against the committed baselines, and named; without it none is."""

from dataclasses import fields, replace

import numpy as np
import pytest

import mosca.pipeline
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import match
from reports.compare import regressions
from reports.record import read_record
from scenarios.run.scenario import run_scenario
from scenarios.spec.catalog import entries
from scenarios.suite.suite import BASELINES, baseline_path

NAME = "rigs/points_200"
FIVE_PERCENT = np.sqrt(1.05**2 - 1)
"""Noise, over that which is there, that makes errors 5 % larger."""


def noisy_detections(rng):
    """Detections with more noise than they and the cameras have."""

    def made(rig, detections, camera_sigma_px, target="point"):
        shaken = {}
        for camera, own_px in zip(rig.names, np.broadcast_to(camera_sigma_px, len(rig.names)), strict=True):
            seen = detections[camera]
            sigma = np.sqrt(np.trace(seen.covariance_px2, axis1=1, axis2=2) / 2 + own_px**2)
            noise = FIVE_PERCENT * sigma[:, None] * rng.normal(size=seen.xy_px.shape)
            shaken[camera] = replace(seen, xy_px=seen.xy_px + noise)
        return make_ray_table(rig, shaken, camera_sigma_px, target)

    return "make_ray_table", made


def after_match(change):
    """Points changed by a function of them."""
    return "match", lambda *arguments: change(match(*arguments))


def noisy_points(rng):
    """Points with more noise than they state."""

    def shaken(points):
        noise = [rng.multivariate_normal(np.zeros(3), FIVE_PERCENT**2 * c) for c in points.covariance]
        return replace(points, xyz=points.xyz + np.reshape(noise, (-1, 3)))

    return after_match(shaken)


def lost_points(rng):
    """One point of 20 is lost."""

    def kept(points):
        rows = rng.random(len(points)) >= 0.05
        return replace(points, **{f.name: getattr(points, f.name)[rows] for f in fields(points)})

    return after_match(kept)


def bragging(_rng):
    """Standard deviations are stated 5 % too small."""
    return after_match(lambda points: replace(points, covariance=points.covariance / 1.05**2))


def shifted_camera(_rng):
    """One camera's principal point is off by a fiftieth of a pixel."""

    def made(rig, detections, camera_sigma_px, target="point"):
        name = rig.names[0]
        moved = replace(detections[name], xy_px=detections[name].xy_px + [0.02, 0.0])
        return make_ray_table(rig, {**detections, name: moved}, camera_sigma_px, target)

    return "make_ray_table", made


def run():
    (entry,) = (e for e in entries(()) if e.name == NAME)
    return run_scenario(entry.spec, entry.name, entry.path.parent).record


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "worse"),
    [
        (None, set()),
        (noisy_detections, {"position_rms", "reprojection_rms"}),
        (noisy_points, {"position_rms"}),
        (lost_points, {"completeness"}),
        (bragging, {"nees"}),
        (shifted_camera, {"position_rms"}),
    ],
)
def test_a_loss_of_five_per_cent_is_named(plant, worse, monkeypatch):
    if plant is not None:
        monkeypatch.setattr(mosca.pipeline, *plant(np.random.default_rng(0)))
    record, baseline = run(), read_record(baseline_path(NAME, BASELINES))
    found = {r.name: r.share for r in regressions(record, baseline)}
    assert found.keys() >= worse
    assert bool(found) == bool(worse)
    assert all(found[name] < 0.2 for name in worse)
