"""The second paper's experiment: schedule, cameras, scores, equal knots; with recorded motions where they are."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.interpolate import make_lsq_spline
from scipy.spatial.transform import Rotation

from mosca.continuous.comparison_methods.interpolated import interpolated
from mosca.continuous.estimator.estimate import ContinuousSettings, estimate
from mosca.continuous.model.camera_paths import StillCameras
from mosca.data.motion.motion import PointMotion
from mosca.data.rig import Pose, Rig
from mosca.errors import InputError
from tests.studies.unsynchronised import (
    JUMP,
    MOTIONS,
    TUNING,
    equal_knots_m,
    observe,
    read_points,
    score,
    shared_frames,
    surround,
)
from tests.studies.unsynchronised_worn import worn

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "cmu_mocap"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no CMU motions in {DATA} (set MOSCA_DATA)")


LEGS = {side + part for side in "lr" for part in ("femur", "tibia", "foot", "toes", "toes_end")}


def standing(frames=40):
    rng = np.random.default_rng(2)
    xyz = rng.uniform([-0.4, -0.4, 0], [0.4, 0.4, 1.7], (9, 3)) + np.zeros((frames, 1, 1))
    return PointMotion(tuple("abcdefghi"), np.arange(frames) / 120, xyz)


@dataclass
class Fixed:
    points: tuple[str, ...]
    xyz: np.ndarray

    def at(self, time_s):
        return self.xyz[np.rint(np.asarray(time_s) * 120).astype(int)]


def test_each_camera_takes_every_ninth_frame_three_after_the_one_before():
    truth = standing()
    see = observe(truth, surround(truth))
    frames = [np.unique(np.rint(see.time_s[see.camera == k] * 120)) for k in range(3)]
    assert frames[0].tolist() == [0, 9, 18, 27, 36]
    assert frames[1].tolist() == [3, 12, 21, 30, 39]
    assert frames[2].tolist() == [6, 15, 24, 33]
    assert shared_frames(see, truth)[[0, -1]].tolist() == [6, 33]


def test_image_points_are_opencvs_fisheye():
    truth = standing()
    rig = surround(truth)
    see = observe(truth, rig)
    for k, camera in enumerate(rig.cameras):
        inverse = camera.world_from_camera.inverse()
        matrix = np.array([[290.0, 0, 327.5], [0, 290, 245], [0, 0, 1]])
        everything = np.concatenate([truth.xyz[0], [c.world_from_camera.translation for c in rig.cameras]])
        rows = (see.camera == k) & (see.exposure == 0)
        turn = Rotation.from_matrix(inverse.rotation).as_rotvec()
        wanted = cv2.fisheye.projectPoints(
            everything[see.point[rows]][:, None], turn, inverse.translation, matrix, np.zeros(4)
        )[0][:, 0]
        assert see.xy_px[rows] == pytest.approx(wanted, abs=1e-6)
        # the other two cameras are seen, itself is not
        assert sorted(see.carried_by[see.point[rows]][-2:]) == sorted({0, 1, 2} - {k})


def test_cameras_see_each_other_thirty_degrees_from_the_axis():
    truth = standing()
    cameras = surround(truth).cameras
    for one in cameras:
        for other in cameras:
            away = other.world_from_camera.translation - one.world_from_camera.translation
            if other is not one:
                cosine = one.world_from_camera.rotation[:, 2] @ away / np.linalg.norm(away)
                assert 25 < np.degrees(np.arccos(cosine)) < 35
        middle = (truth.xyz.min((0, 1)) + truth.xyz.max((0, 1)))[:2] / 2
        assert np.linalg.norm(one.world_from_camera.translation[:2] - middle) == pytest.approx(3.0)


def test_scores_by_hand():
    truth = standing()
    frames = np.arange(10, 20)
    moved = Fixed(truth.names, truth.xyz + [0.003, 0.004, 0])
    assert score(moved, truth, frames).rms_m == pytest.approx(0.005)
    assert score(moved, truth, frames, aligned="once").rms_m == pytest.approx(0, abs=1e-12)
    turn = Rotation.from_rotvec([0.1, 2, 0.3]).as_matrix()
    similar = Fixed(truth.names, 0.4 * truth.xyz @ turn.T + 7)
    for aligned in ("once", "each frame"):
        assert score(similar, truth, frames, aligned=aligned).rms_m == pytest.approx(0, abs=1e-9)
    # a scale that drifts is an error for one similarity, none for one a frame
    drifting = Fixed(truth.names, truth.xyz * np.linspace(1, 2, 40)[:, None, None])
    assert score(drifting, truth, frames, aligned="once").rms_m > 0.01
    assert score(drifting, truth, frames, aligned="each frame").rms_m == pytest.approx(0, abs=1e-9)
    holed = truth.xyz.copy()
    holed[15, :3] = np.nan
    found = score(Fixed(truth.names, holed), truth, frames)
    assert found.completeness == pytest.approx(1 - 3 / 90)
    assert found.rms_m == 0


def test_equal_knots_leave_nothing_for_what_a_spline_can_say_and_scipys_otherwise():
    t = np.arange(91) / 120
    values = np.stack([t**3, t**2 - t, 0 * t], axis=1)[:, None]
    truth = PointMotion(("a",), t, values)
    assert equal_knots_m(truth, np.arange(91)) < 1e-12
    rough = PointMotion(("a",), t, values + 0.01 * np.sin(2 * np.pi * 11 * t)[:, None, None])
    knots = np.concatenate([[0] * 3, np.linspace(0, t[-1], 11), [t[-1]] * 3])
    rest = make_lsq_spline(t, rough.xyz[:, 0], knots)(t) - rough.xyz[:, 0]
    assert equal_knots_m(rough, np.arange(91)) == pytest.approx(np.sqrt((rest**2).sum(axis=1).mean()))
    assert equal_knots_m(rough, np.arange(91)) > 0.005


@needs_data
@pytest.mark.data
def test_motions_are_grown_persons_without_the_t_pose():
    for name in (*MOTIONS, *TUNING):
        truth = read_points(DATA, name)
        height = truth.xyz[0, :, 2].max() - truth.xyz[0, :, 2].min()
        assert 1.3 < height < 1.9, name
        assert 20 <= len(truth.names) <= 30
        first = np.linalg.norm(truth.xyz[1] - truth.xyz[0], axis=1) * 120
        assert first.max() < 12, name


@needs_data
@pytest.mark.data
def test_the_papers_order_on_the_jump():
    """Standing long jump, known cameras and a pose for each instant: linear > cubic, and epipoles help."""
    truth = read_points(DATA, JUMP)
    short = PointMotion(truth.names, truth.time_s[:100], truth.xyz[200:300])
    rig = surround(short)
    see = observe(short, rig)
    frames, still = shared_frames(see, short), StillCameras.of(rig)
    known = {k: score(interpolated(see, rig, k), short, frames).rms_m for k in ("linear", "cubic")}
    assert known["cubic"] < 0.75 * known["linear"]
    free = {
        e: score(found, short, frames, aligned="once", paths=found.paths, true_paths=still)
        for e in (True, False)
        for found in [interpolated(see, rig, "cubic", "moving", epipoles=e)]
    }
    assert free[True].rms_m < 1.3 * known["cubic"]
    assert free[True].rms_m < free[False].rms_m
    assert free[True].camera_m < 0.5 * free[False].camera_m


@needs_data
@pytest.mark.data
def test_worn_cameras_move_with_the_body_and_see_it():
    rig, paths = worn(DATA, "02_02")
    truth = read_points(DATA, "02_02")
    centres = paths.at(truth.time_s)[1]
    knee = truth.xyz[:, truth.names.index("rtibia")]
    # carried rigidly: a constant distance from its bone's joint
    away = np.linalg.norm(centres[:, 2] - knee, axis=1)
    assert away.std() < 1e-9
    assert away[0] == pytest.approx(0.2, abs=0.01)
    assert np.linalg.norm(centres[-1] - centres[0], axis=1).min() > 2
    see = observe(truth, rig, paths=paths)
    shown = len(see) / (len(np.unique(np.column_stack([see.camera, see.exposure]), axis=0)) * (len(truth.names) + 2))
    assert shown > 0.7
    with pytest.raises(InputError, match="at the motion's frames only"):
        paths.at(np.array([0.0041]))


@needs_data
@pytest.mark.data
def test_unknown_cameras_cost_nothing_where_toes_jump():
    # exact image points of still cameras leave their poses open by micrometres (the normal equations at
    # the truth: 1.00 times the error with known ones); image points of jumps must not stay out
    whole = read_points(DATA, "131_04")
    below = [k for k, name in enumerate(whole.names) if name in LEGS]
    truth = PointMotion(tuple(whole.names[k] for k in below), whole.time_s, whole.xyz[:, below])
    rig = surround(truth)
    see = observe(truth, rig)
    frames = shared_frames(see, truth)
    known = score(estimate(see, rig).curves, truth, frames)
    start = interpolated(see, rig, "cubic", "fixed")
    within = (see.time_s >= start.instants_s[0] - 1e-9) & (see.time_s <= start.instants_s[-1] + 1e-9)
    poses = zip(rig.cameras, start.scene.rotations[0], start.scene.centres[0], strict=True)
    near = Rig(tuple(replace(camera, world_from_camera=Pose(r, c)) for camera, r, c in poses))
    found = estimate(see.only(within), near, ContinuousSettings(cameras="fixed"), start)
    unknown = score(found.curves, truth, frames, aligned="once")
    assert unknown.rms_m < 1.3 * known.rms_m


@needs_data
@pytest.mark.data
def test_our_curves_are_as_exact_as_they_say_on_recorded_persons():
    """Means over three motions: a person's motion is no process of any prior, single ones are off by two."""
    squares, ratio = [], []
    for name in ("02_01", "02_03", "09_06"):
        whole = read_points(DATA, name)
        truth = PointMotion(whole.names, whole.time_s[:200], whole.xyz[:200])
        rig = surround(truth)
        see = observe(truth, rig, epipoles=False)
        frames = shared_frames(see, truth)
        curves = estimate(see, rig).curves
        time_s, column = truth.time_s[frames], [curves.points.index(n) for n in truth.names]
        away = curves.at(time_s)[:, column] - truth.xyz[frames]
        covariance = curves.covariance_at(time_s)[:, column]
        squares.append(np.einsum("tpi,tpi->tp", away, np.linalg.solve(covariance, away[..., None])[..., 0]))
        cubic = score(interpolated(see, rig, "cubic"), truth, frames).rms_m
        ratio.append(np.sqrt((away**2).sum(axis=2).mean()) / cubic)
    assert 0.88 < np.mean([(s < 7.815).mean() for s in squares]) < 0.98
    assert 1.5 < np.mean([s.mean() for s in squares]) < 5
    # linear > cubic > ours
    assert max(ratio) < 0.75
