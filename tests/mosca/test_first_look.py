"""A recording's first frame sets are measured with what its cameras err by, not with the guess of a setting."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import ring

from mosca import pipeline
from mosca.camera.projection import project
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rig import MoscaLens, Rig
from mosca.detection.scheduler import LOOK_SETS
from mosca.pipeline import PipelineSettings, run_seen

RIG = ring(4, MoscaLens(8.0, 330.0, 240.0, 0.01, 0.01, -0.006, 1e-3, -1.5e-5, 0, 1e-4, 5e-5), height_m=0.8)
SIGMA_PX = 0.01
"""All that the images err by; the setting guesses 0.06 px besides."""


def seen(sets):
    """Frame sets with the images of 40 points on circles, and the points (sets, 40, 3) [m]."""
    rng = np.random.default_rng(2)
    centre, phase = rng.uniform(-0.4, 0.4, (40, 3)), rng.uniform(0, 2 * np.pi, 40)
    angle = phase + 0.05 * np.arange(sets)[:, None]
    xyz = centre + 0.05 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    out = []
    for k, now in enumerate(xyz):
        found = {}
        for camera in RIG.cameras:
            away = np.linalg.norm(now - camera.world_from_camera.translation, axis=1)
            found[camera.name] = Detections(
                camera.name, project(camera, now) + rng.normal(0, SIGMA_PX, (40, 2)),
                np.tile(SIGMA_PX**2 * np.eye(2), (40, 1, 1)), 8.0 / away, np.full(40, 100.0), np.ones(40),
            )  # fmt: skip
        out.append((FrameSet(k, 10_000_000 * k), found, 0.0))
    return out, xyz


def some(seen, which):
    """Return some detections of a camera."""
    columns = {name: getattr(seen, name) for name in Detections.__dataclass_fields__ if name != "camera"}
    return Detections(seen.camera, **{name: column[which] for name, column in columns.items()})


def nees(points, xyz):
    off = points.xyz[:, None] - xyz
    nearest = np.linalg.norm(off, axis=2).argmin(axis=1)
    off = off[np.arange(len(points)), nearest]
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(points.covariance), off).mean()


def test_the_first_points_state_what_they_err_by():
    sets, xyz = seen(40)
    steps = list(run_seen(sets, RIG, PipelineSettings()))
    assert [step.frame_set.pulse for step in steps] == list(range(40))
    assert all(len(step.points) == 40 for step in steps)
    # of 120 errors a set: within 0.4
    assert np.mean([nees(steps[k].points, xyz[k]) for k in range(3)]) == pytest.approx(3.0, abs=0.6)
    # the control, a live run: the first sets are taken for six times as uncertain
    live = list(run_seen(sets, RIG, PipelineSettings(lookahead=0)))
    assert nees(live[0].points, xyz[0]) < 0.5


@pytest.mark.parametrize("sets", [1, LOOK_SETS - 1])
def test_a_few_frame_sets_tell_too_little(sets):
    """They keep the setting's guess, as in a live run."""
    given = seen(sets)[0]
    ahead, live = (list(run_seen(given, RIG, PipelineSettings(lookahead=n))) for n in (64, 0))
    for one, other in zip(ahead, live, strict=True):
        np.testing.assert_array_equal(one.points.xyz, other.points.xyz)
        np.testing.assert_array_equal(one.points.covariance, other.points.covariance)


def test_fewer_than_four_frame_sets_teach_no_errors():
    for sets, learns in ((3, False), (4, True)):
        first, *_, last = run_seen(seen(sets)[0], RIG, PipelineSettings())
        assert (last.noise.sigma_px != first.noise.sigma_px).all() == learns


def test_errors_far_beyond_the_guess_are_learned_too(monkeypatch):
    """Measured as if the lenses had no distortion: images lie 1 px off, of three hardly any meet within the guess."""
    sets = [
        (frame_set, {name: some(one, slice(8, 16)) for name, one in found.items()}, s)
        for frame_set, found, s in seen(20)[0]
    ]
    rig = Rig(tuple(replace(camera, lens=MoscaLens(8.0, 330.0, 240.0, 0.01, 0.01)) for camera in RIG.cameras))
    steps = list(run_seen(sets, rig, PipelineSettings()))
    assert {tuple(step.points.n_cameras.tolist()) for step in steps} == {(4,) * 8}
    # the control: with the guess alone
    monkeypatch.setattr(pipeline, "COARSER_STARTS", (1.0,))
    assert sum((step.points.n_cameras > 2).sum() for step in run_seen(sets, rig, PipelineSettings())) <= 2


def test_chance_meetings_are_no_errors_far_beyond_the_guess(monkeypatch):
    """Of two cameras the calibrations stand swapped: the larger the errors supposed, the more rays meet by chance."""
    given = [camera.world_from_camera for camera in RIG.cameras]
    places = [given[1], given[0], *given[2:]]
    rig = Rig(tuple(replace(c, world_from_camera=one) for c, one in zip(RIG.cameras, places, strict=True)))

    def pairs(sets):
        steps = list(run_seen(sets, rig, PipelineSettings()))
        return sum(int((step.points.rays[:, 2:] >= 0).all(axis=1).sum()) for step in steps) / len(steps)

    kept = pairs(seen(20)[0])
    # the control: with the guess alone
    monkeypatch.setattr(pipeline, "COARSER_STARTS", (1.0,))
    assert kept >= 0.8 * pairs(seen(20)[0]) > 8.0
