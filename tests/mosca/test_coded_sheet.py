"""Printed sheets, painted from their files and read again: right numbers, right sizes, the same bytes each time.

Painted by two: a few lines here that fill the files' polygons, and a browser where there is one.
"""

import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mosca.coded_targets.boards import find_board
from mosca.coded_targets.detect import CodedSettings, find_coded
from mosca.data.boards import Board
from mosca.data.target_codes import SECTORS, code_bits
from mosca.data.targets import BallTarget, CodedTarget, PlacedTarget, RoundTarget, ScaleBar, TestField
from mosca.data.wands import Wand
from mosca.errors import InputError
from mosca.formats.sheets.sheet_scale import PrintedScale, as_printed, scale_of_ruler, scale_of_scan
from mosca.formats.sheets.target_sheet import (
    PAGES_MM,
    lay_out_sheets,
    ruler_mm,
    white_runs_deg,
    write_sheets,
    write_target_sheets,
)

DOT_M = 0.0035
TARGETS = [CodedTarget.of_dot(number, DOT_M) for number in (0, 17, 99, 256, 301, 402, 506)]
PER_MM = 6  # pixels
POINTS_PER_MM = 72 / 25.4
Path_ = list[tuple[str, list[float]]]
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CHARUCO = Board(6, 5, 0.03, 0.0105, 0.021, "DICT_APRILTAG_36H11")
CHECKERS = Board(7, 4, 0.025, 0.0125)


def polygons(commands: Path_) -> list[np.ndarray]:
    """Return each closed part of a path as points (n, 2): lines as they are, cubic curves in 16 steps."""
    found: list[list[np.ndarray]] = []
    for kind, numbers in commands:
        at = np.array(numbers).reshape(-1, 2)
        if kind in "Mm":
            found.append([at[0]])
        elif kind in "Ll":
            found[-1].append(at[0])
        elif kind in "Cc":
            p, t = [found[-1][-1], *at], np.linspace(0, 1, 17)[1:, None]
            curve = (1 - t) ** 3 * p[0] + 3 * t * (1 - t) ** 2 * p[1] + 3 * t**2 * (1 - t) * p[2] + t**3 * p[3]
            found[-1].extend(curve)
    return [np.array(part) for part in found if len(part) > 2]


def svg_paths(file: Path, _height_mm: float = 0.0) -> list[tuple[float | None, Path_]]:
    """Return what is filled with which grey, in points, y down."""
    found = []
    for element in ElementTree.parse(file).iter("{http://www.w3.org/2000/svg}path"):
        if element.get("clip-path") is None and "stroke: #" not in element.get("style", ""):
            continue  # the page, or a letter's outline
        style = element.get("style", "")
        fill = re.search(r"fill: (none|#[0-9a-f]{6})", style)
        grey = None if fill and fill[1] == "none" else int(fill[1][1:3], 16) / 255 if fill else 0.0
        commands = [
            (c, [float(v) for v in rest.split()])
            for c, rest in re.findall(r"([MLCz])([^MLCz]*)", element.get("d", ""))
        ]
        found.append((grey, commands))
    return found


def pdf_paths(file: Path, height_mm: float = PAGES_MM["A4"][1]) -> list[tuple[float | None, Path_]]:
    """Return the same of a PDF's page, y down."""
    height = height_mm * POINTS_PER_MM
    found: list[tuple[float | None, Path_]] = []
    for packed in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", file.read_bytes(), re.DOTALL):
        try:
            text = zlib.decompress(packed).decode("latin-1")
        except zlib.error:
            continue
        if "BT" not in text:
            continue
        grey, commands, stack, kept = 0.0, [], [], []
        for word in text.split():
            if re.fullmatch(r"[-+]?[\d.]+", word):
                stack.append(float(word))
                continue
            if word in ("m", "l", "c"):
                numbers = np.array(stack[-6 if word == "c" else -2 :]).reshape(-1, 2)
                commands.append((word, (numbers * [1, -1] + [0, height]).ravel().tolist()))
            elif word in ("rg", "g"):
                grey = stack[-1]
            elif word == "q":
                kept.append(grey)
            elif word == "Q":
                grey = kept.pop()
            elif word in ("f", "B", "b", "f*"):
                found.append((grey, commands))
            elif word == "S":
                found.append((None, commands))
            if word not in ("m", "l", "c", "h"):
                commands = [] if word in ("f", "B", "b", "f*", "S", "n") else commands
            stack = []
    return found


