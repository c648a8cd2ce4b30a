"""Calibration from rigid targets: still fields, moved boards, all lens models, blunders, errors."""

from dataclasses import replace

import numpy as np
import pytest
from rigid_scenes import board_marks, carried, errors_of, field_marks, seen, some_rig, still, stood
from rigs import ring

from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.camera.projection import project
from mosca.data.rig import FisheyeLens, Pose, Rig
from mosca.errors import CalibrationError

PITCH = 0.0099
MOSCA, OPENCV = RigidSettings(LensChoice("mosca", PITCH)), RigidSettings(LensChoice("opencv"))


def worst(calibration, rig, poses) -> float:
    """Return the largest error over its stated standard deviation."""
    return max(abs(e) / s for e, s in errors_of(calibration, rig, poses).values())


def in_world_of(calibration, rig, poses) -> Rig:
    """Return the true rig in the world of the calibration: the target at its reference."""
    reference = poses[calibration.sightings.frame[calibration.placement < 0][0]].inverse()
    return Rig(tuple(replace(c, world_from_camera=reference @ c.world_from_camera) for c in rig.cameras))


@pytest.mark.parametrize(("model", "settings"), [("mosca", MOSCA), ("opencv", OPENCV)])
def test_a_standing_field(model, settings):
    rng = np.random.default_rng(1)
    rig, marks = some_rig(rng, model=model), field_marks(rng)
    sightings = seen(rig, marks, still(5), rng, shake=0.03)
    done = calibrate_rigid(sightings, RigidTarget("field", marks), settings)
    for true, one in zip(rig.cameras, done.rig.cameras, strict=True):
        # 0.03 px / sqrt(5) of shake in the mean image, 0.02 px / sqrt(5) sqrt(16 / 240) of noise, in two coordinates
        away = project(one, marks) - project(true, marks)
        assert np.sqrt(np.nanmean((away**2).sum(axis=1))) < 3 * np.sqrt(2) * np.hypot(0.0134, 0.0023)
    assert worst(done, rig, still(5)) < 4.5
    assert done.body_px == pytest.approx(0.03, abs=0.012)
    assert done.sigma0 == pytest.approx(1, abs=0.05)
    assert done.weak == done.held == ()
    assert done.used.mean() > 0.999
    np.testing.assert_allclose(done.sigma_px, 0.02, rtol=0.1)


def fisheye_rig(rng) -> Rig:
    lenses = [FisheyeLens(260.0, 261.0, 325 + rng.normal(), 246 + rng.normal(), -0.03, 0.004) for _ in range(3)]
    return ring(3, lenses, radius_m=2.5, height_m=0.8, first_rad=0.0, step_rad=2.1, names=("cam1", "cam2", "cam3"))


def test_a_fisheye_rig_from_a_field():
    rng = np.random.default_rng(2)
    rig, marks = fisheye_rig(rng), rng.uniform(-1.6, 1.6, (160, 3)) * [1, 1, 0.9]
    far = np.min([np.linalg.norm(marks - c.world_from_camera.translation, axis=1) for c in rig.cameras], axis=0)
    marks = marks[far > 0.8]
    sightings = seen(rig, marks, still(3), rng)
    done = calibrate_rigid(sightings, RigidTarget("field", marks), RigidSettings(LensChoice("fisheye")))
    assert worst(done, rig, still(3)) < 4.5
    # Rayleigh's mean of two coordinates of 0.02 px
    assert np.hypot(*done.residuals_px.T).mean() == pytest.approx(0.02 * np.sqrt(np.pi / 2), rel=0.1)


@pytest.mark.parametrize("model", ["mosca", "opencv"])
def test_a_carried_board(model):
    rng = np.random.default_rng(3)
    rig, marks, poses = some_rig(rng, model=model), board_marks(), carried(rng, 60)
    facing = np.tile([0.0, 0.0, -1.0], (len(marks), 1))
    sightings = seen(rig, marks, poses, rng, facing=facing)
    done = calibrate_rigid(sightings, RigidTarget("board", marks), MOSCA if model == "mosca" else OPENCV)
    assert worst(done, rig, poses) < 4.5
    # the whole world may be off as its one reference view is; lengths are not: those between cameras
    centres = [
        np.array([c.world_from_camera.translation for c in r.cameras])
        for r in (in_world_of(done, rig, poses), done.rig)
    ]
    i, j = np.triu_indices(4, 1)
    lengths = [np.linalg.norm(c[i] - c[j], axis=1) for c in centres]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=5e-4)
    # the poses of the board, too
    world = done.points_in_world()
    assert done.target_translation.shape == (len(np.unique(done.placement)) - 1, 3)
    for k in (0, 1):
        at = in_world_of(done, rig, poses).cameras[k].world_from_camera.translation
        assert np.linalg.norm(world - at, axis=1).min() > 1


def test_stands_with_marks_nearly_known_improve_the_marks():
    rng = np.random.default_rng(4)
    rig, marks, poses = some_rig(rng), field_marks(rng, 60), stood(rng, 4, 2)
    sigma = 2e-4
    given = marks + rng.normal(0, sigma, marks.shape)
    done = calibrate_rigid(seen(rig, marks, poses, rng), RigidTarget("field", given, sigma), MOSCA)
    assert worst(done, rig, poses) < 4.5
    # residuals after the frame's own shift and rotation, which images do not determine
    before, after = given - marks, done.marks_m - marks
    assert np.std(after - after.mean(axis=0)) < 0.5 * np.std(before)
    assert len(done.target_translation) == 3


