"""A camera's own poses: images projected by OpenCV, covariances against Monte Carlo, registration in closed form."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses
from mosca.data.found_targets import CodedDetections
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.rotations import quaternion_from_rotation
from mosca.data.targets import CodedTarget, PlacedTarget, TestField
from mosca.errors import InputError
from mosca.machines.self_orientation.camera_path import (
    CameraPath,
    at_instants,
    in_frame,
    mean_nees,
    moved,
    pose_errors,
)
from mosca.machines.self_orientation.comparison import compare, estimated_lever_arm
from mosca.machines.self_orientation.registration import Registration, register_field
from mosca.machines.self_orientation.resection import LensErrors, ResectionSettings, resect_frames
from mosca.machines.self_orientation.rig_side import LeverArm, body_path, camera_by_rig, with_clock
from mosca.machines.self_orientation.shutter import TargetImages

LENS = OpenCVLens(930.0, 932.0, 641.0, 357.0, k1=-0.21, k2=0.05, p1=4e-4, p2=-3e-4)
CAMERA = Camera("front", 1280, 720, LENS, Pose(np.eye(3), np.zeros(3)))
SIGMA_PX, SIGMA_M = 0.05, 0.0003
DRAWS = 100
KEY = (LENS.fx_px, LENS.fy_px, LENS.cx_px, LENS.cy_px)
# the camera looks at the field against its z axis: right is x, down is -y, ahead is -z
FACING = np.diag([1.0, -1.0, -1.0])


def field_of(rng: np.random.Generator, sigma_m: float = 0.0, n: int = 16) -> TestField:
    places = np.column_stack([rng.uniform(-0.7, 0.7, n), rng.uniform(-0.4, 0.4, n), rng.uniform(-0.15, 0.15, n)])
    # dots so small that circles and their centres have one image
    return TestField(
        tuple(PlacedTarget(f"t{k}", CodedTarget.of_dot(k, 1e-5), place) for k, place in enumerate(places)), sigma_m
    )


def by_opencv(pose: Pose, xyz: Array, lens: OpenCVLens = LENS) -> Array:
    back = pose.inverse()
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    turn = Rotation.from_matrix(back.rotation).as_rotvec()
    coefficients = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    return cv2.projectPoints(xyz, turn, back.translation, matrix, coefficients)[0].reshape(-1, 2)


def pose_at(t: float) -> Pose:
    turn = Rotation.from_rotvec([0.06 * np.sin(2.1 * t), 0.15 * np.sin(0.9 * t), 0.05 * np.cos(1.7 * t)])
    place = [0.3 * np.sin(0.8 * t), 0.2 * np.cos(0.7 * t), 1.9 + 0.2 * np.sin(0.5 * t)]
    return Pose(turn.as_matrix() @ FACING, np.array(place))


def images_of(pose: Pose, xyz: Array, k: int, rng: np.random.Generator, lens: OpenCVLens = LENS) -> TargetImages:
    xy = by_opencv(pose, xyz, lens) + SIGMA_PX * rng.standard_normal((len(xyz), 2))
    return TargetImages(
        k, round(k / 30 * 1e9), np.arange(len(xyz)), xy, np.tile(SIGMA_PX**2 * np.eye(2), (len(xyz), 1, 1))
    )


def truth_of(frames: int) -> tuple[Array, Array]:
    poses = [pose_at(k / 30) for k in range(frames)]
    return np.array([p.rotation for p in poses]), np.array([p.translation for p in poses])


def test_noise_free_images_of_opencv_give_the_pose() -> None:
    field = field_of(np.random.default_rng(1))
    seen = [
        replace(
            images_of(pose_at(k / 30), field.positions, k, np.random.default_rng(0)),
            xy_px=by_opencv(pose_at(k / 30), field.positions),
        )
        for k in range(3)
    ]
    found = resect_frames(seen, CAMERA, field)
    np.testing.assert_allclose(found.path.position, truth_of(3)[1], atol=1e-7)
    assert np.abs(pose_errors(found.path, *truth_of(3))).max() < 1e-7
    assert found.withheld == 0
    assert found.targets.tolist() == [16] * 3


def test_covariances_are_those_of_a_monte_carlo() -> None:
    """New image noise in each take, lens and targets wrong once a take: the stated covariance, own and shared."""
    rng = np.random.default_rng(7)
    true = field_of(rng)
    lens_sigma = np.array([1.5, 1.5, 1.0, 1.0])
    lens_errors = LensErrors(("fx_px", "fy_px", "cx_px", "cy_px"), np.diag(lens_sigma**2))
    errors, stated = [], []
    for _ in range(DRAWS):
        told = TestField(
            tuple(replace(t, position=t.position + SIGMA_M * rng.standard_normal(3)) for t in true.targets), SIGMA_M
        )
        d = lens_sigma * rng.standard_normal(4)
        believed = replace(LENS, fx_px=KEY[0] + d[0], fy_px=KEY[1] + d[1], cx_px=KEY[2] + d[2], cy_px=KEY[3] + d[3])
        seen = [images_of(pose_at(k), true.positions, k, rng) for k in (0, 2)]
        found = resect_frames(seen, replace(CAMERA, lens=believed), told, lens_errors, ResectionSettings(reject=1e-9))
        rotation, position = (
            np.array([getattr(pose_at(k), what) for k in (0, 2)]) for what in ("rotation", "translation")
        )
        errors.append(pose_errors(found.path, rotation, position))
        path = found.path
        assert path.by_parameter is not None
        between = path.by_parameter[0] @ path.shared.covariance @ path.by_parameter[1].T
        stated.append((path.total_covariance()[0], between))
    e = np.array(errors)
    alone, common = (np.mean([one[k] for one in stated], axis=0) for k in (0, 1))
    drawn, shared = e[:, 0].T @ e[:, 0] / DRAWS, e[:, 0].T @ e[:, 1] / DRAWS
    # 100 draws tell a variance to 14 %, a correlation to 0.1: 3 sigma
    np.testing.assert_allclose(np.diag(drawn), np.diag(alone), rtol=0.42)
    scale = np.sqrt(np.outer(np.diag(alone), np.diag(alone)))
    np.testing.assert_allclose(drawn / scale, alone / scale, atol=0.42)
    np.testing.assert_allclose(shared / scale, common / scale, atol=0.42)


def test_the_band_of_a_mean_nees_holds_its_95_percent_and_sees_a_covariance_that_is_halved() -> None:
    rng = np.random.default_rng(3)
    n, k = 30, 4
    by_parameter = rng.standard_normal((n, 6, k))
    path = CameraPath(
        np.arange(n),
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)),
        np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (n, 1, 1)),
    )
    path = path.with_shared(("a", "b", "c", "d"), np.diag([4.0, 1.0, 9.0, 0.5]), by_parameter)
    inside = small = 0
    for _ in range(60):
        e = rng.standard_normal((n, 6)) * np.sqrt([1.0, 2, 3, 4, 5, 6])
        e += by_parameter @ (np.sqrt([4.0, 1.0, 9.0, 0.5]) * rng.standard_normal(k))
        value, (low, high) = mean_nees(path, e)
        inside += low <= value <= high
        small += not low <= 4 * value <= high
    # 60 times 0.95 = 57; fewer than 52 has a chance of 1 %
    assert inside >= 52
    assert small >= 45


def test_a_blunder_is_left_out() -> None:
    rng = np.random.default_rng(4)
    field = field_of(rng)
    seen = images_of(pose_at(0), field.positions, 0, rng)
    xy = np.array(seen.xy_px)
    xy[5] += [6.0, -4.0]
    found = resect_frames([replace(seen, xy_px=xy)], CAMERA, field)
    assert 5 not in found.used[0].tolist()
    assert len(found.used[0]) >= 14
    assert np.abs(pose_errors(found.path, *truth_of(1)))[0, :3].max() < 0.002


def test_a_rolling_shutter_is_taken_out_by_the_motion_between_frames() -> None:
    rng = np.random.default_rng(5)
    field, row_s, frames = field_of(rng), 45e-6, 12
    seen = []
    for k in range(frames):
        xy = by_opencv(pose_at(k / 30), field.positions)
        for _ in range(3):  # the row that an image lies in says when it was exposed
            late = (xy[:, 1] - 359.5) * row_s
            xy = np.array(
                [by_opencv(pose_at(k / 30 + dt), p[None])[0] for dt, p in zip(late, field.positions, strict=True)]
            )
        seen.append(replace(images_of(pose_at(0), field.positions, k, rng), xy_px=xy))
    errors = []
    for row in (0.0, row_s):
        found = resect_frames(seen, CAMERA, field, settings=ResectionSettings(row_time_s=row))
        true = [what[found.frame] for what in truth_of(frames)]
        errors.append(np.abs(pose_errors(found.path, *true))[0 if row else 2 : None if row else -2].max(axis=0))
    assert found.frame.tolist() == list(range(2, frames - 2))
    ignored, corrected = errors
    assert ignored[:3].max() > 0.003
    # what the spline leaves of this motion near the ends is below 0.1 mm and 0.1 mrad
    assert (corrected < 1e-4).all()


def test_frames_with_too_few_targets_give_no_pose_and_none_at_all_is_told() -> None:
    rng = np.random.default_rng(6)
    field = field_of(rng)
    full = images_of(pose_at(0), field.positions, 0, rng)
    few = TargetImages(1, 33_000_000, full.number[:5], full.xy_px[:5], full.covariance_px2[:5])
    found = resect_frames([full, few], CAMERA, field)
    assert found.frame.tolist() == [0]
    assert found.withheld == 1
    with pytest.raises(InputError, match=r"camera 'front': none of 1 frames gives a pose: 6 targets .* seen were 5"):
        resect_frames([few], CAMERA, field)
    with pytest.raises(InputError, match="fewest = 3 given"):
        ResectionSettings(fewest=3)


def rig_of_three() -> Rig:
    cameras = []
    for k, x in enumerate((-1.2, 0.1, 1.3)):
        ahead = np.array([-x, -0.2, -2.5]) / np.linalg.norm([-x, -0.2, -2.5])
        right = np.cross(ahead, [0, 1.0, 0])
        right /= np.linalg.norm(right)
        turn = np.column_stack([right, np.cross(ahead, right), ahead])
        cameras.append(replace(CAMERA, name=f"c{k}", world_from_camera=Pose(turn, np.array([x, 0.2, 2.5]))))
    return Rig(tuple(cameras))


def test_registration_is_the_closed_form_motion_and_its_covariance_a_monte_carlos() -> None:
    rng = np.random.default_rng(8)
    field, rig = field_of(rng), rig_of_three()
    there = Pose(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.1, 0.05, -0.2]))
    world = there.transform(field.positions)

    def seen(sigma: float) -> list[CodedDetections]:
        n = len(world)
        blank = np.zeros(n)
        return [
            CodedDetections(
                one.name, np.arange(n),
                by_opencv(one.world_from_camera, world) + sigma * rng.standard_normal((n, 2)),
                np.tile(SIGMA_PX**2 * np.eye(2), (n, 1, 1)), np.ones((n, 2)), blank, blank, np.ones(n), np.zeros(0),
            )
            for one in rig.cameras
        ]  # fmt: skip

    exact = register_field(rig, seen(0.0), field)
    np.testing.assert_allclose(exact.world_from_field.translation, there.translation, atol=1e-7)
    np.testing.assert_allclose(exact.world_from_field.rotation, there.rotation, atol=1e-7)
    errors = []
    for _ in range(DRAWS):
        found = register_field(rig, seen(SIGMA_PX), field).world_from_field
        turn = Rotation.from_matrix(there.rotation @ found.rotation.T).as_rotvec()
        errors.append(np.concatenate([there.translation - found.translation, turn]))
    drawn = np.mean(np.square(errors), axis=0)
    np.testing.assert_allclose(drawn, np.diag(exact.covariance), rtol=0.42)
    with pytest.raises(InputError, match="registration: 0 of the field's 16 targets are seen by two cameras"):
        register_field(rig, seen(0.0)[:1], field)


def body_and_camera(n: int = 40) -> tuple[CameraPath, Pose]:
    arm = Pose(Rotation.from_rotvec([0.2, 0.1, -0.4]).as_matrix(), np.array([0.14, 0.01, 0.02]))
    rotation, position = truth_of(n)
    time_ns = np.round(np.arange(n) / 30 * 1e9).astype(np.int64)
    camera = CameraPath(time_ns, rotation, position, np.tile(1e-6 * np.eye(6), (n, 1, 1)))
    return camera, arm


def test_poses_carried_along_a_lever_arm_into_a_field_have_the_errors_of_differences() -> None:
    """Each shared parameter of the rig's side moves the pose as a finite difference of the same chain does."""
    camera, arm = body_and_camera(5)
    body = moved(camera, arm.inverse())
    g = Pose(Rotation.from_rotvec([0.3, 0.5, -0.1]).as_matrix(), np.array([0.4, -0.3, 0.2]))
    found = camera_by_rig(body, LeverArm(arm, np.eye(6)), Registration(g, np.eye(6), 0.0, 9))
    assert found.by_parameter is not None
    expected = in_frame(camera, g.inverse())
    assert np.abs(pose_errors(found, expected.rotation, expected.position)).max() < 1e-12
    step = 1e-6
    for k in range(12):
        d = np.zeros(6)
        d[k % 6] = step
        turn = Rotation.from_rotvec(d[3:]).as_matrix()
        true_arm, true_g = arm, g
        if k < 6:
            true_arm = Pose(turn @ arm.rotation, arm.translation + d[:3])
        else:
            true_g = Pose(turn @ g.rotation, g.translation + d[:3])
        true = in_frame(moved(body, true_arm), true_g.inverse())
        change = pose_errors(found, true.rotation, true.position) / step
        np.testing.assert_allclose(change, found.by_parameter[:, :, k], atol=1e-5)