def painted(paths: list[tuple[float | None, Path_]], size_mm: tuple[float, float] = PAGES_MM["A4"]) -> np.ndarray:
    """Return the sheet as an image (H, W) of PER_MM pixels a millimetre."""
    fine = 2
    width, height = (round(edge * PER_MM * fine) for edge in size_mm)
    image = np.full((height, width), 255, np.uint8)
    for grey, commands in paths:
        if grey is not None:
            for points in polygons(commands):
                scaled = points / POINTS_PER_MM * PER_MM * fine
                whole = [np.rint((scaled - 0.5) * 256).astype(np.int32)]  # OpenCV's pixels lie about whole numbers
                cv2.fillPoly(image, whole, 255 * grey, cv2.LINE_8, 8)
    return image.reshape(height // fine, fine, width // fine, fine).mean(axis=(1, 3)).astype(np.uint8)


@pytest.mark.parametrize("colour", ["white", "black"])
@pytest.mark.parametrize(("ending", "paths_of"), [(".svg", svg_paths), (".pdf", pdf_paths)])
def test_a_sheet_is_read_as_what_was_printed(tmp_path, ending, paths_of, colour):
    (file,) = write_target_sheets(tmp_path / f"sheet{ending}", TARGETS, colour=colour)
    found = find_coded(painted(paths_of(file)), "scan", CodedSettings(colour=colour, maximum_dot_px=60))
    assert found.number.tolist() == [target.number for target in TARGETS]
    # true size and position: PER_MM pixels a millimetre;
    # OpenCV fills the pixels on an outline, too: half a pixel of the twice finer image
    np.testing.assert_allclose(found.semi_axes_px, 1000 * DOT_M * PER_MM + 0.25, atol=0.15)
    (places,) = lay_out_sheets(TARGETS)
    at = np.array([[place.x_mm, PAGES_MM["A4"][1] - place.y_mm] for place in places]) * PER_MM - 0.5
    np.testing.assert_allclose(found.xy_px, at, atol=0.6)
    np.testing.assert_allclose(found.roll_rad, 0.0, atol=0.02)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium to paint the sheet")
@pytest.mark.parametrize("colour", ["white", "black"])
def test_a_sheet_painted_by_a_browser_is_read(tmp_path, colour):
    """96 pixels an inch, four times as fine: a scan whose resolution is known."""
    (file,) = write_target_sheets(tmp_path / "sheet.svg", TARGETS, colour=colour)
    shot = tmp_path / "shot.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--force-device-scale-factor=4"]
    where = [f"--user-data-dir={tmp_path / 'browser'}", "--window-size=800,1130", f"--screenshot={shot}"]
    subprocess.run([str(BROWSER), *options, *where, file.as_uri()], check=True, capture_output=True, timeout=600)
    image = cv2.imread(str(shot), cv2.IMREAD_GRAYSCALE)
    found = find_coded(image, "scan", CodedSettings(colour=colour, maximum_dot_px=150))
    assert found.number.tolist() == [target.number for target in TARGETS]
    scale = scale_of_scan(found, lay_out_sheets(TARGETS)[0], dpi=4 * 96)
    assert scale.x == pytest.approx(1.0, abs=5e-4)  # a browser rounds the page to whole pixels
    assert scale.y == pytest.approx(1.0, abs=5e-4)
    assert scale.residual_mm < 0.02
    np.testing.assert_allclose(found.semi_axes_px / (4 * 96 / 25.4), 1000 * DOT_M, atol=0.05)


@pytest.mark.parametrize("board", [CHARUCO, CHECKERS], ids=["charuco", "checkerboard"])
@pytest.mark.parametrize(("ending", "paths_of"), [(".svg", svg_paths), (".pdf", pdf_paths)])
def test_a_board_is_found_where_it_was_printed(tmp_path, ending, paths_of, board):
    (file,) = write_sheets(board, tmp_path / f"board{ending}")
    height, width = PAGES_MM["A4"]  # across
    image = painted(paths_of(file, height), (width, height))
    found = find_board(image, board)
    assert found.refused == ""
    middle = np.array([width / 2, 10 + 1000 * board.size_m[1] / 2])
    true = (middle + 1000 * board.corners()[:, :2] * [1, -1]) * PER_MM - 0.5
    assert len(found) == len(true)
    np.testing.assert_allclose(found.xy_px, true[found.corner], atol=0.3)


