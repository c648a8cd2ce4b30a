"""Centres of targets that something in front hides in part, from their images and from their points.

Detection fits a disc of any size. The visible part of a cut disc is therefore fitted by a smaller one whose centre is
off by up to its radius. Once the image is matched, its size follows from the target's size and distance, and the
whole disc's centre from the visible rim (``mosca.detection.cut_targets.disc``). Blur, size over the expected one and
misfit of whole discs are learned from each camera's whole targets.
"""

import math
from collections.abc import Mapping

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rays import Predicted, RayTable
from mosca.data.rig import Rig, focal_px
from mosca.data.tracks import Points
from mosca.detection.cut_targets.disc import AMPLITUDE, BLUR, MISFIT, RADIUS
from mosca.detection.cut_targets.expected import expected_images
from mosca.detection.cut_targets.kinds import GROWN, WHOLE, kinds_of
from mosca.detection.cut_targets.window_fits import (
    DIMMED,
    FIRST,
    LEARNED_ONE,
    LEAST_MISFIT,
    NO_FIT,
    SECOND,
    STATE,
    TWO,
    OfPoints,
    OfTracks,
    fit_windows,
)
from mosca.detection.cut_targets.windows import LEARNING, READY, Windows, windows_of

LEARNED_FROM, LEARNED_UP_TO = 20, 60
"""Numbers of a camera's whole discs: from which on its cut ones are fitted, and with which learning ends."""
LEAST_BLUR_PX = 0.4
"""Least blur of a camera whose cut discs are fitted: a pixel is small enough beside it to be part of it."""
AMPLITUDE_SIGMAS, LEAST_LOG_AMPLITUDE = 4.0, 0.3
"""A cut disc is taken where the logarithm of its amplitude is that of whole discs to within so many of their standard
deviations, or within the second number where that is more."""
COLUMNS = tuple(name for name in Detections.__dataclass_fields__ if name != "camera")
CHANGED = ("xy_px", "covariance_px2", "diameter_px", "flags", "elongation", "ellipticity")
EXPECTED_PX = 0.1
"""Least standard deviation of an expected centre: that of the errors of a track's earlier images."""
SAME_TARGET = 2.0
"""Largest distance from a point, in diameters, of a track's prediction of the same target."""
LEAST_RADIUS_SIGMA = 0.01
"""Least relative standard deviation that is assumed for a target's size."""


class _Camera:
    """Running means over a camera's whole discs."""

    def __init__(self) -> None:
        self.n, self.blur, self.log_size, self.square, self.misfit = 0, 0.75, 0.0, 0.0, LEAST_MISFIT
        self.log_amplitude, self.amplitude_square = 0.0, 0.0
        self._row: tuple[float, ...] | None = None

    def learn(self, fit: Array, expected: float) -> None:
        """Take the fit of a whole disc whose radius was ``expected`` [px]."""
        size = math.log(fit[RADIUS] / expected)
        if not (fit[MISFIT] < 0.01 and abs(size) < 0.3 and fit[AMPLITUDE] > 0.0):
            return
        self.n, self._row = self.n + 1, None
        gain = 1 / self.n
        self.blur += gain * (fit[BLUR] - self.blur)
        self.misfit += gain * (fit[MISFIT] - self.misfit)
        self.square += gain * (size * size - self.square)
        self.log_size += gain * (size - self.log_size)
        light = math.log(fit[AMPLITUDE])
        self.log_amplitude += gain * (light - self.log_amplitude)
        self.amplitude_square += gain * (light * light - self.amplitude_square)

    def row(self) -> tuple[float, ...]:
        """Return the columns that ``mosca.detection.cut_targets.windows`` names."""
        if self._row is None:
            spread = math.sqrt(max(self.amplitude_square - self.log_amplitude**2, 0.0))
            size_sigma = math.sqrt(max(self.square - self.log_size**2, 0.0))
            self._row = (
                self.n >= LEARNED_FROM and self.blur >= LEAST_BLUR_PX, self.n < LEARNED_UP_TO, self.blur,
                math.exp(self.log_size), max(size_sigma, LEAST_RADIUS_SIGMA), self.misfit, self.log_amplitude,
                max(AMPLITUDE_SIGMAS * spread, LEAST_LOG_AMPLITUDE),
            )  # fmt: skip
        return self._row


