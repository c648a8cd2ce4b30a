"""Figures of targets: areas in closed form, what is white where, and boards as OpenCV draws and reads them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mosca.data.boards import Board
from mosca.data.target_codes import NUMBERS, SECTORS, code_bits
from mosca.data.targets import CodedTarget
from twin.scenes.figure import ARC, LINE, Figure, circle, figure, outlines, piece_ends, polygon, ring_sector
from twin.scenes.target_boards import board_figure, marker_cells
from twin.scenes.target_plate import coded_figure, rectangle, white_runs

ARC_STEPS = 720


def light_of(shape: Figure) -> float:
    """Gain integrated over the face: Green's theorem, each piece's share of (x dy - y dx) / 2 in closed form."""
    total = 0.0
    for kind, a, b, c, d, e, gain in shape.pieces:
        if kind == LINE:
            total += gain * (a * d - c * b) / 2
        else:
            sines, cosines = np.sin(e) - np.sin(d), np.cos(e) - np.cos(d)
            total += gain * (c * c * (e - d) + c * (a * sines - b * cosines)) / 2
    return total


def gain_at(shape: Figure, points: np.ndarray) -> np.ndarray:
    """Gain (n,) at points (n, 2): crossings of a ray to the right, arcs as fine polylines."""
    gains = np.zeros(len(points))
    for kind, a, b, c, d, e, gain in shape.pieces:
        if kind == ARC:
            angle = np.linspace(d, e, ARC_STEPS)
            x, y = a + c * np.cos(angle), b + c * np.sin(angle)
        else:
            x, y = np.array([a, c]), np.array([b, d])
        px, py = points[:, :1], points[:, 1:]
        x0, y0, x1, y1 = x[:-1], y[:-1], x[1:], y[1:]
        up, down = (y0 <= py) & (py < y1), (y1 <= py) & (py < y0)
        with np.errstate(divide="ignore", invalid="ignore"):
            right = x0 + (py - y0) * (x1 - x0) / (y1 - y0) > px
        gains += gain * ((up & right).sum(axis=1) - (down & right).sum(axis=1))
    return gains


def picture(shape: Figure, width: float, height: float, pixels_per_m: float) -> np.ndarray:
    """Gain at pixel centres (H, W), the first row uppermost."""
    columns, rows = round(width * pixels_per_m), round(height * pixels_per_m)
    x = (np.arange(columns) + 0.5) / pixels_per_m - width / 2
    y = height / 2 - (np.arange(rows) + 0.5) / pixels_per_m
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return gain_at(shape, grid).reshape(rows, columns)


def test_simple_contours():
    assert light_of(figure([circle(3.0, -2.0, 0.5)])) == pytest.approx(np.pi / 4)
    assert light_of(figure([polygon(rectangle(2.0, 0.5, 7.0, 1.0), -0.5)])) == pytest.approx(-2.0)
    sector = figure([ring_sector(1.0, 2.0, 2.0, 3.0, 0.5, 1.25, 2.0)])
    assert light_of(sector) == pytest.approx(2.0 * 0.75 / 2 * (9 - 4))


@settings(deadline=None)  # the first call makes the code
@given(st.integers(0, NUMBERS - 1), st.floats(0, 0.5))
def test_the_area_of_a_coded_target(number, black):
    target = CodedTarget(number, 0.01, 0.022, 0.031, 0.08)
    shape = coded_figure(target, black)
    ring = np.pi * (0.031**2 - 0.022**2) * sum(code_bits(number)) / SECTORS
    white = np.pi * 0.01**2 + ring
    assert light_of(shape) == pytest.approx(white + black * (0.08**2 - white), rel=1e-12)
    reach = 0.031 if black == 0 else 0.04 * np.sqrt(2)
    assert shape.radius == pytest.approx(reach, rel=1e-12)


@pytest.mark.parametrize("number", [0, 17, 256, 506])
def test_the_sectors_say_the_number(number):
    shape = coded_figure(CodedTarget.of_dot(number, 1.0))
    angle = (np.arange(SECTORS)[:, None] + [0.02, 0.5, 0.98]).ravel() * 2 * np.pi / SECTORS
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for radius, wanted in ((0.98, np.ones(60)), (1.02, np.zeros(60)), (1.98, np.zeros(60)), (3.02, np.zeros(60))):
        np.testing.assert_allclose(gain_at(shape, radius * direction), wanted, atol=1e-12)
    for radius in (2.02, 2.5, 2.98):
        bits = np.repeat(code_bits(number), 3).astype(float)
        np.testing.assert_allclose(gain_at(shape, radius * direction), bits, atol=1e-12)


@given(st.lists(st.booleans(), min_size=2, max_size=30).filter(lambda bits: not all(bits)))
def test_runs_of_white_sectors_cover_the_ones(bits):
    n = len(bits)
    runs = white_runs(bits)
    covered = [k % n for a, b in runs for k in range(a, b)]
    assert sorted(covered) == [k for k in range(n) if bits[k]]
    assert all(not bits[a - 1] and not bits[b % n] for a, b in runs)  # neighbours are in one run


@given(arrays(bool, st.tuples(st.integers(1, 7), st.integers(1, 7))))
def test_outlines_enclose_the_cells(cells):
    loops = outlines(cells)
    if not cells.any():
        assert loops == []
        return
    shape = figure([polygon(loop) for loop in loops])
    assert light_of(shape) == cells.sum()
    rows, columns = cells.shape
    grid = np.stack(np.meshgrid(np.arange(columns) + 0.5, -np.arange(rows) - 0.5), axis=-1).reshape(-1, 2)
    np.testing.assert_array_equal(gain_at(shape, grid).reshape(rows, columns), cells)
    starts, ends = piece_ends(shape.pieces)
    steps = ends - starts
    assert ((steps == 0).sum(axis=1) == 1).all()  # along the axes
    edges = np.abs(np.diff(np.pad(cells, 1).astype(int), axis=0)).sum()
    edges += np.abs(np.diff(np.pad(cells, 1).astype(int), axis=1)).sum()
    assert np.abs(steps).sum() == edges  # nothing between two cells of a kind
    for loop in loops:
        sides = np.roll(loop, -1, axis=0) - loop
        assert (np.sum(sides * np.roll(sides, 1, axis=0), axis=1) == 0).all()  # every corner is one


@pytest.mark.parametrize(("columns", "rows"), [(9, 6), (4, 3)])
@pytest.mark.parametrize("black", [0.0, 0.04])
def test_the_area_of_a_checkerboard(columns, rows, black):
    board = Board(columns, rows, 0.04, 0.03)
    width, height = board.size_m
    ink = (columns * rows + 1) // 2 * 0.04**2  # the upper left square is black
    assert light_of(board_figure(board, black)) == pytest.approx(width * height - (1 - black) * ink, rel=1e-12)


def test_a_checkerboard_by_hand():
    """4 x 3 squares of 1 in a margin of 1: one sample in each cell."""
    board = Board(4, 3, 1.0, 1.0)
    wanted = 1 - np.array(
        [[0, 0, 0, 0, 0, 0], [0, 1, 0, 1, 0, 0], [0, 0, 1, 0, 1, 0], [0, 1, 0, 1, 0, 0], [0, 0, 0, 0, 0, 0]]
    )
    np.testing.assert_allclose(picture(board_figure(board), 6.0, 5.0, 1.0), wanted)


def test_the_corners_of_a_board_are_where_its_edges_meet():
    board = Board(5, 4, 0.04, 0.03)
    pieces = board_figure(board).pieces[4:]  # after the white sheet
    ends = np.round(piece_ends(pieces)[0], 9)
    for corner in board.corners()[:, :2]:
        assert (np.abs(ends - corner).max(axis=1) < 1e-9).sum() == 2  # two black squares touch there


@pytest.mark.parametrize("name", ["DICT_4X4_50", "DICT_6X6_250", "DICT_APRILTAG_36H11"])
def test_a_charuco_board_is_the_one_that_opencv_draws(name):
    board = Board(5, 4, 0.8, 0.4, 0.4, name)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    cells = len(marker_cells(name, 0))
    pixels = 4 * cells  # a square; half of it is the marker: two pixels a cell
    theirs = cv2.aruco.CharucoBoard((5, 4), 0.8, 0.4, dictionary).generateImage(
        (5 * pixels, 4 * pixels), marginSize=0
    )
    ours = picture(board_figure(board), *board.size_m, pixels / 0.8)
    margin = pixels // 2
    assert (ours[:margin] == 1).all()
    np.testing.assert_allclose(255 * ours[margin:-margin, margin:-margin], theirs, atol=1e-9)


@pytest.mark.parametrize("black", [0.0, 0.04])
def test_an_inverted_board_is_the_other_one_s_complement(black):
    board = Board(5, 4, 0.8, 0.4, 0.4, "DICT_4X4_50")
    plain, inverted = (
        picture(board_figure(one, black), *board.size_m, 24 / 0.8) for one in (board, replace(board, inverted=True))
    )
    np.testing.assert_allclose(plain + inverted, 1 + black, atol=1e-9)
    assert 0.3 < inverted.mean() < 0.7


def test_opencv_reads_a_charuco_board_that_leans():
    board = Board(7, 5, 0.04, 0.03, 0.03, "DICT_5X5_50")
    # all edges lie between pixels of 1 / 1400 m, so that larger pixels stay exact
    small = 200 * picture(board_figure(board, 0.04), *board.size_m, 1400.0)
    drawn = np.kron(np.clip(small, 0, 255).astype(np.uint8), np.ones((4, 4), np.uint8))
    scale = 5600.0
    h, w = drawn.shape
    view = cv2.getPerspectiveTransform(
        np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32),
        np.array([[60, 80], [980, 30], [930, 760], [110, 690]], np.float32),
    )
    image = cv2.GaussianBlur(cv2.warpPerspective(drawn, view, (1040, 820), flags=cv2.INTER_AREA), (5, 5), 1.0)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, dictionary))
    corners, ids, _, marker_ids = detector.detectBoard(image)
    assert sorted(np.ravel(marker_ids)) == list(range(len(board.white_squares())))
    assert sorted(np.ravel(ids)) == list(range(len(board.corners())))
    true = board.corners()[np.ravel(ids), :2]
    pixel = np.column_stack([(true[:, 0] + w / scale / 2) * scale, (h / scale / 2 - true[:, 1]) * scale]) - 0.5
    expected = cv2.perspectiveTransform(pixel[None], view)[0]
    assert np.abs(np.asarray(corners).reshape(-1, 2) - expected).max() < 0.5


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: figure([polygon(rectangle(1, 1))[:3]]), "apart where they should join"),
        (lambda: figure([circle(0, 0, 1.0)[:, [0, 1, 2, 3, 4, 4, 6]] + [0, 0, 0, 0, 0, 1, 0]]), "should join"),
        (lambda: Figure(np.full((1, 7), np.nan), 1.0), "finite numbers are wanted"),
        (lambda: Figure(np.full((1, 7), 2.0), 1.0), "is LINE or ARC"),
        (lambda: Figure(circle(0, 0, 1.0), 0.0), "radius = 0 given"),
    ],
)
def test_what_is_no_figure_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, NUMBERS - 1), st.floats(1e-4, 10.0))
def test_figures_of_any_size_are_closed(number, dot):
    shape = coded_figure(CodedTarget.of_dot(number, dot), 0.04)
    assert shape.radius == pytest.approx(4 * np.sqrt(2) * dot)
