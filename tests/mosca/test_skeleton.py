"""The skeleton's equations, fit and covariances, on takes made from parameters drawn from the model's own prior."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.motion.motion import forward_kinematics, matrices_from_quaternions
from mosca.data.tracks import Tracks
from mosca.skeleton.anatomical_axes import axes_from
from mosca.skeleton.fit import fit_subject
from mosca.skeleton.joint_kernels import read_joints
from mosca.skeleton.joints import JointReader, SegmentAxes
from mosca.skeleton.kernels import fill_slopes, place, unpack
from mosca.skeleton.marker_frames import MarkerFrames, marker_frames
from mosca.skeleton.model import HUMAN, Kinematics, read_skeleton_model
from mosca.skeleton.pose import TINY, linearised, pose_by_parameters, solve_pose
from mosca.skeleton.pose_kernels import fit_pose, information_of
from mosca.skeleton.skin import common_modes
from mosca.skeleton.start import starting_pose
from mosca.skeleton.track import motion_of, track_subject

LEGS = (
    *("LASI", "RASI", "LPSI", "RPSI", "LWT", "RWT"),
    *(f"{s}{name}" for s in "LR" for name in ("THI", "THF", "KNE", "KNM", "TIB", "SHN", "ANK", "ANM")),
    *(f"{s}{name}" for s in "LR" for name in ("HEE", "TOE", "MT5")),
)  # fmt: skip
NOISE_M = 3e-4
CENTRES = ("l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle")


@pytest.fixture(scope="module")
def model():
    return read_skeleton_model(HUMAN, LEGS)


def posed(kinematics, rng, n):
    """Return poses (n, nq) of a range of motion: every ball joint by up to 40 degrees about all axes, smoothly."""
    time = np.linspace(0, 1, n)[:, None]
    waves = rng.uniform(1, 3, kinematics.mj.nv), rng.uniform(0, 2 * np.pi, kinematics.mj.nv)
    tangent = 0.5 * np.sin(2 * np.pi * waves[0] * time + waves[1])
    for joint in ("l_knee", "r_knee"):
        first = int(kinematics.mj.joint(joint).dofadr[0])
        tangent[:, first : first + 2] = 0.0  # hinges
        tangent[:, first + 2] -= 0.6
    upright = np.array(kinematics.mj.qpos0)
    upright[3:7] = Rotation.from_euler("x", 90, degrees=True).as_quat()[[3, 0, 1, 2]]
    return np.array([kinematics.moved(upright, row) for row in tangent])


def take(model, seed, n, noise=NOISE_M):
    """Return frames of a drawn person and the true joint centres (n, 6, 3) and knee rotations (n, 2, 3, 3)."""
    rng = np.random.default_rng(seed)
    drawn = model.parameters + np.linalg.solve(
        np.linalg.cholesky(model.information).T, rng.normal(size=len(model.parameters))
    )
    kinematics = Kinematics(model, drawn)
    xyz, centres = np.empty((n, len(model.labels), 3)), np.empty((n, len(CENTRES), 3))
    for k, q in enumerate(posed(kinematics, rng, n)):
        kinematics.pose(q)
        xyz[k] = kinematics.markers()
        centres[k] = kinematics.joint_centres()[[kinematics.mj.joint(joint).id for joint in CENTRES]]
    xyz += rng.normal(0, noise, xyz.shape)
    covariance = np.broadcast_to(noise**2 * np.eye(3), (*xyz.shape, 3))
    frame = np.arange(n)
    return MarkerFrames(model.labels, frame, frame * 10_000_000, xyz, covariance), centres


def differences(function, at, step=1e-6):
    """Return central differences of ``function`` (an array) by each element of ``at``, last axis."""
    return np.stack([(function(at + d) - function(at - d)) / (2 * step) for d in step * np.eye(len(at))], axis=-1)


def test_derivatives_are_those_of_differences(model):
    kinematics, rng = Kinematics(model), np.random.default_rng(3)
    q = posed(kinematics, rng, 2)[1]
    markers, bodies = kinematics.body_of_marker, np.arange(1, kinematics.mj.nbody)

    def at_pose(step):
        kinematics.pose(kinematics.moved(q, step))
        return kinematics.markers()

    def at_parameters(parameters):
        kinematics.set_parameters(parameters)
        kinematics.pose(q)
        return kinematics.markers()

    zero = np.zeros(kinematics.mj.nv)
    kinematics.pose(q)
    start = kinematics.rotations()[bodies]

    def turned(step):
        kinematics.pose(kinematics.moved(q, step))
        return Rotation.from_matrix(kinematics.rotations()[bodies] @ start.transpose(0, 2, 1)).as_rotvec()

    slopes = kinematics.by_pose(kinematics.markers(), markers), kinematics.turned_by_pose(bodies)
    np.testing.assert_allclose(slopes[0], differences(at_pose, zero), atol=1e-8)
    np.testing.assert_allclose(slopes[1], differences(turned, zero), atol=1e-8)
    kinematics.pose(q)
    expected = differences(at_parameters, model.parameters)[:, :, : 3 * len(model.joints)]
    kinematics.set_parameters(model.parameters)
    kinematics.pose(q)
    np.testing.assert_allclose(kinematics.by_parameters(markers), expected, atol=1e-8)
    vectors, by_tangent = kinematics.rotation_vectors(q)
    witness = Rotation.from_quat(q[7:].reshape(-1, 4)[:, [1, 2, 3, 0]]).as_rotvec()
    np.testing.assert_allclose(vectors, witness, atol=1e-12)
    expected = differences(lambda step: kinematics.rotation_vectors(kinematics.moved(q, step))[0], zero)
    blocks = [expected[k, :, 6 + 3 * k : 9 + 3 * k] for k in range(len(vectors))]
    np.testing.assert_allclose(by_tangent, blocks, atol=1e-8)


def test_places_and_derivatives_are_mujocos():
    model = read_skeleton_model(HUMAN, (*LEGS, "C7", "LELB", "RFIN", "LFHD"))
    turned = model.mjcf.replace('<body name="l_shank"', '<body quat="0.9 0.1 -0.3 0.2" name="l_shank"')
    assert turned != model.mjcf
    kinematics = Kinematics(replace(model, mjcf=turned), model.parameters * 1.1)
    mj, data = kinematics.mj, mujoco.MjData(kinematics.mj)
    for q in posed(kinematics, np.random.default_rng(2), 4):
        data.qpos[:] = np.concatenate([3 * q[:3], q[3:]])
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_comPos(mj, data)
        kinematics.pose(np.concatenate([3 * q[:3], 5 * q[3:]]))  # quaternions of any length
        np.testing.assert_allclose(kinematics.joint_centres(), data.xpos[1:], atol=1e-12)
        np.testing.assert_allclose(kinematics.rotations().reshape(-1, 9), data.xmat, atol=1e-12)
        slopes = kinematics.by_pose(kinematics.markers(), kinematics.body_of_marker)
        turns = kinematics.turned_by_pose(kinematics.body_of_marker)
        for k, label in enumerate(model.labels):
            site = mj.site(label).id
            np.testing.assert_allclose(kinematics.markers()[k], data.site_xpos[site], atol=1e-12)
            by_place, by_turn = np.empty((2, 3, mj.nv))
            mujoco.mj_jacSite(mj, data, by_place, by_turn, site)
            np.testing.assert_allclose(slopes[k], by_place, atol=1e-12)
            np.testing.assert_allclose(turns[k], by_turn, atol=1e-12)


@pytest.mark.parametrize("robust", [3.0, 1e9])
def test_equations_are_those_of_whole_matrices(model, robust):
    free = replace(model, rotation_sigma=np.full_like(model.rotation_sigma, np.inf))
    kinematics, rng = Kinematics(free), np.random.default_rng(5)
    q = posed(kinematics, rng, 3)[2]
    kinematics.pose(q)
    places = kinematics.markers()
    m = len(places)
    half = rng.normal(size=(m, 3, 3))
    information = half @ half.transpose(0, 2, 1) + np.eye(3)
    target = places + rng.normal(size=places.shape) * 3
    target[4] = np.nan
    found = linearised(kinematics, q, target, information, robust)
    slopes = kinematics.by_pose(places, kinematics.body_of_marker)
    seen = np.isfinite(target[:, 0])
    residual = np.where(seen[:, None], target - places, 0.0)
    distance = np.sqrt(np.einsum("mi,mij,mj->m", residual, information, residual))
    weight = np.minimum(1.0, robust / np.maximum(distance, 1e-9))
    weighted = (weight * seen)[:, None, None] * information
    np.testing.assert_allclose(found.slopes, slopes, atol=1e-12)
    np.testing.assert_allclose(found.normal, np.einsum("mia,mij,mjb->ab", slopes, weighted, slopes), atol=1e-9)
    np.testing.assert_allclose(found.gradient, np.einsum("mia,mij,mj->a", slopes, weighted, residual), atol=1e-9)
    huber = np.where(distance > robust, robust * (2 * distance - robust), distance**2)
    assert found.cost == pytest.approx(huber[seen].sum(), rel=1e-12)


def test_the_prior_is_that_of_rotation_vectors(model):
    """Without markers: cost, gradient and normal matrix of (vector - mean) / sigma, by differences of SciPy's."""
    kinematics, rng = Kinematics(model), np.random.default_rng(6)
    q, mean = posed(kinematics, rng, 3)[2], rng.normal(0, 0.1, kinematics.mj.nv)
    nothing = np.full((len(model.labels), 3), np.nan), np.zeros((len(model.labels), 3, 3))
    found = linearised(kinematics, q, *nothing, posture=mean, share=0.5)

    def off(step):
        balls = kinematics.moved(q, step)[7:].reshape(-1, 4)
        vectors = Rotation.from_quat(balls[:, [1, 2, 3, 0]]).as_rotvec().ravel()
        return np.sqrt(0.5) * (vectors - mean[6:]) / model.rotation_sigma[6:]

    zero = np.zeros(kinematics.mj.nv)
    slopes = differences(off, zero)
    assert found.cost == pytest.approx(off(zero) @ off(zero), rel=1e-12)
    np.testing.assert_allclose(found.gradient, -slopes.T @ off(zero), atol=1e-6)
    np.testing.assert_allclose(found.normal, slopes.T @ slopes, rtol=1e-6, atol=1e-5)