class CutTargets:
    """Fits cut discs, frame set by frame set, and learns from whole ones."""

    def __init__(self) -> None:
        self._cameras: dict[str, _Camera] = {}

    def mended(
        self,
        frame_set: FrameSet,
        detections: Mapping[str, Detections],
        rig: Rig,
        table: RayTable,
        points: Points,
        predicted: Predicted,
        typical_m: float,
    ) -> Mapping[str, Detections] | None:
        """Return the detections with the centres of cut discs; None where there is none to mend.

        ``table``: the rays that were matched to ``points``; ``predicted``: where tracks expect their targets.
        """
        if len(points) == 0 or not typical_m > 0.0:
            return None
        kinds, share, radius, distances = kinds_of(
            points.rays, points.xyz, table.rays, table.start, table.views, typical_m
        )
        cameras = [self._cameras.setdefault(name, _Camera()) for name in rig.names]
        if not (kinds > WHOLE).any() and all(camera.n >= LEARNED_UP_TO for camera in cameras):
            return None
        names, frames = rig.names, frame_set.frames
        images = [frames[name].image if name in frames and name in detections else None for name in names]
        learned = np.array([camera.row() for camera in cameras])
        learned[[image is None for image in images], READY : LEARNING + 1] = 0.0
        rays = table.rays, table.start, table.xy_px
        windows, side = windows_of(kinds, (points.rays, share, radius), rays, learned, table.cameras)
        if not len(windows.kind):
            return None
        places, errors, away = expected_images(
            predicted.xyz, predicted.covariance, table.cameras, table.views, focal_px(rig), EXPECTED_PX
        )
        expected = OfTracks(predicted.xyz, places, errors, away, SAME_TARGET * typical_m)
        matched = OfPoints(points.xyz, points.rays, distances)
        fits = fit_windows(_patches(images, windows, side), windows, learned, rays, matched, expected)
        found, state = dict(detections), fits[:, STATE]
        for r in np.flatnonzero(state == LEARNED_ONE).tolist():
            cameras[windows.camera[r]].learn(fits[r, 1:], windows.radius[r, 0])
        changed = (state != NO_FIT) & (state != LEARNED_ONE)
        for c in np.unique(windows.camera[changed]).tolist():
            these = changed & (windows.camera == c)
            rows = windows.rays[these] - table.start[c]
            found[names[c]] = _replaced(found[names[c]], rows, windows.kind[these] == GROWN, fits[these])
        return found if changed.any() else None


def _patches(images: list[Array | None], windows: Windows, side: int) -> Array:
    """Return the pixels (n, side, side) of windows, NaN where the image ends."""
    patches = np.full((len(windows.kind), side, side), np.nan)
    for k, (c, (x, y)) in enumerate(zip(windows.camera.tolist(), windows.corner.tolist(), strict=True)):
        image, left, top = images[c], max(x, 0), max(y, 0)
        assert image is not None
        part = image[top : y + side, left : x + side]
        patches[k, top - y : top - y + part.shape[0], left - x : left - x + part.shape[1]] = part
    return patches


def _replaced(seen: Detections, rows: Array, grown: Array, fits: Array) -> Detections:
    """Return a camera's detections with the fitted values.

    ``rows`` (n, 2): those of both targets. Where an image of two has ``grown`` together (n,), the second target is
    added, with all further values those of the image that it was part of. ``fits`` (n, FITTED).
    """
    columns = {name: getattr(seen, name) for name in COLUMNS}
    more = rows[grown & (fits[:, STATE] == TWO), 0]
    if len(more):
        at = np.concatenate([np.arange(len(seen)), more])
        columns = {name: column[at] for name, column in columns.items()}
    for name in CHANGED:
        columns[name] = columns[name].copy()
    second = len(seen)
    for (one, other), is_grown, fit in zip(rows.tolist(), grown.tolist(), fits.tolist(), strict=True):
        if fit[STATE] == DIMMED:
            columns["diameter_px"][one] = fit[FIRST + 5]
            continue
        _put(columns, one, fit[FIRST:SECOND])
        if fit[STATE] == TWO:
            _put(columns, second if is_grown else other, fit[SECOND:])
            second += is_grown
    for name in CHANGED:
        columns[name].setflags(write=False)
    return Detections.handed_over(seen.camera, list(columns.values()))


def _put(columns: dict[str, Array], row: int, fit: list[float]) -> None:
    """Write a whole target's image to a row."""
    x, y, xx, xy, yy, diameter = fit
    columns["xy_px"][row], columns["diameter_px"][row] = (x, y), diameter
    columns["covariance_px2"][row] = ((xx, xy), (xy, yy))
    columns["flags"][row], columns["elongation"][row], columns["ellipticity"][row] = 0, 1.0, 0.0