def test_the_lever_arm_that_two_paths_have_is_found_and_their_difference_is_then_nothing() -> None:
    camera, arm = body_and_camera()
    body = moved(camera, arm.inverse())
    found = estimated_lever_arm(camera, body, 0.1)
    np.testing.assert_allclose(found.body_from_camera.translation, arm.translation, atol=1e-12)
    np.testing.assert_allclose(found.body_from_camera.rotation, arm.rotation, atol=1e-12)
    here = Registration(Pose(np.eye(3), np.zeros(3)), np.zeros((6, 6)), 0.0, 9)
    same = compare(camera, camera_by_rig(body, found, here), 0.1)
    assert np.abs(same.difference).max() < 1e-12
    off = LeverArm(Pose(arm.rotation, arm.translation + [0, 0, 0.01]), np.zeros((6, 6)))
    told = compare(camera, camera_by_rig(body, off, here), 0.1)
    np.testing.assert_allclose(np.linalg.norm(told.difference[:, :3], axis=1), 0.01)
    assert told.mean[:3] == pytest.approx(-0.01 * (camera.rotation @ arm.rotation.T)[:, :, 2].mean(axis=0))


def test_a_clock_error_moves_the_poses_along_their_motion() -> None:
    camera, _ = body_and_camera(60)
    late = 4_000_000
    path = with_clock(camera, 0.004)
    assert path.by_parameter is not None
    true = [pose_at(t * 1e-9 + late * 1e-9) for t in camera.time_ns.tolist()]
    errors = pose_errors(camera, np.array([p.rotation for p in true]), np.array([p.translation for p in true]))
    np.testing.assert_allclose(errors[1:-1], 0.004 * path.by_parameter[1:-1, :, 0], atol=2e-5)