def test_covariances_of_joints_are_those_of_whole_matrices(model):
    """Of the pose's noise, of movement over skin and of the parameters, each by its own matrices."""
    kinematics, rng = Kinematics(model), np.random.default_rng(7)
    p, bodies = len(model.parameters), [kinematics.mj.body(k).name for k in range(kinematics.mj.nbody)]
    half = rng.normal(0, 1e-3, (p, p))
    common = np.full(len(model.labels), 2e-3)
    known = [name for name in bodies[1:] if name != "r_foot"]
    axes = {name: Rotation.random(random_state=k).as_matrix() for k, name in enumerate(known)}
    turns = {name: rng.normal(0, 3.0, (3, p)) for name in axes}
    q = posed(kinematics, rng, 3)[1]
    kinematics.pose(q)
    xyz = kinematics.markers() + rng.normal(0, 0.01, (len(common), 3))
    xyz[3] = np.nan
    at = solve_pose(kinematics, q, xyz, np.tile(1e5 * np.eye(3), (len(xyz), 1, 1)))
    reader = JointReader(kinematics, SegmentAxes(axes, turns), half @ half.T, common)
    centre, centre_covariance, rotation, rotation_covariance = reader.read(at)

    inverse = np.linalg.inv(at.normal + TINY * np.eye(len(at.normal)))
    by_parameters = -inverse @ pose_by_parameters(kinematics, at.slopes, at.weighted)
    modes = kinematics.rotations()[kinematics.body_of_marker] @ common_modes(
        kinematics.local, kinematics.body_of_marker, common
    )
    moved = inverse @ np.einsum("miv,mij,mjk->vk", at.slopes, at.weighted, modes)
    noise = inverse + moved @ moved.T
    place, world_from = kinematics.joint_centres(), kinematics.rotations()
    for joint, near, far in (("l_knee", "l_thigh", "l_shank"), ("r_hip", "pelvis", "r_thigh")):
        k, body, near, far = reader.joints.index(joint), bodies.index(far), bodies.index(near), bodies.index(far)
        np.testing.assert_allclose(centre[k], place[body - 1], atol=1e-12)
        slopes = kinematics.by_pose(place[[body - 1]], np.array([body]))[0]
        direct = np.zeros((3, p))
        direct[:, : 3 * len(model.joints)] = kinematics.by_parameters(np.array([body]))[0]
        total = direct + slopes @ by_parameters
        np.testing.assert_allclose(centre_covariance[k], slopes @ noise @ slopes.T + total @ half @ half.T @ total.T)
        near_axes, far_axes = (world_from[b] @ axes[bodies[b]] for b in (near, far))
        np.testing.assert_allclose(rotation[k], near_axes.T @ far_axes, atol=1e-12)
        turned = kinematics.turned_by_pose(np.array([far]))[0] - kinematics.turned_by_pose(np.array([near]))[0]
        own = turns[bodies[far]] - rotation[k].T @ turns[bodies[near]]
        total, landmarks = own + far_axes.T @ turned @ by_parameters, 2e-3 * own[:, 3 * len(model.joints) :]
        expected = far_axes.T @ turned @ noise @ turned.T @ far_axes + total @ half @ half.T @ total.T
        np.testing.assert_allclose(rotation_covariance[k], expected + landmarks @ landmarks.T)
    hips = [bodies.index(f"{side}_thigh") for side in "lr"]
    np.testing.assert_allclose(centre[0], place[[b - 1 for b in hips]].mean(axis=0), atol=1e-12)
    assert np.isnan(rotation_covariance[reader.joints.index("r_ankle")]).all()
    assert np.isfinite(centre_covariance[0]).all()