def test_blunders_are_found():
    rng = np.random.default_rng(5)
    rig, marks = some_rig(rng), field_marks(rng)
    sightings = seen(rig, marks, still(5), rng, shake=0.03)
    wrong = rng.choice(len(sightings), len(sightings) // 50, replace=False)
    xy = sightings.xy_px.copy()
    way = rng.uniform(0, 2 * np.pi, len(wrong))
    xy[wrong] += rng.uniform(2, 40, (len(wrong), 1)) * np.column_stack([np.cos(way), np.sin(way)])
    done = calibrate_rigid(replace(sightings, xy_px=xy), RigidTarget("field", marks), MOSCA)
    assert not done.used[wrong].any()
    assert done.used.sum() >= len(sightings) - len(wrong) - 2
    assert worst(done, rig, still(5)) < 4.5
    # blunders do not pass for shakes
    assert done.body_px == pytest.approx(0.03, abs=0.012)


def test_exterior_only_keeps_the_lenses_after_the_rig_moved():
    rng = np.random.default_rng(6)
    rig, marks = some_rig(rng), field_marks(rng)
    aside = Pose(np.eye(3), [0.2, -0.1, 0.05])
    moved = Rig(tuple(replace(c, world_from_camera=aside @ c.world_from_camera) for c in rig.cameras))
    sightings = seen(moved, marks, still(2), rng)
    settings = replace(MOSCA, exterior_only=True)
    done = calibrate_rigid(sightings, RigidTarget("field", marks), settings, known=rig)
    for true, one in zip(moved.cameras, done.rig.cameras, strict=True):
        assert one.lens == true.lens
        shift = one.world_from_camera.translation - true.world_from_camera.translation
        assert np.linalg.norm(shift) < 2e-4
    assert worst(done, moved, still(2)) < 4.5
    assert len(done.parameters) == 24


def test_the_reference_is_the_frame_asked_for():
    rng = np.random.default_rng(7)
    rig, marks, poses = some_rig(rng), field_marks(rng, 60), stood(rng, 3, 1)
    sightings = seen(rig, marks, poses, rng)
    done = calibrate_rigid(sightings, RigidTarget("field", marks), replace(MOSCA, reference=2))
    assert set(sightings.frame[done.placement < 0]) == {2}
    assert worst(done, rig, poses) < 4.5


def test_unknown_marks_are_left_out():
    rng = np.random.default_rng(8)
    rig, marks = some_rig(rng, n=2), field_marks(rng, 60)
    sightings = seen(rig, marks, still(2), rng)
    mark = sightings.mark.copy()
    mark[::10] = -1
    done = calibrate_rigid(replace(sightings, mark=mark), RigidTarget("field", marks), MOSCA)
    assert len(done.sightings) == (mark >= 0).sum()


def two_groups(rng):
    """Return sightings of a board that cameras 1, 2 and cameras 3, 4 never see at a time."""
    rig, marks, poses = some_rig(rng), board_marks(), carried(rng, 40)
    sightings = seen(rig, marks, poses, rng)
    early = sightings.frame < 20
    return rig, marks, sightings.only(early == (sightings.camera < 2))


EXTERIOR = replace(MOSCA, exterior_only=True)


@pytest.mark.parametrize(
    ("settings", "known", "kept", "said"),
    [
        (MOSCA, None, lambda frame: frame >= 0, "cam1, cam2 and cam3, cam4 never saw"),
        (MOSCA, None, lambda frame: frame % 25 == 0, "at least 3 are wanted; hold it before the camera"),
        (EXTERIOR, None, lambda frame: frame >= 0, "needs the rig whose lenses"),
        (EXTERIOR, lambda rig: rig[:3], lambda frame: frame >= 0, "'cam4' is not in the known rig"),
        (
            EXTERIOR,
            lambda rig: [replace(c, width=800) for c in rig],
            lambda frame: frame >= 0,
            "656 x 491 px, the known rig has 800 x 491",
        ),
        (replace(EXTERIOR, reference=30), list, lambda frame: frame != 30, "frame set 30: the target"),
    ],
)
def test_errors_are_one_line_and_say_what_to_do(settings, known, kept, said):
    rig, marks, sightings = two_groups(np.random.default_rng(9))
    given = None if known is None else Rig(tuple(known(rig.cameras)))
    with pytest.raises(CalibrationError, match=said) as error:
        calibrate_rigid(sightings.only(kept(sightings.frame)), RigidTarget("board", marks), settings, known=given)
    assert "\n" not in str(error.value)


def test_a_field_seen_with_too_few_marks():
    rng = np.random.default_rng(10)
    rig, marks = some_rig(rng, n=2), field_marks(rng, 60)
    sightings = seen(rig, marks, still(2), rng)
    few = sightings.only((sightings.camera == 0) | (sightings.mark < 9) & (sightings.mark % 2 == 0))
    with pytest.raises(CalibrationError, match=r"camera 'cam2': .* marks of the target in its best view"):
        calibrate_rigid(few, RigidTarget("field", marks), MOSCA)
