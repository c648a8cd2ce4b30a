"""Correspondence: images that only seem to be of two targets."""

from dataclasses import replace

import numpy as np
from test_match import chosen, detected, expected_at, rig_of

from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import EVERYWHERE, MatchSettings, match

SETTINGS, SIZE_M = MatchSettings(camera_sigma_px=0.0), 0.014


def towards(rig, camera, point, by_m):
    """Return a point ``by_m`` farther along a camera's ray through a point."""
    origin = rig.cameras[camera].world_from_camera.translation
    return point + by_m * (point - origin) / np.linalg.norm(point - origin)


def test_a_whole_target_hides_another_that_would_have_to_be_larger():
    """As seen from the first camera, the second target is behind the first, a third farther away: its image would be
    1.8 times as large there as a target's, and it is of the right size for the first.
    """
    rig, rng = rig_of(3), np.random.default_rng(4)
    near = np.array([0.1, 0.0, 0.2])
    truth3d = np.array([near, towards(rig, 0, near, 1.0)])
    found, _ = detected(rig, truth3d, rng, sigma=0.02)
    away = np.linalg.norm(near - rig.cameras[0].world_from_camera.translation)
    found["c0"] = replace(chosen(found["c0"], [0]), diameter_px=np.array([800.0 * SIZE_M / away]))
    table = make_ray_table(rig, found, 0.0)
    points = match(table, expected_at(truth3d, 1e-3), SETTINGS, EVERYWHERE, SIZE_M)
    order = np.argsort(np.linalg.norm(points.xyz - near, axis=1))
    assert points.n_cameras[order].tolist() == [3, 2]