def test_a_pose_is_found_without_knowing_one(model):
    frames, _ = take(model, 11, 5, noise=1e-6)
    kinematics = Kinematics(model)
    found = starting_pose(kinematics, frames.xyz[3])
    assert np.median(np.linalg.norm(found.residual, axis=1)) < 0.04  # markers as drawn, up to 6 cm off the model


def test_a_far_marker_moves_a_pose_little(model):
    kinematics = Kinematics(model)
    q = posed(kinematics, np.random.default_rng(8), 3)[1]
    kinematics.pose(q)
    xyz = kinematics.markers()
    information = np.tile(np.eye(3) / 1e-6, (len(xyz), 1, 1))
    wrong = xyz.copy()
    wrong[model.labels.index("LTIB")] += [0.3, 0.0, 0.0]
    robust = solve_pose(kinematics, q, wrong, information)
    plain = solve_pose(kinematics, q, wrong, information, robust=1e9)
    others = np.arange(len(xyz)) != model.labels.index("LTIB")
    away = [float(np.linalg.norm(one.residual[others])) for one in (robust, plain)]
    assert away[0] < 0.01 < 0.05 < away[1]


def test_axes_are_right_handed_with_the_first_as_given():
    rng = np.random.default_rng(0)
    for first, second in ((0, 2), (1, 2), (2, 0)):
        along, toward = rng.normal(size=(2, 3))
        axes = axes_from(first, along, second, toward)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes[:, first], along / np.linalg.norm(along), atol=1e-12)
        assert axes[:, second] @ toward > 0


