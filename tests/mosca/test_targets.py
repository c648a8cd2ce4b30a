"""Targets, boards, wands and frames: positions by hand and by OpenCV, and impossible ones are refused."""

import re

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mosca.data.boards import DICTIONARIES, Board
from mosca.data.targets import (
    BallTarget,
    CodedTarget,
    PlacedTarget,
    RoundTarget,
    ScaleBar,
    TestField,
    face_axes,
    half_width_m,
)
from mosca.data.wands import LFrame, Wand, look_alike

S = np.sqrt(0.5)


@pytest.mark.parametrize(
    ("normal", "x_axis", "x", "y"),
    [
        ([0, 0, 2], None, [1, 0, 0], [0, 1, 0]),
        ([1, 0, 0], None, [0, 1, 0], [0, 0, 1]),  # seen along -x, y is to the right and z up
        ([0, 1, 0], None, [-1, 0, 0], [0, 0, 1]),
        ([0, -3, 0], None, [1, 0, 0], [0, 0, 1]),
        ([0, 0, -1], None, [1, 0, 0], [0, -1, 0]),
        ([1, 0, 0], [5, 0, 1], [0, 0, 1], [0, -1, 0]),  # made perpendicular
        ([1, 0, 1], None, [0, 1, 0], [-S, 0, S]),
    ],
)
def test_the_axes_of_a_face(normal, x_axis, x, y):
    given_x = None if x_axis is None else np.array(x_axis, float)
    axes = face_axes(np.array(normal, float), given_x)
    z = np.array(normal) / np.linalg.norm(normal)
    np.testing.assert_allclose(axes, np.stack([x, y, z], axis=1), atol=1e-15)


@given(st.lists(st.floats(-10, 10), min_size=6, max_size=6))
def test_the_axes_of_a_face_are_a_rotation(values):
    normal, x_axis = np.array(values[:3]), np.array(values[3:])
    assume(np.linalg.norm(np.cross(normal, x_axis)) > 1e-2 * np.linalg.norm(normal) * np.linalg.norm(x_axis) > 1e-4)
    axes = face_axes(normal, x_axis)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
    placed = PlacedTarget("a", RoundTarget(0.01), np.zeros(3), normal, x_axis)
    np.testing.assert_allclose(placed.rotation, axes, atol=1e-12)
    np.testing.assert_allclose(placed.normal, normal / np.linalg.norm(normal), atol=1e-12)


def test_a_coded_target_of_the_usual_proportions():
    target = CodedTarget.of_dot(17, 0.01)
    assert (target.ring_inner_m, target.ring_outer_m, target.plate_m) == pytest.approx((0.02, 0.03, 0.08))
    assert target.name == "code/017"
    assert half_width_m(target) == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: CodedTarget.of_dot(507, 0.01), "number = 507 given; coded targets have numbers 0 to 506"),
        (lambda: CodedTarget(1, 0.02, 0.02, 0.03, 0.08), "the dot must lie within the ring"),
        (lambda: CodedTarget(1, 0.01, 0.02, 0.05, 0.08), "the ring on the plate"),
        (lambda: CodedTarget(1, 0.01, 0.02, 0.03, float("nan")), "the ring on the plate"),
        (lambda: RoundTarget(0.0), "radius_m = 0 given"),
        (lambda: BallTarget(float("inf")), "diameter_m = inf given"),
        (lambda: PlacedTarget("a", RoundTarget(0.1), np.zeros(3), np.zeros(3)), "normal = "),
        (lambda: PlacedTarget("a", RoundTarget(0.1), np.zeros(3), np.ones(3), np.ones(3)), "lies along the normal"),
        (lambda: TestField(()), "one target at least"),
        (lambda: TestField((PlacedTarget("a", RoundTarget(0.1), np.zeros(3)),) * 2), "'a' stands twice"),
        (lambda: TestField((PlacedTarget("a", RoundTarget(0.1), np.zeros(3)),), -1.0), "sigma_m = -1 given"),
        (lambda: ScaleBar(1.0, 0.2, (BallTarget(0.1),) * 2), "less than a tenth of length_m"),
        (lambda: ScaleBar(0.1, 0.0, (BallTarget(0.1),) * 2), "would overlap"),
        (lambda: ScaleBar(1.0, 0.0, (CodedTarget.of_dot(3, 0.01),) * 2), "number 003 stands at both ends"),
        (lambda: Board(9, 7, 0.04, 0.04), "half a turn changes nothing"),
        (lambda: Board(2, 7, 0.04, 0.04), "at least 3 squares"),
        (lambda: Board(9, 6, 0.0, 0.04), "square_m = 0 given"),
        (lambda: Board(9, 6, 0.04, -0.04), "margin_m = -0.04 given"),
        (lambda: Board(9, 6, 0.04, 0.04, 0.03), "go together"),
        (lambda: Board(9, 6, 0.04, 0.04, 0.03, "DICT_9X9_50"), "dictionary = 'DICT_9X9_50' given; allowed: DICT_4X4"),
        (lambda: Board(9, 6, 0.04, 0.04, 0.04, "DICT_5X5_50"), "above 0 and below square_m"),
        (lambda: Board(11, 10, 0.04, 0.04, 0.03, "DICT_5X5_50"), "has 50 markers; this board takes 55"),
        (lambda: Wand((0.0,), 0.01), "two places at least"),
        (lambda: Wand((0.0, 0.5, 0.505), 0.01), "must rise by more"),
        (lambda: LFrame(("a", "b"), np.zeros((2, 3)), 0.01), "2 markers given"),
        (lambda: LFrame(("a", "b", "c"), np.eye(3)[[0, 0, 0]] * [[1], [2], [4]], 0.01), "lie in a line"),
        (lambda: LFrame(("a", "b", "c"), np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), 0.01), "'b' and 'c'"),
        (lambda: LFrame(("a", "b", "a"), np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0.0]]), 0.01), "'a' stands twice"),
    ],
)
def test_what_cannot_be_is_refused(make, said):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        make()
    assert "\n" not in str(error.value)