def test_instants_without_near_poses_are_left_out() -> None:
    camera, _ = body_and_camera(10)
    kept = camera.select(np.array([0, 1, 2, 6, 7]))
    wanted = camera.time_ns[:-1] + 16_000_000
    found, inside = at_instants(kept, wanted, 0.05)
    assert inside.tolist() == [True, True, False, False, False, False, True, False, False]
    assert len(found) == 3
    with pytest.raises(InputError, match="0 of the camera's 10 poses lie between poses of the rig"):
        compare(replace(camera, time_ns=camera.time_ns + 10**10), kept, 0.05)


def test_a_bodys_poses_become_a_path_and_too_few_are_told() -> None:
    camera, _ = body_and_camera(3)
    quaternion = np.array([quaternion_from_rotation(r) for r in camera.rotation])
    poses = BodyPoses(
        np.arange(3), camera.time_ns, np.full(3, "drone"), quaternion, camera.position, camera.covariance,
        np.full(3, 5), np.zeros(3), np.full(3, "measured"),
    )  # fmt: skip
    path = body_path(poses, "drone")
    np.testing.assert_allclose(path.rotation, camera.rotation, atol=1e-12)
    with pytest.raises(InputError, match="body 'kite': 0 poses measured"):
        body_path(poses, "kite")