def test_common_modes_are_rigid_and_of_the_stated_size():
    rng = np.random.default_rng(2)
    local, body = rng.normal(size=(9, 3)), np.repeat([1, 4, 7], 3)
    common = np.repeat([0.001, 0.002, 0.003], 3)
    modes = common_modes(local, body, common)
    assert modes.shape == (9, 3, 18)
    for k in range(18):
        rows = np.flatnonzero(np.abs(modes[:, :, k]).sum(axis=1))
        assert len(set(body[rows])) == 1
        assert np.sqrt(np.mean(np.sum(modes[body == body[rows[0]], :, k] ** 2, axis=1))) <= 1.8 * common[rows[0]]
        for i in rows:
            for j in rows:  # a shift or a small turn: distances stay
                assert (local[i] - local[j]) @ (modes[i, :, k] - modes[j, :, k]) == pytest.approx(0.0, abs=1e-12)


@pytest.fixture(scope="module")
def fitted(model):
    """Takes of three drawn persons with their fits; 40 frames each."""
    found = []
    for seed in range(3):
        frames, centres = take(model, seed, 40)
        subject = fit_subject(model, frames)
        found.append((subject, frames, centres, track_subject(subject, frames)))
    return found


def test_joint_centres_of_drawn_persons_are_where_they_are(fitted):
    errors = np.concatenate([_errors(one)[0] for one in fitted])
    hips = errors[:, :2]
    assert np.sqrt(np.mean(np.sum(hips**2, axis=2))) < 1.5e-3
    assert (
        np.sqrt(np.mean(np.sum(errors**2, axis=2))) < 4e-3
    )  # knees along their hinge: by the middle of markers, 2.2 mm


