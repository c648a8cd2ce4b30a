"""A bumped camera raises an alarm by name, good data raise none, and the camera's pose is re-estimated."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import HEIGHT, WIDTH, ring
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mosca.calibration.monitoring.bump_detector import BumpDetector, BumpSettings, changes
from mosca.calibration.monitoring.reorient import CameraObservations, common_shift, gather, reorient, reoriented
from mosca.calibration.monitoring.rotation_information import frame_sums
from mosca.camera.projection import project
from mosca.data.detections import Detections
from mosca.data.rig import Pose, Rig
from mosca.data.tracks import Points
from mosca.errors import CalibrationError, InputError

NOISE_PX, BODY_PX = 0.05, 0.03
MARKERS = 30


def bumped(camera, turn_rad=0.0, shift_m=0.0):
    pose = camera.world_from_camera
    turn = Rotation.from_rotvec([0.6 * turn_rad, 0.8 * turn_rad, 0]).as_matrix()
    return replace(camera, world_from_camera=Pose(pose.rotation @ turn, pose.translation + [shift_m, 0, 0]))


def frame(rig: Rig, true: Rig, rng, points=None, body_px=BODY_PX, matched=None, keep=0.85):
    """Return detections by the cameras ``true`` and points as ``rig`` measures them; ``matched`` (c,) cameras."""
    xyz = rng.uniform(-0.6, 0.6, (MARKERS, 3)) + [0, 0, 1] if points is None else points
    detections, rays = {}, np.full((len(xyz), len(rig.cameras)), -1)
    for k, camera in enumerate(true.cameras):
        xy = project(camera, xyz)
        inside = ((xy > 0) & (xy < (WIDTH - 1, HEIGHT - 1))).all(axis=1) & (rng.random(len(xyz)) < keep)
        xy = xy[inside] + rng.normal(0, NOISE_PX, (inside.sum(), 2)) + rng.normal(0, body_px, 2)
        n = len(xy)
        order = rng.permutation(n)
        detections[camera.name] = Detections(
            camera.name,
            xy[order],
            np.tile(NOISE_PX**2 * np.eye(2), (n, 1, 1)),
            np.full(n, 8.0),
            np.ones(n),
            np.ones(n),
        )
        if matched is None or matched[k]:
            rays[inside, k] = np.argsort(order)
    count = (rays >= 0).sum(axis=1)
    good = count >= 2
    # approximate: the watch and the re-orientation triangulate the points themselves
    found = xyz + rng.normal(0, 1e-4, xyz.shape)
    n = int(good.sum())
    return detections, Points(
        found[good], np.tile(1e-8 * np.eye(3), (n, 1, 1)), count[good], np.full(n, 0.05), rays[good],
        np.full(n, 0.01), count[good]
    )  # fmt: skip


RIG = Rig(tuple(ring(4)))


def watched(rig, true, frames, seed=0, first=0, watch=None, **kw):
    rng = np.random.default_rng(seed)
    watch = watch or BumpDetector(rig, BumpSettings(camera_sigma_px=0.0))
    for k in range(first, first + frames):
        alarm = watch.update(k, *frame(rig, true, rng, **kw))
        if alarm is not None:
            return alarm, watch
    return None, watch


def test_without_a_bump_the_statistic_is_chi_square():
    rng = np.random.default_rng(1)
    sums = [frame_sums(RIG, k, *frame(RIG, RIG, rng), 0.0, BODY_PX) for k in range(160)]
    values = np.array([changes(sums[k : k + 4]).statistic for k in range(0, 160, 4)])
    # 3 degrees of freedom; 40 windows of 4 correlated cameras: mean 3 +- 0.3
    assert values.mean() == pytest.approx(3, abs=0.9)
    assert np.mean(values > chi2.isf(0.05, 3)) < 0.11


def test_a_bump_of_a_third_of_a_pixel_is_found_and_named():
    for k in range(4):
        cameras = list(RIG.cameras)
        cameras[k] = bumped(cameras[k], 0.3e-3)  # about 0.3 px at f = 1000 px
        watch = BumpDetector(RIG, BumpSettings(camera_sigma_px=0.0))
        alarm, _ = watched(RIG, RIG, 40, k, watch=watch)
        assert alarm is None
        alarm, _ = watched(RIG, Rig(tuple(cameras)), 100, 10 + k, 40, watch)
        assert alarm is not None
        assert alarm.camera == f"c{k}"
        assert f"'c{k}'" in alarm.message
        assert abs(alarm.since - 40) <= 3
        assert alarm.shift_px == pytest.approx(0.32, abs=0.08)
        assert alarm.significance < 1e-9


def test_a_displaced_camera_is_found_too():
    cameras = list(RIG.cameras)
    cameras[1] = bumped(cameras[1], 0.0, 0.002)
    alarm, _ = watched(RIG, Rig(tuple(cameras)), 100, 3)
    assert alarm is not None
    assert alarm.camera == "c1"


@pytest.mark.parametrize("rad", [0.0, 0.04e-3])
def test_good_data_and_a_shift_below_the_allowance_raise_nothing(rad):
    cameras = [*RIG.cameras[:3], bumped(RIG.cameras[3], rad)]
    assert watched(RIG, Rig(tuple(cameras)), 160, 4)[0] is None


def test_no_false_alarm_in_10000_frames():
    """Sums of 10,000 good frames drawn from their own distribution: v normal with the frame's covariance."""
    rng = np.random.default_rng(5)
    models = [frame_sums(RIG, 0, *frame(RIG, RIG, rng), 0.0, BODY_PX) for _ in range(10)]
    which = rng.integers(10, size=10000)
    pulls = np.array([rng.multivariate_normal(np.zeros(12), models[k].spread) for k in which])
    information, spread = (np.array([getattr(m, name) for m in models]) for name in ("information", "spread"))
    sums = [
        np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        for values in (pulls, information[which], spread[which])
    ]
    settings = BumpSettings()
    worst = 0.0
    for window in settings.windows:
        for end in range(window, 10001, 16):
            v, m, c = (total[end] - total[end - window] for total in sums)
            found = changes([replace(models[0], pull=v, information=m, spread=c)])
            worst = max(worst, float(found.statistic.max()))
    # the alarm needs 50 (chance 1e-10); of 7,500 tests the largest exceeds 32 in one run of a thousand
    assert worst < 32 < chi2.isf(settings.significance, 3)