def test_an_inverted_board_with_a_back_is_found_on_both_sheets(tmp_path):
    """The back is the front's mirror image: glued back to back at their edges, the corners coincide."""
    board = replace(CHARUCO, inverted=True, from_behind=True)
    front, back = write_sheets(board, tmp_path / "board.svg")
    assert back.name == "board-back.svg"
    seen = [painted(svg_paths(file), (297.0, 210.0)) for file in (front, back)]
    assert np.mean(seen[1] != seen[0][:, ::-1]) < 0.01  # the hairline that shows where to cut
    # a camera's images: painted edges of whole pixels stand for places half a pixel around
    seen = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in seen]
    found = [find_board(image, board) for image in seen]
    assert len(found[0]) == len(found[1]) == len(board.corners())
    np.testing.assert_allclose(found[1].xy_px, [seen[0].shape[1] - 1, 0] + found[0].xy_px * [-1, 1], atol=0.6)
    assert len(find_board(seen[0], CHARUCO)) == 0  # control: not inverted
    assert len(find_board(seen[1], replace(CHARUCO, inverted=True))) == 0  # control: from the front alone
    straight = painted(svg_paths(write_sheets(CHARUCO, tmp_path / "b.svg")[0]), (297.0, 210.0))
    straight = find_board(cv2.GaussianBlur(straight, (0, 0), 1.0), CHARUCO)
    np.testing.assert_allclose(found[0].xy_px, straight.xy_px, atol=0.02)


def test_markers_are_those_that_opencv_draws(tmp_path):
    """The same board by ``CharucoBoard.generateImage``: alike but for a pixel along the edges."""
    (file,) = write_sheets(CHARUCO, tmp_path / "board.svg")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    theirs = cv2.aruco.CharucoBoard((6, 5), 0.03, 0.021, dictionary).generateImage((6 * 180, 5 * 180))
    ours = painted(svg_paths(file), (297.0, 210.0))
    left, top = round((297 / 2 - 90) * PER_MM), round((10 + 10.5) * PER_MM)
    ours = ours[top : top + 5 * 180, left : left + 6 * 180]
    assert np.mean(np.abs(ours.astype(int) - theirs) > 128) < 0.01
    assert np.mean(np.abs(255 - ours.astype(int) - theirs) > 128) > 0.9  # control: the other way round


def test_a_large_board_has_a_sheet_of_its_own_size(tmp_path):
    board = Board(13, 8, 0.06, 0.03)
    (file,) = write_sheets(board, tmp_path / "board.svg")
    text = file.read_text()
    size = [float(re.search(rf'{key}="([\d.]+)pt"', text)[1]) / POINTS_PER_MM for key in ("width", "height")]
    np.testing.assert_allclose(size, [840 + 20, 540 + 34], atol=0.01)
    with pytest.raises(InputError, match="board of 840 x 540 mm given, too large for page 'A3'"):
        write_sheets(board, tmp_path / "board.svg", page="A3")


def test_whatever_has_plates_is_printed(tmp_path):
    places = [PlacedTarget(t.name, t, np.array([0.1 * k, 0, 0])) for k, t in enumerate(TARGETS)]
    plain = PlacedTarget("round/1", RoundTarget(0.004), np.array([9.0, 0, 0]))
    of_field = write_sheets(TestField((*places, plain)), tmp_path / "field.svg")
    of_targets = write_target_sheets(tmp_path / "targets.svg", TARGETS)
    assert of_field[0].read_bytes() == of_targets[0].read_bytes()
    bar = ScaleBar(0.5, 1e-5, (TARGETS[1], TARGETS[2]))
    (sheet,) = write_sheets(bar, tmp_path / "bar.svg")
    found = find_coded(painted(svg_paths(sheet)), "scan", CodedSettings(maximum_dot_px=60))
    assert found.number.tolist() == [17, 99]
    for target in (Wand((0.0, 0.5), 0.014, 0.0), ScaleBar(0.5, 1e-5, (BallTarget(0.01), BallTarget(0.01)))):
        with pytest.raises(InputError, match="no coded plates to print"):
            write_sheets(target, tmp_path / "wand.svg")


def test_a_printer_that_stretches_is_found_out():
    """A scan of 300 dpi of a sheet printed 2 % too small across and 1 % too large down, laid on askew by 5 deg."""
    (places,) = lay_out_sheets(TARGETS)
    angle = np.deg2rad(5)
    turn = np.array([[np.cos(angle), np.sin(angle)], [np.sin(angle), -np.cos(angle)]])  # y down
    xy = [turn @ [0.98 * place.x_mm, 1.01 * place.y_mm] * 300 / 25.4 + 900 for place in places]
    one = np.ones(len(xy))
    order = np.argsort([place.target.number for place in places])
    blank = find_coded(np.zeros((9, 9), np.uint8), "scan")
    found = type(blank)(
        "scan", np.array([places[k].target.number for k in order]), np.array(xy)[order],
        np.zeros((len(xy), 2, 2)), np.zeros((len(xy), 2)), one, one, one, np.empty(0),
    )  # fmt: skip
    scale = scale_of_scan(found, places, 300)
    assert scale == PrintedScale(pytest.approx(0.98), pytest.approx(1.01), pytest.approx(0.0, abs=1e-9))
    assert scale.mean == pytest.approx(np.sqrt(0.98 * 1.01))
    with pytest.raises(InputError, match="dpi = 600"):
        scale_of_scan(found, places, 600)
    with pytest.raises(InputError, match="0 of its 7 targets"):
        scale_of_scan(blank, places, 300)
    with pytest.raises(InputError, match="not on a line"):
        scale_of_scan(found, places[:3], 300)


