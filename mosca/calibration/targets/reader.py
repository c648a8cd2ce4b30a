"""What finds a target's marks in an image, whatever the target."""

import numpy as np

from mosca.calibration.read_session import MarkReader
from mosca.calibration.targets.board import BoardReader
from mosca.calibration.targets.test_field import FieldReader
from mosca.calibration.wand.find_balls import read_wand
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.sightings import Part
from mosca.data.targets import BallTarget, CodedTarget, ScaleBar, TestField
from mosca.data.wands import Wand
from mosca.detection.detect import DetectionSettings, detect
from mosca.errors import InputError


def reader_of(target: CalibrationTarget, detection: DetectionSettings | None = None) -> MarkReader:
    """Return what finds a target's marks in an image."""
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


class _WandReader:
    """Finds the balls of a wand; their marks are -1 where the wand looks alike from both ends."""

    def __init__(self, wand: Wand, detection: DetectionSettings) -> None:
        self._wand, self._detection = wand, detection

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return the balls in an image (H, W), none where the wand is not seen whole or not alone."""
        found = read_wand(detect(image, camera, self._detection, bit_depth), self._wand, 0, 0)
        if found is not None:
            return found
        none = np.zeros(0)
        return Part(0, 0, none.astype(np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), none)
