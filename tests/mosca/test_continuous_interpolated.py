"""The interpolated baselines: tracks, intersection, adjustment with epipoles; against scipy and exact scenes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation

from mosca.camera.projection import project
from mosca.continuous.comparison_methods import initial_poses
from mosca.continuous.comparison_methods.epipoles import relative_pose
from mosca.continuous.comparison_methods.initial_poses import first_scene, in_datum
from mosca.continuous.comparison_methods.interpolated import ImageTracks, common_instants, interpolated
from mosca.continuous.comparison_methods.moving_projection import project_moving, rotated
from mosca.continuous.comparison_methods.synchronous import PosesAndPoints, Views, adjust, intersected
from mosca.continuous.model.camera_paths import PosedCameras, StillCameras
from mosca.data.motion.motion import PointMotion
from mosca.data.rig import Camera, FisheyeLens, Pose
from mosca.errors import InputError
from tests.studies.unsynchronised import observe, score, shared_frames, surround


def waving(points=12, frames=121):
    """Points that move about by sines, 1.7 m high, for a second at 120 Hz."""
    rng = np.random.default_rng(0)
    t = np.arange(frames) / 120.0
    middle = rng.uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 1.7], (points, 3))
    phase, size = rng.uniform(0, 6.3, (points, 3)), rng.uniform(0.05, 0.2, (points, 3))
    xyz = middle + size * np.sin(2 * np.pi * 1.2 * t[:, None, None] + phase)
    return PointMotion(tuple(f"p{k}" for k in range(points)), t, xyz)


def synchronous(truth, noise=0.0):
    rig = surround(truth)
    return rig, observe(truth, rig, every=9, apart=0, noise_px=noise)


def true_scene(rig, truth, instants):
    rotations, centres = StillCameras.of(rig).at(instants)
    return PosesAndPoints(rotations, centres, truth.xyz[np.rint(instants * 120).astype(int)])


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_slopes_of_an_image_point(seed):
    rng = np.random.default_rng(seed)
    lens = FisheyeLens(290.0, 280.0, 327.5, 245.0, 0.02, -0.003)
    camera = Camera("a", 656, 491, lens, Pose(np.eye(3), np.zeros(3)))
    turn = Rotation.random(random_state=rng).as_matrix()
    centre = rng.normal(size=3)
    # up to 115 degrees from the axis
    away = Rotation.from_rotvec([0, rng.uniform(-2, 2), 0]).apply([0, 0, 1.0])
    point = centre + turn @ away * rng.uniform(0.5, 3)
    found = project_moving(camera, turn[None], centre[None], point[None])

    def image(x):
        moved = rotated(turn[None], x[None, 3:6])
        return project_moving(camera, moved, (centre + x[6:])[None], (point + x[:3])[None]).xy_px[0]

    numeric = approx_fprime(np.zeros(9), image, 1e-7)
    ours = np.hstack([found.by_point[0], found.by_rotation[0], -found.by_point[0]])
    assert ours == pytest.approx(numeric, rel=1e-4, abs=1e-3)
    fixed = replace(camera, world_from_camera=Pose(turn, centre))
    assert found.xy_px == pytest.approx(project(fixed, point[None]), abs=1e-9)


@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_turns_are_rotations_by_vectors(vector):
    start = Rotation.from_rotvec([0.3, -1.0, 0.2])
    wanted = (start * Rotation.from_rotvec(vector)).as_matrix()
    assert rotated(start.as_matrix()[None], np.array([vector]))[0] == pytest.approx(wanted, abs=1e-12)


def test_tracks_are_scipys_splines_and_broken_at_gaps():
    truth = waving()
    rig = surround(truth)
    see = observe(truth, rig)
    mine = (see.camera == 1) & (see.point == 4)
    t, xy = see.time_s[mine], see.xy_px[mine]
    ask = np.array([t[0], 0.31, 0.55, t[-1]])
    assert ImageTracks(see, rig, "cubic").at(ask).xy_px[:, 1, 4] == pytest.approx(CubicSpline(t, xy)(ask))
    wanted = np.column_stack([np.interp(ask, t, xy[:, k]) for k in (0, 1)])
    assert ImageTracks(see, rig, "linear").at(ask).xy_px[:, 1, 4] == pytest.approx(wanted)
    # nothing before its first exposure, and nothing over two that are missing
    assert np.isnan(ImageTracks(see, rig, "cubic").at(np.array([t[0] - 0.01])).xy_px[0, 1, 4]).all()
    lost = ~(mine & ((see.exposure == 5) | (see.exposure == 6)))
    holed = ImageTracks(see.only(lost), rig, "cubic").at(np.array([t[5], t[2]])).xy_px[:, 1, 4]
    assert np.isnan(holed[0]).all()
    assert np.isfinite(holed[1]).all()


@pytest.mark.parametrize("cameras", ["known", "fixed", "moving"])
@pytest.mark.parametrize("epipoles", [True, False])
def test_exact_synchronous_points_come_back(cameras, epipoles):
    truth = waving()
    rig, see = synchronous(truth)
    found = interpolated(see, rig, "linear", cameras, epipoles=epipoles)
    at = np.rint(found.instants_s * 120).astype(int)
    assert found.rms_px < 1e-5
    # the datum is the rig's first camera and first base, so that no alignment is needed
    assert found.at(found.instants_s) == pytest.approx(truth.xyz[at], abs=1e-5)
    rotations, centres = found.paths.at(found.instants_s)
    wanted = StillCameras.of(rig).at(found.instants_s)
    assert rotations == pytest.approx(wanted[0], abs=1e-5)
    assert centres == pytest.approx(wanted[1], abs=1e-5)


@pytest.mark.parametrize("epipoles", [True, False])
def test_the_adjustment_is_scipys_least_squares(epipoles):
    """Noisy points and epipoles of one instant: no smaller cost is found from the truth by another solver."""
    truth = waving(points=8, frames=10)
    rig, see = synchronous(truth, noise=0.5)
    views = ImageTracks(see, rig, "linear").at(np.array([0.0]))
    start = true_scene(rig, truth, np.array([0.0]))
    ours = adjust(views, start, "fixed", epipoles=epipoles)

    def errors(x):
        poses = [Pose(r, c) for r, c in zip(start.rotations[0], start.centres[0], strict=True)]
        for k in (1, 2):
            step = x[6 * (k - 1) : 6 * k]
            turn = poses[k].rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
            poses[k] = Pose(turn, poses[k].translation + step[3:])
        points = np.concatenate([start.xyz[0] + x[12:].reshape(-1, 3), [p.translation for p in poses]])
        rest = []
        for k, camera in enumerate(rig.cameras):
            shown = [m for m in range(11) if m < 8 or (epipoles and m != 8 + k)]
            image = project(replace(camera, world_from_camera=poses[k]), points[shown])
            rest.append(views.xy_px[0, k, shown] - image)
        return np.concatenate(rest).ravel()

    theirs = least_squares(errors, np.zeros(36), x_scale="jac")
    assert ours.rms_px[0] == pytest.approx(np.sqrt(np.mean(theirs.fun**2)), rel=1e-5)


def test_a_lamp_beside_the_lens_is_carried_by_turn_and_place():
    """What is carried sits 10 cm off the projection centre: exact again, but not if taken for the centre."""
    truth = waving(frames=19)
    rig = surround(truth)
    see = observe(truth, rig, apart=0)
    at = np.array([0.1, -0.05, 0.02])
    xy = see.xy_px.copy()
    for k, camera in enumerate(rig.cameras):
        for other, carrier in enumerate(rig.cameras):
            row = (see.camera == k) & (see.point == 12 + other)
            xy[row] = project(camera, carrier.world_from_camera.transform(at[None]))
    places = np.where(see.carried_by[:, None] >= 0, at, 0.0)
    right = replace(see, xy_px=xy, carried_at=places)
    good = interpolated(right, rig, "linear", "fixed")
    assert good.rms_px < 1e-4
    wrong = interpolated(replace(see, xy_px=xy), rig, "linear", "fixed")
    assert wrong.rms_px > 0.1


def test_epipoles_steady_moving_cameras():
    """Camera positions at each instant by itself, 0.3 px noise: at least halved, and swapped epipoles do not fit."""
    truth = waving(points=15, frames=64)
    rig, see = synchronous(truth, noise=0.3)
    frames, still = shared_frames(see, truth), StillCameras.of(rig)
    errors = {}
    for epipoles in (True, False):
        found = interpolated(see, rig, "cubic", "moving", epipoles=epipoles)
        errors[epipoles] = score(found, truth, frames, aligned="once", paths=found.paths, true_paths=still)
    assert errors[True].camera_m < 0.5 * errors[False].camera_m
    assert errors[True].rms_m < errors[False].rms_m
    swapped = np.where(see.point == 15, 16, np.where(see.point == 16, 15, see.point))
    own = see.carried_by[swapped] == see.camera
    wrong = replace(see, point=swapped).only(~own)
    right = interpolated(see, rig, "cubic", "moving")
    assert interpolated(wrong, rig, "cubic", "moving").rms_px > 10 * right.rms_px


def test_cubic_beats_linear_for_cameras_that_take_turns():
    truth = waving()
    rig = surround(truth)
    see = observe(truth, rig)
    frames = shared_frames(see, truth)
    linear, cubic = (score(interpolated(see, rig, kind), truth, frames).rms_m for kind in ("linear", "cubic"))
    assert cubic < 0.3 * linear
    fixed = interpolated(see, rig, "cubic", "fixed")
    assert score(fixed, truth, frames, aligned="once").rms_m < 1.3 * cubic


def test_points_seen_by_one_camera_are_not_known():
    truth = waving()
    rig, see = synchronous(truth)
    found = interpolated(see.only((see.point != 3) | (see.camera == 0)), rig)
    xyz = found.at(np.array([0.2]))
    assert np.isnan(xyz[0, 3]).all()
    assert np.isfinite(np.delete(xyz[0], 3, axis=0)).all()


def test_intersection_of_two_rays_by_hand():
    lens = FisheyeLens(300.0, 300.0, 300.0, 300.0)
    left = Camera("left", 601, 601, lens, Pose(np.eye(3), np.zeros(3)))
    right = Camera("right", 601, 601, lens, Pose(np.eye(3), np.array([1.0, 0, 0])))
    # 45 degrees to either side: they meet at (0.5, 0, 0.5)
    xy = np.array([[[[300 + 300 * np.pi / 4, 300.0]], [[300 - 300 * np.pi / 4, 300.0]]]])
    views = Views((left, right), xy, np.array([-1]), np.zeros((1, 3)))
    centres = np.array([[[0.0, 0, 0], [1, 0, 0]]])
    assert intersected(views, np.tile(np.eye(3), (1, 2, 1, 1)), centres)[0, 0] == pytest.approx([0.5, 0, 0.5])


def test_datum_is_first_camera_and_first_base():
    truth = waving()
    rig, see = synchronous(truth)
    instants = common_instants(see)
    views = ImageTracks(see, rig, "linear").at(instants)
    scene = true_scene(rig, truth, instants)
    turn = Rotation.from_rotvec([0.4, 1.0, -2.0]).as_matrix()
    other = PosesAndPoints(turn @ scene.rotations, 3 * scene.centres @ turn.T + 1, 3 * scene.xyz @ turn.T + 1)
    back = in_datum(other, views)
    assert back.xyz == pytest.approx(scene.xyz, abs=1e-9)
    assert back.centres == pytest.approx(scene.centres, abs=1e-9)
    assert back.rotations == pytest.approx(scene.rotations, abs=1e-9)


def test_poses_between_instants():
    t = np.linspace(0, 1, 11)
    vectors = np.column_stack([0.2 * t, 3.0 * t, 0 * t])
    rotations = Rotation.from_rotvec(vectors).as_matrix()[:, None]
    centres = np.column_stack([t, t**2, 0 * t])[:, None]
    for kind, exact in (("linear", 3e-3), ("cubic", 1e-9)):
        paths = PosedCameras(("a",), t, rotations, centres, kind)
        found = paths.at(np.array([0.33, 2.0]))
        assert found[0][0, 0] == pytest.approx(Rotation.from_rotvec([0.066, 0.99, 0]).as_matrix(), abs=1e-6)
        assert found[1][0, 0] == pytest.approx([0.33, 0.33**2, 0], abs=exact)
        assert np.isnan(found[0][1]).all()
        assert np.isnan(found[1][1]).all()


def test_bad_input_is_one_line():
    truth = waving(frames=61)
    rig, see = synchronous(truth)
    late = np.where(see.camera == 2, see.time_s + 5, see.time_s)
    with pytest.raises(InputError, match=r"camera 'camera2': begins at 5\.000 s"):
        interpolated(replace(see, time_s=late), rig)
    with pytest.raises(InputError, match="camera 'camera1': 1 exposures"):
        interpolated(see.only((see.camera != 1) | (see.exposure == 0)), rig)
    apart = see.only((see.point % 3 == see.camera) & (see.carried_by[see.point] < 0))
    with pytest.raises(InputError, match="no two of them share 8 points"):
        interpolated(apart, rig, cameras="fixed")
    views = ImageTracks(apart, rig, "linear").at(common_instants(apart))
    with pytest.raises(InputError, match="at no instant"):
        first_scene(views, "moving")


def _with_wrong_names(see, cameras, share, seed=5):
    """Image points of ``cameras`` exchange their names within their exposure: this share of them."""
    rng = np.random.default_rng(seed)
    point = see.point.copy()
    for key in np.unique(see.exposure[np.isin(see.camera, cameras)]):
        for c in cameras:
            own = np.flatnonzero((see.camera == c) & (see.exposure == key) & (see.carried_by[see.point] < 0))
            some = own[rng.random(len(own)) < share]
            point[some] = rng.permutation(point[some])
    return replace(see, point=point)


def test_a_start_without_poses_holds_where_names_are_wrong():
    """A tenth of one camera's names wrong: the pair's pose is that of the others. The control: all used alike."""
    truth = waving(points=20)
    rig, see = synchronous(truth, 0.02)
    wrong = _with_wrong_names(see, (0,), 0.12)
    views = ImageTracks(wrong, rig, "linear").at(common_instants(wrong))
    rays = views.rays()[:, :2, views.free]
    both = np.isfinite(rays).all(axis=(1, 3))
    a, b = rays[:, 0][both], rays[:, 1][both]
    good = initial_poses._agreeing(a, b)
    true = rig.cameras[1].world_from_camera.inverse() @ rig.cameras[0].world_from_camera

    def turned(found):
        return np.rad2deg(Rotation.from_matrix(found.rotation @ true.rotation.T).magnitude())

    assert 0.8 < good.mean() < 0.99
    assert turned(relative_pose(a[good], b[good])) < 0.5
    assert turned(relative_pose(a, b)) > 2.0


def test_a_start_that_finds_no_pose_says_so():
    """All cameras share all points: that they share too few is no reason."""
    truth = waving()
    rig, see = synchronous(truth)
    turned = replace(see, xy_px=np.where((see.camera == 2)[:, None], 655.0 - see.xy_px, see.xy_px))
    nonsense = _with_wrong_names(turned, (2,), 1.0)
    with pytest.raises(InputError, match="no pose fits its images") as told:
        interpolated(nonsense, rig, cameras="fixed")
    assert "share 8 points" not in str(told.value)
