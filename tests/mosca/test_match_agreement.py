"""Points of which some images are merged with a neighbour's or look odd: which of them count, and for how much.

Images are projected by hand with known errors; the expected places and variances are those of a least-squares point
from the images that err by their noise alone, solved here with numerical derivatives of the projection.
"""

from dataclasses import replace

import numpy as np
import pytest
from rigs import PINHOLE, ring
from scipy.stats import chi2

from mosca.camera.projection import project, rays
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import EVERYWHERE, MatchSettings, match
from mosca.data.detections import MERGED, UNREFINED, Detections
from mosca.data.rays import Predicted
from mosca.data.rig import OpenCVLens, Rig

SIGMA, DIAMETER_M, TARGETS, LONG = 0.02, 0.014, 60, 1.5
RIG = ring(4, PINHOLE, height_m=[0.6, 1.3, 0.6, 1.3])


def images(rng, merged, shift_px, long):
    """Detections of targets in order; of the cameras ``merged`` each target's image is shifted by ``shift_px``.

    ``long`` (c,): whether a camera's images are long. A merged pair of one image's size shows nothing else.
    """
    points, found = rng.uniform(-0.4, 0.4, (TARGETS, 3)), {}
    for c, camera in enumerate(RIG.cameras):
        angle = rng.uniform(0, 2 * np.pi, TARGETS)
        off = shift_px * np.column_stack([np.cos(angle), np.sin(angle)]) if c in merged else 0.0
        xy = project(camera, points) + rng.normal(0, SIGMA, (TARGETS, 2)) + off
        away = np.linalg.norm(points - camera.world_from_camera.translation, axis=1)
        found[camera.name] = Detections(
            camera.name, xy, np.tile(SIGMA**2 * np.eye(2), (TARGETS, 1, 1)), 800.0 * DIAMETER_M / away,
            np.full(TARGETS, 100.0), np.where(long[c], LONG, 1.0) * np.ones(TARGETS),
        )  # fmt: skip
    return points, found


def bound(point, cameras):
    """Covariance of a point from images with ``SIGMA`` of some cameras."""
    information = np.zeros((3, 3))
    for camera in (RIG.cameras[c] for c in cameras):
        steps = 1e-5 * np.eye(3)
        slope = (project(camera, point + steps) - project(camera, point - steps)).T / 2e-5
        information += slope.T @ slope / SIGMA**2
    return np.linalg.inv(information)


def placed(found, predicted=None):
    """Points, as if round images elsewhere made the long ones rare."""
    table = replace(make_ray_table(RIG, found, 0.0), odd=0)
    settings = MatchSettings(camera_sigma_px=0.0)
    return match(table, predicted or Predicted.nothing(), settings, EVERYWHERE, DIAMETER_M)


def errors(points, truth3d):
    """Errors (n, 3), covariances and targets of the points whose images are all of one target."""
    same = (points.rays == points.rays.max(axis=1, keepdims=True)) | (points.rays < 0)
    whole = np.flatnonzero(same.all(axis=1))
    target = points.rays[whole].max(axis=1)
    return points.xyz[whole] - truth3d[target], points.covariance[whole], target


def test_long_images_that_agree_count_in_full_and_a_merged_one_among_them_does_not():
    ratio, nees = [], []
    for seed in range(4):
        truth3d, found = images(np.random.default_rng(seed), {3}, 0.6, [True] * 4)
        off, covariance, target = errors(placed(found), truth3d)
        assert len(target) >= 0.9 * TARGETS
        ratio += [e @ e / np.trace(bound(truth3d[t], (0, 1, 2))) for e, t in zip(off, target, strict=True)]
        nees += [e @ np.linalg.solve(v, e) for e, v in zip(off, covariance, strict=True)]
    # rms within a tenth of what the three other images can tell, as stated
    assert np.sqrt(np.mean(ratio)) < 1.1
    assert 2.4 < np.mean(nees) < 3.6
    assert 0.93 < np.mean(np.array(nees) < chi2.ppf(0.95, 3)) < 0.975


