"""How one image shows a flat board: a homography, and two radial terms where the lens bends straight lines.

A point x of the image, from its middle in half diagonals, r = |x|, is seen along (x, 1 + l1 r^2 + l2 r^4): the
division model (Fitzgibbon, CVPR 2001), which needs no principal distance. The terms belong to this image alone and
serve to find wrong corners; the lens is calibrated later, from all images.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from mosca.data.arrays import Array

NO_BEND = (0.0, 0.0)
"""Radial terms of a lens without distortion."""
FEWEST_BENT = 10
"""Least number of corners for radial terms: their coordinates are twice as many as the ten parameters. With fewer, a
wrong corner is taken for bend."""
BEYOND, STEPS = 2.0, 512
"""The radial terms are inverted by a table of so many radii, up to twice the largest one fitted: interpolation of a
smooth curve leaves 1e-6 of it."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Maps points of a board's plane [m] into an image of ``size`` (width, height) [px].

    ``homography`` (3, 3): from the plane to (x / d, y / d), x and y in half diagonals from the middle and
    ``d = 1 + l1 r^2 + l2 r^4`` with ``bend`` (l1, l2); ``reach``: largest r of the points that it was fitted to.
    """

    size: tuple[int, int]
    homography: Array
    bend: tuple[float, float]
    reach: float

    def image(self, plane: Array) -> Array:
        """Return where points (n, 2) [m] of the plane are imaged (n, 2) [px]; NaN where the terms map nothing."""
        straight = cv2.perspectiveTransform(plane[None].astype(np.float64), self.homography)[0]
        if self.bend != NO_BEND:
            table = np.linspace(0.0, BEYOND * self.reach, STEPS)
            table = table[np.logical_and.accumulate(_is_rising(table, self.bend))]
            wanted = np.linalg.norm(straight, axis=1)
            radius = np.interp(wanted, table / _divisor(table, self.bend), table, right=np.nan)
            straight = straight * np.divide(radius, wanted, out=np.ones_like(wanted), where=wanted > 0)[:, None]
        return np.asarray(straight * (np.hypot(*self.size) / 2) + (np.array(self.size) - 1) / 2)

    def narrowest(self, points: Array) -> float:
        """Return the magnification of the board's squares across, where they are narrowest [px/m].

        It is the least distance of opposite sides at any of ``points`` (n, 2): a leaning square is a rhombus,
        narrower than its sides are long.
        """
        step = 1e-3 * np.ptp(points, axis=0).max()
        here = self.image(points)
        along, down = (self.image(points + by) - here for by in ([step, 0.0], [0.0, step]))
        area = np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])
        longer = np.maximum(np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1))
        return float((area / longer).min() / step)


def fitted_view(plane: Array, xy_px: Array, size: tuple[int, int], bent: bool) -> BoardView | None:
    """Return the view that maps points ``plane`` (n, 2) [m] best to ``xy_px`` (n, 2); None where none can.

    ``bent``: with radial terms; None too where these fold the image within the points.
    """
    seen = (xy_px - (np.array(size) - 1) / 2) / (np.hypot(*size) / 2)
    radius = np.linalg.norm(seen, axis=1)
    first, _ = cv2.findHomography(plane, seen)
    if first is None or (bent and len(seen) < FEWEST_BENT):
        return None
    homography, bend = np.asarray(first), NO_BEND
    if bent:
        # the board's middle is seen, so its divisor is not 0
        found = least_squares(_misfit, np.append(homography.ravel()[:8], NO_BEND), args=(plane, seen), method="lm")
        homography = np.append(found.x[:8], 1.0).reshape(3, 3)
        bend = (float(found.x[8]), float(found.x[9]))
    if not _is_rising(radius, bend).all():
        return None
    return BoardView(size, homography, bend, float(radius.max()))


def _misfit(parameters: Array, plane: Array, seen: Array) -> Array:
    """Return the residuals (2 n,) of the points under the parameters, in half diagonals of the image."""
    homography = np.append(parameters[:8], 1.0).reshape(3, 3)
    projected = plane @ homography[:, :2].T + homography[:, 2]
    straight = projected[:, :2] / projected[:, 2:]
    d = _divisor(np.linalg.norm(seen, axis=1), parameters[8:])
    return np.asarray((straight * d[:, None] - seen).ravel())


def _divisor(radius: Array, bend: tuple[float, float] | Array) -> Array:
    return np.asarray(1 + bend[0] * radius**2 + bend[1] * radius**4)


def _is_rising(radius: Array, bend: tuple[float, float]) -> Array:
    """Return whether the angle from the axis rises with the radius, up to 90 deg: d and d - r dd/dr are positive."""
    rising = (1 - bend[0] * radius**2 - 3 * bend[1] * radius**4 > 0) & (_divisor(radius, bend) > 0)
    return np.asarray(rising)