def test_two_cameras_cannot_tell_which_one_moved():
    rig = Rig(tuple(ring(4)[:2]))
    alarm, _ = watched(rig, Rig((rig.cameras[0], bumped(rig.cameras[1], 1e-3))), 100, 6)
    assert alarm is not None
    assert alarm.camera is None
    assert set(alarm.suspects) == {"c0", "c1"}
    assert "cannot tell" in alarm.message
    with pytest.raises(InputError, match="2 cameras"):
        reoriented(rig, "c1", CameraObservations(*(np.empty(0) for _ in range(5))))


def test_a_bump_too_large_to_match_is_found_by_the_images_that_miss():
    cameras = [*RIG.cameras[:2], bumped(RIG.cameras[2], 15e-3), RIG.cameras[3]]
    true = Rig(tuple(cameras))
    matched = (True, True, False, True)
    alarm, watch = watched(RIG, true, 60, 7, matched=matched)
    assert alarm is not None
    assert alarm.camera == "c2"
    assert alarm.shift_px == pytest.approx(16, abs=4)
    rng = np.random.default_rng(8)
    parts = []
    for k in range(20):
        detections, points = frame(RIG, true, rng, matched=matched)
        shift = common_shift(RIG, "c2", detections, points)
        parts.append(gather(RIG, "c2", k, detections, points, shift))
    new, found = reoriented(RIG, "c2", CameraObservations.joined(parts))
    check_pose(found, cameras[2], 0.05)
    watch.restart(new)
    assert watched(new, true, 60, 9, watch=watch)[0] is None


def test_a_camera_that_merely_looks_elsewhere_is_not_lost():
    # its images are elsewhere at random: half of the markers hidden from it, reflections instead
    rng = np.random.default_rng(10)
    watch = BumpDetector(RIG, BumpSettings(camera_sigma_px=0.0))
    for k in range(40):
        detections, points = frame(RIG, RIG, rng, matched=(True, True, True, False))
        n = 25
        clutter = Detections(
            "c3", rng.uniform(0, 1000, (n, 2)), np.tile(0.01 * np.eye(2), (n, 1, 1)), *np.ones((3, n))
        )
        assert watch.update(k, detections | {"c3": clutter}, points) is None


def check_pose(found, true, body_share):
    pose, want = found.camera.world_from_camera, true.world_from_camera
    error = np.concatenate([
        Rotation.from_matrix(want.rotation.T @ pose.rotation).as_rotvec(), pose.translation - want.translation
    ])  # fmt: skip
    squared = error @ np.linalg.solve(found.covariance, error)
    # 6 degrees of freedom
    assert squared < chi2.isf(1e-4, 6)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3)) + [0, 0, 1]
    off = np.linalg.norm(project(found.camera, points) - project(true, points), axis=1)
    assert np.sqrt(np.mean(off**2)) < body_share


def test_reorientation_finds_the_place_with_an_honest_covariance():
    true_cameras = [*RIG.cameras[:3], bumped(RIG.cameras[3], 1e-3, 0.001)]
    true = Rig(tuple(true_cameras))
    pulls = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        parts = [gather(RIG, "c3", k, *frame(RIG, true, rng)) for k in range(8)]
        found = reorient(RIG.camera("c3"), CameraObservations.joined(parts), BODY_PX)
        check_pose(found, true_cameras[3], 0.06)
        error = found.camera.world_from_camera.translation - true_cameras[3].world_from_camera.translation
        pulls.append(error / np.sqrt(np.diag(found.covariance)[3:]))
    # others' shake is in no covariance of a single point: up to some 1.6 is taken
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.6
    assert found.turn_rad == pytest.approx(1e-3, abs=2e-4)


def test_wrong_pairs_are_left_out():
    rng = np.random.default_rng(11)
    seen = CameraObservations.joined([gather(RIG, "c0", k, *frame(RIG, RIG, rng)) for k in range(5)])
    wrong = rng.random(len(seen)) < 0.1
    xy = seen.xy_px + np.where(wrong[:, None], rng.uniform(3, 30, (len(seen), 2)), 0)
    found = reorient(RIG.camera("c0"), replace(seen, xy_px=xy), BODY_PX)
    assert not found.used[wrong].any()
    check_pose(found, RIG.cameras[0], 0.05)


def test_too_few_points_and_points_on_a_line():
    rng = np.random.default_rng(12)
    seen = gather(RIG, "c0", 0, *frame(RIG, RIG, rng))
    few = CameraObservations(*(getattr(seen, name)[:5] for name in CameraObservations.__dataclass_fields__))
    with pytest.raises(CalibrationError, match="at least 12"):
        reorient(RIG.camera("c0"), few)
    line = np.linspace(-0.5, 0.5, 30)[:, None] * [1, 0.2, 0.1] + [0, 0, 1]
    seen = gather(RIG, "c0", 0, *frame(RIG, RIG, rng, line, keep=1.0))
    with pytest.raises(CalibrationError, match="one line"):
        reorient(RIG.camera("c0"), seen)
