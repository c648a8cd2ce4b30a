"""Finds a target's marks in an image: boards, coded test fields, scale bars and wands."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from mosca.calibration.targets.find_balls import read_wand
from mosca.calibration.targets.read_session import MarkReader
from mosca.coded_targets.boards import find_board, other_looks
from mosca.coded_targets.detect import find_coded, settings_of
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.found_targets import CodedDetections
from mosca.data.sightings import Part
from mosca.data.targets import BallTarget, CodedTarget, ScaleBar, TestField
from mosca.data.wands import Wand
from mosca.detection.detect import DetectionSettings, detect
from mosca.errors import InputError

LOOKED_FOR_OTHERS = 40
"""Images without the target that are searched for other numbers; this takes as long as the search itself."""
MOST_TOLD = 8
FEWEST = 6
"""Number of targets that must be read before the colour of the plates is accepted."""


def reader_of(target: CalibrationTarget, detection: DetectionSettings | None = None) -> MarkReader:
    """Return the reader that finds a target's marks in an image."""
    if isinstance(target, TestField):
        return FieldReader(target)
    if isinstance(target, Board):
        return BoardReader(target)
    if isinstance(target, Wand):
        return _WandReader(target, detection or DetectionSettings())
    if isinstance(target, ScaleBar):
        if isinstance(target.ends[0], CodedTarget):
            return FieldReader(target)
        length = (0.0, target.length_m)
        size = target.ends[0]
        width = size.diameter_m if isinstance(size, BallTarget) else 2 * size.radius_m
        return _WandReader(Wand(length, width), detection or DetectionSettings())
    raise InputError(
        "an L-frame does not calibrate cameras; give a test field, a board or a wand, and the L-frame with --axes"
    )


class FieldReader:
    """Finds the numbers of a test field or scale bar; marks are counted in the order of its targets.

    White dots on black plates, or the other way round; the first image with targets decides.
    """

    def __init__(self, target: TestField | ScaleBar) -> None:
        targets = target.targets if isinstance(target, TestField) else target.placed()
        coded = [(k, one.target) for k, one in enumerate(targets) if isinstance(one.target, CodedTarget)]
        if not coded:
            raise InputError(
                "the target has no coded targets, so that its marks cannot be told apart; give them numbers"
            )
        self.mark_of = {one.number: k for k, one in coded}
        self._settings = settings_of([one for _, one in coded])
        self._enough = min(FEWEST, len(coded))
        self._others: Counter[int] = Counter()
        self._to_look_for_others = LOOKED_FOR_OTHERS

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return the field's targets in an image (H, W)."""
        if self._settings.colour != "both":
            return self._part(find_coded(image, camera, self._settings, bit_depth))
        white, black = (
            find_coded(image, camera, replace(self._settings, colour=colour), bit_depth)
            for colour in ("white", "black")
        )
        most = max(white, black, key=len)
        if not len(most) and self._to_look_for_others:
            self._to_look_for_others -= 1
            every = replace(self._settings, numbers=None)
            self._others.update(find_coded(image, camera, every, bit_depth).number.tolist())
        if len(most) >= self._enough:
            self._settings = replace(self._settings, colour="white" if most is white else "black")
        return self._part(most)

    def seen_instead(self) -> str:
        """Return the numbers that images without the target show."""
        seen = ", ".join(str(number) for number in sorted(self._others)[:MOST_TOLD])
        more = " and more" if len(self._others) > MOST_TOLD else ""
        own = ", ".join(str(number) for number in sorted(self.mark_of)[:MOST_TOLD])
        own += " and more" if len(self.mark_of) > MOST_TOLD else ""
        return f"; its numbers are {own}; seen are {seen or 'none'}{more}"

    def advice(self) -> str:
        """Return nothing: the plates' colour is found by itself."""
        return ""

    def sees_others(self) -> bool:
        """Return whether numbers of another target were seen."""
        return bool(self._others)

    def _part(self, found: CodedDetections) -> Part:
        mark = np.array([self.mark_of[int(number)] for number in found.number], dtype=np.int64)
        return Part(0, 0, mark, found.xy_px, found.covariance_px2, 2 * found.semi_axes_px[:, 0])


class BoardReader:
    """Finds a board's inner corners; marks are counted as ``Board.corners()`` counts them."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._refusals: Counter[str] = Counter()
        """Why boards were not found, and in how many images."""
        self._without: Counter[str] = Counter()
        """Images without the board, by camera."""
        self._looks: dict[str, dict[str, None]] = {}
        """Keys with which the board is found in some of these images -> cameras, in order."""

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return the board's corners in an image (H, W)."""
        found = find_board(image, self._board, camera)
        if found.refused:
            self._refusals[found.refused] += 1
            self._without[camera] += 1
            # only sqrt(n) of n images, spread over all of them, since each takes three more searches
            if math.isqrt(self._without[camera]) ** 2 == self._without[camera]:
                keys = ", ".join(f"{key} = {value}".lower() for key, value in other_looks(image, self._board).items())
                if keys:
                    self._looks.setdefault(keys, {})[camera] = None
        return Part(0, 0, found.corner, found.xy_px, found.covariance_px2, np.full(len(found), np.nan))

    def seen_instead(self) -> str:
        """Return why the images show no board."""
        return "".join(f"; in {count} images: {why}" for why, count in self._refusals.items())

    def advice(self) -> str:
        """Return the keys of the target file with which the board would have been found."""
        return "".join(
            f"; {', '.join(cameras)} would see the board with {keys} in the target file"
            for keys, cameras in self._looks.items()
        )

    def sees_others(self) -> bool:
        """Return False: a board that is not found may be out of sight."""
        return False


class _WandReader:
    """Finds the balls of a wand; their marks are -1 where the ends cannot be distinguished."""

    def __init__(self, wand: Wand, detection: DetectionSettings) -> None:
        self._wand, self._detection = wand, detection

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return the balls in an image (H, W), none where the wand is not seen whole and alone."""
        found = read_wand(detect(image, camera, self._detection, bit_depth), self._wand, 0, 0)
        if found is not None:
            return found
        none = np.zeros(0)
        return Part(0, 0, none.astype(np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), none)

    def seen_instead(self) -> str:
        """Return nothing: balls cannot be told apart."""
        return ""

    def advice(self) -> str:
        """Return nothing: balls look alike."""
        return ""

    def sees_others(self) -> bool:
        """Return False: balls cannot be told apart."""
        return False
