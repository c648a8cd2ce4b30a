"""Printed sheets, painted from their files and read again: right numbers, right sizes, the same bytes each time."""

import re
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from mosca.coded import CodedSettings, find_coded
from mosca.data.target_codes import SECTORS, code_bits
from mosca.data.targets import CodedTarget
from mosca.errors import InputError
from mosca.formats.target_sheet import PAGES_MM, lay_out_sheets, white_runs_deg, write_target_sheets

DOT_M = 0.0035
TARGETS = [CodedTarget.of_dot(number, DOT_M) for number in (0, 17, 99, 256, 301, 402, 506)]
PER_MM = 6  # pixels
POINTS_PER_MM = 72 / 25.4
Path_ = list[tuple[str, list[float]]]


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
            curve = (
                (1 - t) ** 3 * p[0] + 3 * t * (1 - t) ** 2 * p[1] + 3 * t**2 * (1 - t) * p[2] + t**3 * p[3]
            )
            found[-1].extend(curve)
    return [np.array(part) for part in found if len(part) > 2]


def svg_paths(file: Path) -> list[tuple[float | None, Path_]]:
    """Return what is filled with which grey, in points, y down."""
    found = []
    for element in ElementTree.parse(file).iter("{http://www.w3.org/2000/svg}path"):
        style = element.get("style", "")
        if not style:  # a letter's outline
            continue
        fill = re.search(r"fill: (none|#[0-9a-f]{6})", style)
        grey = None if fill and fill[1] == "none" else int(fill[1][1:3], 16) / 255 if fill else 0.0
        commands = [
            (c, [float(v) for v in rest.split()])
            for c, rest in re.findall(r"([MLCz])([^MLCz]*)", element.get("d", ""))
        ]
        found.append((grey, commands))
    return found


def pdf_paths(file: Path) -> list[tuple[float | None, Path_]]:
    """Return the same of a PDF's page, y down."""
    height = PAGES_MM["A4"][1] * POINTS_PER_MM
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


def painted(paths: list[tuple[float | None, Path_]]) -> np.ndarray:
    """Return the sheet as an image (H, W) of PER_MM pixels a millimetre."""
    fine = 2
    width, height = (round(edge * PER_MM * fine) for edge in PAGES_MM["A4"])
    image = np.full((height, width), 255, np.uint8)
    for grey, commands in paths:
        if grey is not None:
            for points in polygons(commands):
                scaled = points / POINTS_PER_MM * PER_MM * fine
                cv2.fillPoly(image, [np.rint(scaled * 256).astype(np.int32)], 255 * grey, cv2.LINE_8, 8)
    return image.reshape(height // fine, fine, width // fine, fine).mean(axis=(1, 3)).astype(np.uint8)


@pytest.mark.parametrize("colour", ["white", "black"])
@pytest.mark.parametrize(("ending", "paths_of"), [(".svg", svg_paths), (".pdf", pdf_paths)])
def test_a_sheet_is_read_as_what_was_printed(tmp_path, ending, paths_of, colour):
    (file,) = write_target_sheets(tmp_path / f"sheet{ending}", TARGETS, colour=colour)
    found = find_coded(painted(paths_of(file)), "scan", CodedSettings(colour=colour, maximum_dot_px=60))
    assert found.number.tolist() == [target.number for target in TARGETS]
    # true size and place: PER_MM pixels a millimetre
    np.testing.assert_allclose(found.semi_axes_px, 1000 * DOT_M * PER_MM, atol=0.3)
    (places,) = lay_out_sheets(TARGETS)
    at = np.array([[place.x_mm, PAGES_MM["A4"][1] - place.y_mm] for place in places]) * PER_MM - 0.5
    np.testing.assert_allclose(found.xy_px, at, atol=0.6)
    np.testing.assert_allclose(found.roll_rad, 0.0, atol=0.02)


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
