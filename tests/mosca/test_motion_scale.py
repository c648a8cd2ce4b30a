"""Lengths and speeds come from the rig: a tank, a room and a hall of the same shape give the same tracks, scaled."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import ring
from track_points import points

from mosca.camera.projection import project
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rig import MoscaLens, Pose, Rig
from mosca.data.settings import TrackSettings
from mosca.data.tracks import table
from mosca.pipeline import PipelineSettings, run_seen
from mosca.tracking.motion_scale import FieldWidth, MotionScale, motion_scale

LENS = MoscaLens(8.0, 330.0, 240.0, 0.01, 0.01, -0.006, 1e-3, -1.5e-5, 0, 1e-4, 5e-5)
SIGMA_PX, STEP_S, PARTICLES = 0.05, 0.01, 40
ROOM = ring(4, LENS, height_m=0.5 + 0.7 * (np.arange(4) % 2))
"""Four cameras around a volume of about 1 m."""


def scaled(rig, scale):
    """The rig with all distances times ``scale``; of images of points scaled alike it has the same."""
    moved = [replace(c.world_from_camera, translation=scale * c.world_from_camera.translation) for c in rig.cameras]
    return Rig(tuple(replace(c, world_from_camera=pose) for c, pose in zip(rig.cameras, moved, strict=True)))


def particles(sets):
    """Positions (sets, PARTICLES, 3) [m] of particles on circles at 0.5 m/s, and diameters from 7 to 14 mm."""
    rng = np.random.default_rng(5)
    centre, phase = rng.uniform(-0.4, 0.4, (PARTICLES, 3)), rng.uniform(0, 2 * np.pi, (PARTICLES, 1))
    axes = np.linalg.qr(rng.normal(size=(PARTICLES, 3, 3)))[0]
    angle = phase + 0.5 * STEP_S / 0.1 * np.arange(sets)
    circle = 0.1 * (np.cos(angle)[..., None] * axes[:, None, 0] + np.sin(angle)[..., None] * axes[:, None, 1])
    return np.swapaxes(centre[:, None] + circle, 0, 1), 0.01 * np.exp2(rng.uniform(-0.5, 0.5, PARTICLES))


def images(sets, absent=0.0):
    """What the cameras see of the particles, set by set, and the particles' positions.

    ``absent``: share of the particles that no camera sees, others in each set.
    """
    rng = np.random.default_rng(6)
    xyz, diameter = particles(sets)
    seen = []
    for k, now in enumerate(xyz):
        there = np.flatnonzero(rng.random(PARTICLES) >= absent)
        n, found = len(there), {}
        for camera in ROOM.cameras:
            away = np.linalg.norm(now[there] - camera.world_from_camera.translation, axis=1)
            found[camera.name] = Detections(
                camera.name, project(camera, now[there]) + rng.normal(0, SIGMA_PX, (n, 2)),
                np.tile(SIGMA_PX**2 * np.eye(2), (n, 1, 1)), 800 * diameter[there] / away, np.full(n, 100.0),
                np.ones(n),
            )  # fmt: skip
        seen.append((FrameSet(k, round(1e9 * k * STEP_S)), found, 0.0))
    return seen, xyz


def tracked(seen, scale, track=None):
    settings = PipelineSettings(track=track or TrackSettings())
    return table([step.samples for step in run_seen(seen, scaled(ROOM, scale), settings)])


def links(tracks, xyz, scale):
    """How many samples follow one of the same particle in their track, and how many one of another particle."""
    tracks = tracks.select(np.lexsort((tracks.frame, tracks.track)))
    nearest = np.linalg.norm(xyz[tracks.frame] - tracks.xyz[:, None] / scale, axis=2).argmin(axis=1)
    follows = np.diff(tracks.track) == 0
    same = np.diff(nearest) == 0
    return int((follows & same).sum()), int((follows & ~same).sum())


@pytest.mark.parametrize("sets", [3, 20])
@pytest.mark.parametrize("scale", [1 / 16, 16.0])
def test_tracks_scale_with_the_space(sets, scale):
    seen, xyz = images(sets)
    room, other = tracked(seen, 1.0), tracked(seen, scale)
    assert links(room, xyz, 1.0) == (PARTICLES * (sets - 1), 0)
    assert np.array_equal(other.frame, room.frame)
    assert np.array_equal(other.track, room.track)
    np.testing.assert_allclose(other.xyz / scale, room.xyz, rtol=0, atol=1e-9)
    np.testing.assert_allclose(other.covariance / scale**2, room.covariance, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("scale", [1 / 16, 16.0])
def test_a_persons_lengths_fail_in_a_tank_and_in_a_hall(scale):
    """Control: in metres, as of a room of 2.5 m, the defaults join what is apart or lose what is fast."""
    seen, xyz = images(20, absent=0.2)
    there = sum(len(found["c0"]) for _, found, _ in seen)
    same, other = links(tracked(seen, scale), xyz, scale)
    person = links(tracked(seen, scale, TrackSettings(**MotionScale()._asdict())), xyz, scale)
    assert same > 0.9 * there
    assert other < 0.005 * there
    assert person[0] < 0.5 * there or person[1] > 0.05 * there


def test_lengths_that_are_given_stay():
    assert motion_scale(TrackSettings(gate_m=0.01), 25.0) == MotionScale(200.0, 15.0, 0.01, 6.0)


def test_width_of_the_field_by_hand():
    """655 x 490 px of 10 um behind 8 mm: chords of 2 sin(atan(3.275 / 8)) and 2 sin(atan(2.45 / 8))."""
    lens = MoscaLens(8.0, 327.0, 244.5, 0.01, 0.01, 0, 0, 0, 0, 0, 0)
    camera = replace(
        ROOM.cameras[0], width=655, height=490, lens=lens, world_from_camera=Pose(np.eye(3), np.zeros(3))
    )
    there = replace(points([[0, 0, 3.0], [0, 0, 2.0], [0, 0, 4.0]]), rays=np.zeros((3, 1), int))
    chords = 2 * np.sin(np.arctan(3.275 / 8)), 2 * np.sin(np.arctan(2.45 / 8))
    assert FieldWidth(Rig((camera,))).learn(there) == pytest.approx(3.0 * np.sqrt(chords[0] * chords[1]))