def test_stated_covariances_hold_the_errors(fitted):
    """nees is 3 where stated errors are right; three persons' constant errors are 54 draws: 2 to 4.3 by chance."""
    nees = []
    for one in fitted:
        errors, covariance = _errors(one)
        nees.append(np.einsum("nji,njik,njk->nj", errors, np.linalg.inv(covariance), errors))
    assert 1.5 < np.mean(nees) < 4.5


SHIFT_M = 4e-4


@pytest.mark.parametrize(("told", "least", "most"), [(True, 1.2, 3.3), (False, 4.0, np.inf)])
def test_a_shift_of_all_markers_is_in_the_joints_covariances(fitted, told, least, most):
    """Control: each marker is said to have it for itself, so that it is averaged over the markers.

    What does not change in a take is left out: the fit's error, which the covariances have too, hence less than 3.
    """
    subject, frames, centres, _ = fitted[0]
    n, shift = len(frames), SHIFT_M**2 * np.eye(3)
    moved = np.random.default_rng(1).normal(0, SHIFT_M, (n, 1, 3))
    own = frames.covariance if told else frames.covariance + shift
    shared = np.tile(shift if told else 0 * shift, (n, 1, 1))
    seen = MarkerFrames(frames.labels, frames.frame, frames.time_ns, frames.xyz + moved, own, shared)
    errors, covariance = _errors((subject, seen, centres, track_subject(subject, seen)))
    hips = errors[:, :2] - errors[:, :2].mean(axis=0)
    assert least < np.mean(np.einsum("nji,njik,njk->nj", hips, np.linalg.inv(covariance[:, :2]), hips)) < most