def test_the_corners_of_a_board_by_hand():
    board = Board(4, 3, 0.1, 0.05)
    assert board.size_m == pytest.approx((0.5, 0.4))
    wanted = [[-0.1, 0.05, 0], [0, 0.05, 0], [0.1, 0.05, 0], [-0.1, -0.05, 0], [0, -0.05, 0], [0.1, -0.05, 0]]
    np.testing.assert_allclose(board.corners(), wanted, atol=1e-15)
    assert board.white_squares() == ((1, 0), (3, 0), (0, 1), (2, 1), (1, 2), (3, 2))
    assert board.square_centre(0, 0) == pytest.approx((-0.15, 0.1))


@pytest.mark.parametrize(("columns", "rows"), [(9, 6), (5, 5), (6, 8)])
def test_a_charuco_board_is_opencvs(columns, rows):
    """OpenCV's board frame: origin in the upper left corner of the squares, y down."""
    ours = Board(columns, rows, 0.04, 0.01, 0.03, "DICT_5X5_50")
    theirs = cv2.aruco.CharucoBoard(
        (columns, rows), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    )
    corners = np.asarray(theirs.getChessboardCorners())[:, :2]
    origin = np.array([-columns, rows]) * 0.02
    np.testing.assert_allclose(ours.corners()[:, :2], origin + corners * [1, -1], atol=1e-7)
    assert list(np.asarray(theirs.getIds()).ravel()) == list(range(len(ours.white_squares())))
    middles = np.array([np.mean(points, axis=0)[:2] for points in theirs.getObjPoints()])
    mine = np.array([ours.square_centre(c, r) for c, r in ours.white_squares()])
    np.testing.assert_allclose(mine, origin + middles * [1, -1], atol=1e-7)


def test_the_dictionaries_are_opencvs():
    for name, (bits, count) in DICTIONARIES.items():
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        assert (dictionary.markerSize, len(dictionary.bytesList)) == (bits, count)


def test_a_wand():
    wand = Wand((0.1, 0.2, 0.5), 0.02)
    np.testing.assert_allclose(wand.positions(), [[-0.2, 0, 0], [-0.1, 0, 0], [0.2, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(wand.distances(), [[0, 0.1, 0.4], [0.1, 0, 0.3], [0.4, 0.3, 0]], atol=1e-15)
    assert wand.names == ("wand/1", "wand/2", "wand/3")


def test_a_frame_whose_arms_are_unlike_is_unique():
    places = np.array([[0.0, 0, 0], [0.4, 0, 0], [1, 0, 0], [0, 0.7, 0]])
    frame = LFrame(("o", "p", "q", "r"), places, 0.02)
    assert look_alike(frame.positions) is None
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert look_alike(square) is not None


def test_a_scale_bar_in_its_own_axes():
    bar = ScaleBar(1.0, 1e-5, (CodedTarget.of_dot(3, 0.01), CodedTarget.of_dot(4, 0.01)))
    assert bar.names == ("code/003", "code/004")
    one, two = bar.placed()
    np.testing.assert_allclose(two.position - one.position, [1, 0, 0])
    np.testing.assert_allclose(one.rotation, np.eye(3))
    assert ScaleBar(1.0, 0.0, (BallTarget(0.02),) * 2).names == ("bar/1", "bar/2")


def test_the_places_of_a_field():
    field = TestField(
        (
            PlacedTarget("code/001", CodedTarget.of_dot(1, 0.01), np.array([1.0, 2, 3])),
            PlacedTarget("p", RoundTarget(0.01), np.array([4.0, 5, 6]), np.array([1.0, 0, 0])),
        )
    )
    np.testing.assert_array_equal(field.positions, [[1, 2, 3], [4, 5, 6]])
    assert field.names == ("code/001", "p")
    with pytest.raises(ValueError, match="read-only"):
        field.targets[0].position[0] = 7.0
