"""From frames or sightings of any target to a calibration: the production entry point."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from coded_views import View, paint
from rigid_scenes import board_marks, carried, field_marks, ray_rms_px, seen, some_rig, stood

from mosca.calibration.session import (
    EstimateSettings,
    calibrate_frames,
    calibrate_sightings,
    checked,
    held_out_lengths,
    on_axes,
    rigid_target,
)
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.calibration.targets.read_session import read_sightings
from mosca.calibration.targets.reader import reader_of
from mosca.camera.projection import project
from mosca.data.boards import Board
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Pose
from mosca.data.targets import BallTarget, CodedTarget, PlacedTarget, RoundTarget, ScaleBar
from mosca.data.targets import TestField as Field
from mosca.data.wands import LFrame, Wand
from mosca.errors import CalibrationError, InputError

WAND = Wand((0.0, 0.15, 0.5), 0.02)
BAR = ScaleBar(0.5, 1e-5, (BallTarget(0.03), BallTarget(0.03)))
FRAME = LFrame(("origin", "x", "y"), np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.35, 0]]), 0.03)
LENS = EstimateSettings(LensChoice("mosca", 0.0099))


def field_of(marks, radius=0.01, sigma_m=0.0) -> Field:
    up = np.array([0.0, 0.0, 1.0])
    return Field(
        tuple(PlacedTarget(f"code/{k:03d}", CodedTarget.of_dot(k, radius), mark, up) for k, mark in enumerate(marks)),
        sigma_m,
    )


def discs_px(sightings, rig, field: Field, factor=1.0):
    """Return the sightings with diameters that discs facing the camera have, times ``factor``."""
    wide = np.empty(len(sightings))
    for k, camera in enumerate(rig.cameras):
        mine = sightings.camera == k
        away = camera.world_from_camera.inverse().transform(field.positions[sightings.mark[mine]])[:, 2]
        f = camera.lens.c_mm / camera.lens.mx_mm_per_px
        wide[mine] = factor * f * 2 * field.targets[0].target.dot_radius_m / away
    return replace(sightings, diameter_px=wide)


@pytest.mark.parametrize("seed", range(2))
def test_shakes_of_whole_images_do_not_turn_the_cameras(seed):
    """Centres good to 0.005 px in images that shake by 0.03 px: what is taken off an image must be a shake."""
    rng = np.random.default_rng(seed)
    rig = some_rig(rng, 3, radius=2.0, height=0.6)
    field = field_of(0.5 * field_marks(rng, 60), sigma_m=1e-5)
    poses = [Pose(np.eye(3), np.zeros(3))] * 3 + stood(rng, 3, 3)
    given = seen(rig, field.positions, poses, rng, noise=0.005, shake=0.03)
    found = calibrate_sightings(given, field, LENS)
    # the true lens rotated about a camera's axes is as good as a shift of all its images; twelve shakes average out
    for one, true in zip(found.rig.cameras, rig.cameras, strict=True):
        assert ray_rms_px(one, true, 2.0) < 0.15
    taken = given.xy_px - found.sightings.xy_px
    for k in range(3):
        # a mean of 12 shakes has a standard deviation of 0.009 px
        assert np.linalg.norm(taken[given.camera == k].mean(axis=0)) < 0.05


def test_a_field_is_judged_by_the_size_of_its_dots():
    rng = np.random.default_rng(1)
    rig = some_rig(rng, 3)
    field = field_of(field_marks(rng, 80))
    given = seen(rig, field.positions, stood(rng, 1, 3, 0, 0), rng, noise=0.01)
    for factor, codes in ((1.0, set()), (0.85, {"wrong-size"}), (1000.0, {"mixed-units"})):
        sightings = discs_px(given, rig, field, factor)
        found = checked(calibrate_sightings(sightings, field, LENS), field)
        assert {one.code for one in found.refused} == codes


def test_a_board_gives_the_rig_and_needs_no_diameters():
    rng = np.random.default_rng(2)
    rig = some_rig(rng, 3)
    board = Board(9, 6, 0.12, 0.12)
    np.testing.assert_allclose(np.ptp(board.corners(), axis=0), np.ptp(board_marks(8, 5, 0.12), axis=0), atol=1e-12)
    poses = carried(rng, 30)
    given = seen(rig, board.corners(), poses, rng, noise=0.01)
    found = checked(calibrate_sightings(given, board, LENS), board)
    assert not found.refused
    assert found.scaled_by == "the board's marks"


def test_what_does_not_calibrate_cameras_is_told():
    rng = np.random.default_rng(3)
    rig = some_rig(rng, 2)
    given = seen(rig, field_marks(rng, 10), stood(rng, 1, 1), rng)
    for target in (FRAME, BAR):
        with pytest.raises(InputError, match="does not calibrate cameras; give a test field"):
            calibrate_sightings(given, target, LENS)
    with pytest.raises(InputError, match="a wand does not give exterior orientation alone"):
        calibrate_sightings(given, WAND, EstimateSettings(exterior_only=True), rig)
    with pytest.raises(InputError, match="an L-frame does not calibrate cameras"):
        reader_of(FRAME)
    with pytest.raises(InputError, match="no coded targets"):
        reader_of(Field((PlacedTarget("a", RoundTarget(0.01), np.zeros(3), np.array([0.0, 0, 1])),)))
    ball = Field((PlacedTarget("a", BallTarget(0.01), np.zeros(3), np.array([0.0, 0, 1])),))
    with pytest.raises(InputError, match="balls belong on a wand"):
        rigid_target(ball)


class Images:
    """Frames of cameras from arrays: ``images[pulse][camera]``, None where a camera delivered nothing."""

    def __init__(self, images, names=("cam1",)):
        self._images, self.closed = images, False
        height, width = next(one for row in images for one in row if one is not None).shape
        self.cameras = tuple(CameraInfo(name, width, height, 8, 10.0) for name in names)

    def __iter__(self):
        for k, row in enumerate(self._images):
            for info, image in zip(self.cameras, row, strict=True):
                if image is not None:
                    yield Frame(info.name, k, 100_000_000 * k, 1_000_000, image)

    def close(self):
        self.closed = True

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()


PLACES = {17: (60.0, 50.0), 230: (160.3, 61.7), 401: (90.8, 150.2)}


def painted(seed=0, **more):
    views = [View(number, xy, 9.0) for number, xy in PLACES.items()]
    return paint((200, 240), views, rng=np.random.default_rng(seed), **more)


def coded_field():
    up = np.array([0.0, 0.0, 1.0])
    return Field(
        tuple(
            PlacedTarget(f"code/{n:03d}", CodedTarget.of_dot(n, 0.01), np.array([k, 0.0, 0.0]), up)
            for k, n in enumerate((401, 8, 17, 230))
        )
    )


def test_marks_are_counted_as_the_field_has_them_whatever_the_colour():
    for image in (painted(), 255 - painted()):
        part = reader_of(coded_field()).read(image, "cam1", 8)
        found = dict(zip(part.mark.tolist(), part.xy_px.tolist(), strict=True))
        assert set(found) == {0, 2, 3}  # 8 is not shown
        for mark, number in ((0, 401), (2, 17), (3, 230)):
            np.testing.assert_allclose(found[mark], PLACES[number], atol=0.05)
        np.testing.assert_allclose(part.diameter_px, 9.0, rtol=0.1)


def test_every_other_set_is_looked_at_and_what_is_missing_is_left_out():
    empty = np.full((200, 240), 8, np.uint8)
    images = [[painted(k), None if k == 2 else painted(10 + k)] for k in range(5)]
    counts = []
    found = read_sightings(Images(images, ("a", "b")), reader_of(coded_field()), 2, counts.append)
    assert found.cameras == ("a", "b")
    assert counts == [1, 2, 3]
    assert sorted(zip(found.camera.tolist(), found.frame.tolist(), strict=True)) == sorted(
        3 * [(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)]
    )
    with pytest.raises(
        InputError, match="0 of 2 frame sets of cam1 show the target; its numbers are 8, 17, 230, 401; seen are none"
    ):
        read_sightings(Images([[empty], [empty]]), reader_of(coded_field()))
    with pytest.raises(InputError, match="every = 0 given"):
        read_sightings(Images([[empty]]), reader_of(coded_field()), 0)


def test_a_wrong_field_is_told_with_the_numbers_that_are_seen():
    other = Field((PlacedTarget("code/005", CodedTarget.of_dot(5, 0.01), np.zeros(3), np.array([0.0, 0.0, 1.0])),))
    with pytest.raises(
        InputError, match="0 of 2 frame sets of cam1 show the target; its numbers are 5; seen are 17, "
    ):
        read_sightings(Images([[painted()], [painted()]]), reader_of(other))


def test_one_view_of_a_few_marks_is_refused():
    images = [[painted(), painted(1)]]
    with pytest.raises(CalibrationError, match="few-views: "):
        calibrate_frames(Images(images, ("a", "b")), coded_field(), LENS)


def balls(camera, places, diameter, rng=None):
    """Return an image of bright balls (n, 3), drawn sixteen times as fine."""
    fine = 16
    image = np.zeros((camera.height * fine, camera.width * fine), np.uint8)
    f = camera.lens.c_mm / camera.lens.mx_mm_per_px
    for xy, place in zip(project(camera, places), places, strict=True):
        away = camera.world_from_camera.inverse().transform(place)[2]
        centre = np.round(((xy + 0.5) * fine - 0.5) * 16).astype(int)
        cv2.circle(image, centre.tolist(), round(0.5 * fine * f * diameter / away * 16), 200, -1, shift=4)
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def small_rig(n=3):
    return some_rig(np.random.default_rng(4), n, radius=2.0, size=(328, 246))


def test_the_l_frame_sets_the_axes():
    rng = np.random.default_rng(5)
    rig = small_rig()
    field = field_of(0.5 * field_marks(rng, 60))
    found = calibrate_sightings(seen(rig, field.positions, stood(rng, 1, 2, 0, 0), rng, noise=0.005), field, LENS)
    # the field's axes are the world's; the L-frame has another position, rotated by a right angle
    turn, place = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.1, -0.1, -0.2])
    there = FRAME.positions @ turn.T + place
    images = [[balls(camera, there, FRAME.diameter_m) for camera in rig.cameras]] * 3
    moved = on_axes(found, Images(images, rig.names), FRAME, LENS)
    for one, true in zip(moved.rig.cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(
            one.world_from_camera.translation, turn.T @ (true.world_from_camera.translation - place), atol=3e-3
        )
    black = np.zeros_like(images[0][0])
    with pytest.raises(CalibrationError, match="nothing is seen of the L-frame"):
        on_axes(found, Images([[black] * 3], rig.names), FRAME, LENS)


def test_a_bar_of_balls_tells_the_scale():
    rig = small_rig()
    rng = np.random.default_rng(6)
    images = []
    for _ in range(40):
        way, place = rng.normal(size=3), rng.uniform(-0.25, 0.25, 3)
        half = 0.5 * BAR.length_m * way / np.linalg.norm(way)
        images.append([balls(camera, place + [-half, half], 0.03) for camera in rig.cameras])
    errors = held_out_lengths(rig, Images(images, rig.names), BAR, LENS)
    assert errors.true_m == BAR.length_m
    assert len(errors.length_m) >= 10
    assert abs(errors.scale_error) < 2e-3
    long = replace(BAR, length_m=0.55)
    assert held_out_lengths(rig, Images(images, rig.names), long, LENS).scale_error == pytest.approx(
        0.5 / 0.55 - 1, abs=2e-3
    )