@pytest.mark.parametrize("long", [[False] * 4, [False, False, True, True], [True] * 4])
def test_images_that_err_by_their_noise_alone_count_in_full_whatever_their_shape(long):
    truth3d, found = images(np.random.default_rng(5), set(), 0.0, long)
    points = placed(found)
    _, covariance, target = errors(points, truth3d)
    assert len(target) == TARGETS
    assert (points.trusted > 3.99).mean() > 0.95
    for v, t in zip(covariance[:5], target[:5], strict=True):
        np.testing.assert_allclose(v, bound(truth3d[t], range(4)), rtol=0.02, atol=1e-12)


def test_two_images_show_no_disagreement():
    # control: along the epipolar line a pair agrees whatever its errors, so that odd shapes still count for less
    truth3d, found = images(np.random.default_rng(6), set(), 0.0, [True] * 4)
    tracks = Predicted(truth3d, np.tile(1e-6 * np.eye(3), (TARGETS, 1, 1)))
    points = placed({name: one for name, one in found.items() if name in ("c0", "c1")}, tracks)
    assert len(points) > 0
    assert points.trusted.max() < 1.9


def test_a_merged_image_does_not_decide_between_two_clean_ones():
    """Two rays miss each other by 3 standard deviations; a merged image agrees with a wrong place on the first."""
    rng = np.random.default_rng(0)
    points, found = images(rng, (), 0.0, [False] * 4)
    first, second, merged, unseen = RIG.cameras
    along = points - second.world_from_camera.translation
    exact = project(first, points)
    line = project(first, points + 0.01 * along) - exact  # the epipolar line of the second camera's ray
    across = np.column_stack([-line[:, 1], line[:, 0]]) / np.linalg.norm(line, axis=1)[:, None]
    shifted = exact + 3.0 * np.sqrt(2) * SIGMA * across
    ray = rays(first, shifted).direction
    near = first.world_from_camera.translation + ray * np.linalg.norm(
        points - first.world_from_camera.translation, axis=1, keepdims=True
    )
    px_a_mm = np.linalg.norm(project(merged, near + 1e-3 * ray) - project(merged, near), axis=1, keepdims=True)
    found[first.name] = replace(found[first.name], xy_px=shifted)
    found[second.name] = replace(found[second.name], xy_px=project(second, points))
    found[merged.name] = replace(
        found[merged.name], xy_px=project(merged, near + 0.7e-3 / px_a_mm * ray),
        diameter_px=0.95 * found[merged.name].diameter_px, flags=np.full(TARGETS, MERGED | UNREFINED, np.uint8),
        covariance_px2=np.tile(0.15**2 * np.eye(2), (TARGETS, 1, 1)),
    )  # fmt: skip
    del found[unseen.name]
    placed_there = placed(found).xyz
    assert len(placed_there) == TARGETS
    # 4 to 5 mm off, all of them, where both explanations have the same prior probability
    assert np.linalg.norm(placed_there[:, None] - points, axis=2).min(axis=1).max() < 1e-3


@pytest.mark.parametrize("off_deg", [0.0, 35.0, 50.0])
def test_a_ball_is_not_long_where_the_lens_makes_it_so(off_deg):
    """Off the axis the outline of a ball is an ellipse; one that is long besides is told."""
    camera = replace(RIG.cameras[0], width=2400, lens=OpenCVLens(800.0, 800.0, 1199.5, 245.0))
    far, radius = 3.0, 0.05
    t = np.linspace(0, 2 * np.pi, 200)
    cone = np.arcsin(radius / far)
    towards, up = np.deg2rad(off_deg), np.array([0.0, 1.0, 0.0])
    axis, aside = (np.array([np.sin(a), 0.0, np.cos(a)]) for a in (towards, towards + np.pi / 2))
    rim = np.cos(cone) * axis + np.sin(cone) * (np.cos(t)[:, None] * aside + np.sin(t)[:, None] * up)
    outline = project(camera, camera.world_from_camera.transform(rim))
    wide, high = np.ptp(outline, axis=0)
    seen = {
        long: Detections(
            camera.name, outline.mean(axis=0)[None], SIGMA**2 * np.eye(2)[None], np.array([np.sqrt(wide * high)]),
            np.array([100.0]), np.array([long * wide / high]),
        )
        for long in (1.0, 1.2)
    }  # fmt: skip
    rig = Rig((camera,))
    assert [make_ray_table(rig, {camera.name: one}, 0.0).odd for one in seen.values()] == [0, 1]
