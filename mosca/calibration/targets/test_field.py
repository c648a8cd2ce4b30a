"""Reads the coded targets of a test field, or of a scale bar, in an image."""

from dataclasses import replace

import numpy as np

from mosca.coded_targets.detect import CodedSettings, find_coded
from mosca.data.arrays import Array
from mosca.data.found_targets import CodedDetections
from mosca.data.sightings import Part
from mosca.data.targets import CodedTarget, ScaleBar, TestField
from mosca.errors import InputError

FEWEST = 6
"""Targets that must be read before the colour of the plates is believed."""


class FieldReader:
    """Finds the numbers of a test field or scale bar; marks are counted in the order of its targets.

    White dots on black plates, or the other way round: whichever the first image with targets shows.
    """

    def __init__(self, target: TestField | ScaleBar, settings: CodedSettings | None = None) -> None:
        targets = target.targets if isinstance(target, TestField) else target.placed()
        coded = [(k, one.target) for k, one in enumerate(targets) if isinstance(one.target, CodedTarget)]
        if not coded:
            raise InputError(
                "the target has no coded targets, so that its marks cannot be told apart; give them numbers"
            )
        self.mark_of = {one.number: k for k, one in coded}
        first = coded[0][1]
        r = first.dot_radius_m
        self._settings = settings or CodedSettings(
            colour="both",
            numbers=frozenset(self.mark_of),
            ring_inner=first.ring_inner_m / r,
            ring_outer=first.ring_outer_m / r,
            plate=first.plate_m / r,
        )
        self._enough = min(FEWEST, len(coded))

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return the field's targets in an image (H, W)."""
        if self._settings.colour != "both":
            return self._part(find_coded(image, camera, self._settings, bit_depth))
        white, black = (
            find_coded(image, camera, replace(self._settings, colour=colour), bit_depth)
            for colour in ("white", "black")
        )
        most = max(white, black, key=len)
        if len(most) >= self._enough:
            self._settings = replace(self._settings, colour="white" if most is white else "black")
        return self._part(most)

    def _part(self, found: CodedDetections) -> Part:
        mark = np.array([self.mark_of[int(number)] for number in found.number], dtype=np.int64)
        return Part(0, 0, mark, found.xy_px, found.covariance_px2, 2 * found.semi_axes_px[:, 0])