def test_frames_that_err_alike_count_as_fewer(model):
    """Noise that stays for four frames at a time leaves a quarter of the frames' information."""
    still, rng = take(model, 0, 40, noise=1e-9)[0], np.random.default_rng(3)
    sizes = []
    for length in (1, 4):
        noise = np.repeat(rng.normal(0, NOISE_M, (40 // length, len(model.labels), 3)), length, axis=0)
        covariance = np.broadcast_to(NOISE_M**2 * np.eye(3), still.covariance.shape)
        frames = MarkerFrames(still.labels, still.frame, still.time_ns, still.xyz + noise, covariance)
        sizes.append(np.linalg.eigvalsh(fit_subject(model, frames).covariance))
    known = slice(0, len(sizes[0]) // 2)  # by the markers; the prior knows the rest as well
    assert 2.5 < np.median(sizes[1][known] / sizes[0][known]) < 5.0


def _errors(one):
    _, _, centres, found = one
    joints = [found.joints.joints.index(name) for name in CENTRES]
    return found.joints.centre[:, joints] - centres, found.joints.centre_covariance[:, joints]


def test_noise_is_no_movement_on_the_skin(fitted):
    """A marker that does not slide has none, not the least that keeps weights finite: twice that, in 150 frames that
    count as 6, would be as large as the noise of a good rig."""
    assert np.mean([subject.skin_m == 0 for subject, *_ in fitted]) > 0.9


def test_rotations_are_rotations_and_knees_flex_about_z(fitted):
    subject, _, _, found = fitted[0]
    knee = found.joints.rotation[:, found.joints.joints.index("l_knee")]
    assert np.isfinite(knee).all()
    np.testing.assert_allclose(np.linalg.norm(knee, axis=1), 1.0, atol=1e-9)
    vectors = Rotation.from_matrix(matrices_from_quaternions(knee)).as_rotvec()
    spread = vectors.std(axis=0)
    assert spread[2] > 10 * max(spread[0], spread[1])  # flexion alone varies
    assert {"l_thigh", "l_shank", "pelvis"} <= set(subject.axes.axes)


def test_axes_slopes_are_those_of_differences(model, fitted):
    """Of a thigh, whose y axis follows the knee's place, z its flexion axis, which stays in this body here."""
    subject = fitted[0][0]
    rows = model.joint_rows("l_knee")

    def y_axis(knee):
        return -knee / np.linalg.norm(knee)

    expected = differences(y_axis, subject.parameters[rows])
    axes, slopes = subject.axes.axes["l_thigh"], subject.axes.slopes["l_thigh"][:, rows]
    # A rotation vector r in anatomical axes moves the y axis by A (r x e_y).
    moved = axes @ np.cross(slopes.T, [0.0, 1.0, 0.0]).T
    np.testing.assert_allclose(moved, expected, atol=1e-3)


def test_a_motion_stands_upright_with_the_fitted_joints(fitted):
    subject, _, _, found = fitted[0]
    motion = motion_of(subject, found.q, 100.0)
    positions, _ = forward_kinematics(motion)
    for name in CENTRES:
        expected = found.joints.centre[:, found.joints.joints.index(name)]
        np.testing.assert_allclose(positions[:, motion.skeleton.names.index(name)], expected, atol=1e-9)


def test_frames_with_too_few_markers_have_no_pose(model, fitted):
    subject, frames, _, _ = fitted[0]
    xyz = frames.xyz[:3].copy()
    xyz[1, 5:] = np.nan
    hidden = MarkerFrames(frames.labels, frames.frame[:3], frames.time_ns[:3], xyz, frames.covariance[:3])
    found = track_subject(subject, hidden)
    assert np.isfinite(found.q[[0, 2]]).all()
    assert np.isnan(found.q[1]).all()
    assert np.isnan(found.joints.centre[1]).all()


def test_kernels_are_compiled_once(fitted):
    """Frames are read-only and poses are not: kernels given both as they are would be compiled for each."""
    assert not fitted[0][1].xyz.flags.writeable
    for one in (fit_pose, information_of, place, fill_slopes, unpack, read_joints):
        assert len(one.signatures) == 1, one.py_func.__name__


def test_no_tracks_are_no_frames():
    assert len(marker_frames(Tracks.none(), ("LASI", "RASI"))) == 0
