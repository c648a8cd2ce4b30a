"""Correspondence: every group right, ghosts refused, ambiguities of two cameras left open."""

import numpy as np
import pytest

from mosca.camera import project
from mosca.data.detections import Detections
from mosca.data.rig import Camera, MoscaLens, Pose, Rig
from mosca.match import EVERYWHERE, MatchSettings, Predicted, match
from mosca.triangulate import bundle_rays

LENS = MoscaLens(8.0, 330.0, 240.0, 0.01, 0.01, -0.006, 1e-3, -1.5e-5, 0, 1e-4, 5e-5)
SIGMA = 0.05


def rig_of(count, radius=3.0):
    cameras = []
    for k in range(count):
        t = 2 * np.pi * k / count + 0.3
        place = np.array([radius * np.cos(t), radius * np.sin(t), 0.5 + 0.7 * (k % 2)])
        z = -place / np.linalg.norm(place)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        cameras.append(Camera(f"c{k}", 656, 491, LENS, Pose(np.column_stack([x, np.cross(z, x), z]), place)))
    return Rig(tuple(cameras))


def detected(rig, points, rng, sigma=SIGMA, clutter=0, miss=0.0):
    """Detections in random order and, for each camera, the point behind each of them (-1: clutter)."""
    found, truth = {}, {}
    for camera in rig.cameras:
        xy = project(camera, points)
        keep = np.flatnonzero((rng.random(len(points)) >= miss) & np.isfinite(xy).all(axis=1))
        keep = rng.permutation(keep)
        noise = rng.uniform((0, 0), (655, 490), (clutter, 2))
        places = np.concatenate([xy[keep] + rng.normal(0, sigma, (len(keep), 2)), noise])
        n = len(places)
        # the image of a ball of 14 mm; clutter looks like one at the middle of the room
        away = np.linalg.norm(points[keep] - camera.world_from_camera.translation, axis=1)
        diameter = 800.0 * 0.014 / np.concatenate([away, np.full(clutter, 3.0)])
        found[camera.name] = Detections(
            camera.name,
            places,
            np.tile(sigma**2 * np.eye(2), (n, 1, 1)),
            diameter,
            np.full(n, 100.0),
            np.ones(n),
        )
        truth[camera.name] = np.concatenate([keep, np.full(clutter, -1)]).astype(int)
    return found, truth


def grouped(rig, found, settings=None, predicted=None):
    settings = settings or MatchSettings(camera_sigma_px=0.0)
    bundle = bundle_rays(rig, found, settings.camera_sigma_px)
    return match(bundle, predicted or Predicted.nothing(), settings, EVERYWHERE)


def members(rig, points, truth):
    """For each group the set of true points behind its rays."""
    return [
        {int(truth[c.name][row[k]]) for k, c in enumerate(rig.cameras) if row[k] >= 0} for row in points.rays
    ]


@pytest.mark.parametrize("count", [3, 4, 8])
def test_all_groups_right(count):
    rng = np.random.default_rng(count)
    rig, truth3d = rig_of(count), rng.uniform(-0.5, 0.5, (100, 3))
    found, behind = detected(rig, truth3d, rng)
    points = grouped(rig, found)
    groups = members(rig, points, behind)
    right = sum(len(g) == 1 and points.n_cameras[i] == count for i, g in enumerate(groups))
    # the noise throws a ray beyond 4 sigma once in some 10,000; three cameras leave chance pairs of three
    assert right >= 97
    assert sum(len(g) > 1 for g in groups) <= 1


def test_clutter_and_missed_images_make_no_wrong_groups_of_three():
    rng = np.random.default_rng(5)
    rig, truth3d = rig_of(4), rng.uniform(-0.5, 0.5, (60, 3))
    found, behind = detected(rig, truth3d, rng, clutter=10, miss=0.1)
    points = grouped(rig, found, MatchSettings(camera_sigma_px=0.0, minimum_cameras=3))
    groups = members(rig, points, behind)
    assert sum(len(g) > 1 or -1 in g for g in groups) == 0
    seen = np.sum([np.bincount(b[b >= 0], minlength=60) for b in behind.values()], axis=0)
    assert len(groups) >= 0.97 * (seen >= 3).sum()


def test_two_cameras_leave_open_what_they_cannot_tell():
    rig = rig_of(2)
    # two targets in one epipolar plane: four crossings of rays, none better than the other
    a, b = (c.world_from_camera.translation for c in rig.cameras)
    plane = np.cross(a, b)
    inside = np.cross(plane, a + b)
    inside /= np.linalg.norm(inside)
    targets = np.array([0.2 * inside, -0.2 * inside])
    rng = np.random.default_rng(0)
    found, behind = detected(rig, targets, rng, sigma=0.01)
    assert len(grouped(rig, found)) == 0
    # with the tracks' predictions the true pairs are taken
    expected = Predicted(targets, np.tile(1e-4 * np.eye(3), (2, 1, 1)))
    assert sorted(map(sorted, members(rig, grouped(rig, found, predicted=expected), behind))) == [[0], [1]]


def test_a_bad_ray_is_left_out():
    rig, rng = rig_of(5), np.random.default_rng(3)
    truth3d = np.array([[0.1, 0.2, -0.1]])
    found, _ = detected(rig, truth3d, rng, sigma=0.02)
    bad = found["c2"]
    found["c2"] = Detections(
        "c2",
        bad.xy_px + 0.15,
        *(getattr(bad, n) for n in ("covariance_px2", "diameter_px", "peak", "elongation")),
    )
    points = grouped(rig, found)
    best = int(np.argmax(points.n_cameras))
    assert points.rays[best].tolist() == [0, 0, -1, 0, 0]
    assert np.linalg.norm(points.xyz[best] - truth3d[0]) < 3e-4


def test_points_outside_the_volume_are_none():
    rig, rng = rig_of(4), np.random.default_rng(4)
    truth3d = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    found, _ = detected(rig, truth3d, rng)
    bundle = bundle_rays(rig, found, 0.0)
    box = (np.full(3, -0.2), np.full(3, 0.2))
    assert len(match(bundle, Predicted.nothing(), MatchSettings(), box)) == 1


def test_no_detections_no_points():
    rig = rig_of(4)
    assert len(grouped(rig, {})) == 0
    assert grouped(rig, {}).rays.shape == (0, 4)


def test_swapped_calibrations_find_next_to_nothing():
    rng = np.random.default_rng(6)
    rig, truth3d = rig_of(4), rng.uniform(-0.5, 0.5, (50, 3))
    found, _ = detected(rig, truth3d, rng)
    swapped = dict(found, c0=found["c1"], c1=found["c0"])
    assert (grouped(rig, swapped).n_cameras == 4).sum() == 0