def test_the_ruler_tells_the_scale():
    assert ruler_mm(PAGES_MM["A4"]) == 150.0
    assert scale_of_ruler(145.5, 150.0) == pytest.approx(0.97)
    with pytest.raises(InputError, match=r"15 mm, 150 mm is printed"):
        scale_of_ruler(15.0, 150.0)  # in cm
    printed = as_printed(TARGETS[1], 0.97)
    assert printed == CodedTarget.of_dot(17, 0.97 * DOT_M)
    board = as_printed(CHARUCO, 0.97)
    assert (board.square_m, board.marker_m) == (pytest.approx(0.0291), pytest.approx(0.02037))
    assert as_printed(CHECKERS, 0.97).marker_m is None


@pytest.mark.parametrize(("ending", "paths_of"), [(".svg", svg_paths), (".pdf", pdf_paths)])
def test_the_ruler_is_as_long_as_it_says(tmp_path, ending, paths_of):
    (file,) = write_target_sheets(tmp_path / f"sheet{ending}", TARGETS)
    lines = [
        np.array([numbers for _, numbers in commands]) / POINTS_PER_MM
        for grey, commands in paths_of(file)
        if grey is None and len(commands) == 2
    ]
    longest = max(lines, key=lambda line: np.ptp(line[:, 0]))
    assert np.ptp(longest[:, 0]) == pytest.approx(150.0, abs=0.001)
    ticks = sorted(line[0, 0] for line in lines if np.ptp(line[:, 0]) < 1e-6)
    np.testing.assert_allclose(np.diff(ticks), 10.0, atol=0.001)
    assert len(ticks) == 16
    a4 = {".svg": rb'width="595\.27\d*pt" height="841\.8', ".pdf": rb"/MediaBox \[ 0 0 595\.27\d* 841\.8"}
    assert re.search(a4[ending], file.read_bytes())


@pytest.mark.parametrize("ending", [".svg", ".pdf"])
def test_the_same_sheet_is_the_same_file(tmp_path, ending):
    one, other = (write_target_sheets(tmp_path / f"{k}{ending}", TARGETS)[0] for k in "ab")
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("number", [0, 17, 506])
def test_runs_are_the_sectors(number):
    white = np.zeros(SECTORS, bool)
    for start, end in white_runs_deg(number):
        white[np.arange(round(start / 18), round(end / 18)) % SECTORS] = True
    assert white.tolist() == list(code_bits(number))


def test_many_targets_take_many_sheets(tmp_path):
    targets = [CodedTarget.of_dot(number, 0.008) for number in range(20)]
    sheets = lay_out_sheets(targets, "A4")
    assert [len(sheet) for sheet in sheets] == [6, 6, 6, 2]
    assert [place.target.number for sheet in sheets for place in sheet] == list(range(20))
    for sheet in sheets:
        at = np.array([[place.x_mm, place.y_mm] for place in sheet])
        apart = np.abs(at[:, None] - at[None]).max(axis=2)
        assert (apart + 1e3 * np.eye(len(at))).min() >= 64 + 3
        assert (at >= 10 + 32).all()
        assert (at <= np.array(PAGES_MM["A4"]) - 10 - 32).all()
    files = write_target_sheets(tmp_path / "t.svg", targets)
    assert [file.name for file in files] == ["t.svg", "t-2.svg", "t-3.svg", "t-4.svg"]


@pytest.mark.parametrize(
    ("name", "targets", "page", "colour", "said"),
    [
        ("t.png", TARGETS, "A4", "white", "ending '.png'"),
        ("t.svg", TARGETS, "A5", "white", "page = 'A5'"),
        ("t.svg", TARGETS, "A4", "red", "colour = 'red'"),
        ("t.svg", [], "A4", "white", "no targets"),
        ("t.svg", TARGETS[:1] * 2, "A4", "white", "number 0 stands twice"),
        ("t.svg", [CodedTarget.of_dot(1, 0.03)], "A4", "white", "plate of 240 mm"),
        ("none/t.svg", TARGETS, "A4", "white", "no folder"),
    ],
)
def test_what_cannot_be_printed_is_refused(tmp_path, name, targets, page, colour, said):
    with pytest.raises(InputError, match=re.escape(said)):
        write_target_sheets(tmp_path / name, targets, page, colour)
