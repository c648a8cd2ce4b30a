"""Background and dark noise of an image, measured from the image itself in cells larger than targets.

The level of a cell is the median of its samples, then the mean of those within ``CLIP_SIGMAS`` of it. Targets cover
less than half of a cell, so they do not count. The noise is half the mean square of the differences of neighbouring
pixels (von Neumann 1941), within the same limits; a smooth slope of the background does not enter it. The neighbours
of a cell correct it where a target covers it. Levels are then measured again in cells of half the side, from the
pixels near a smooth surface through the first levels.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mosca.data.arrays import Array
from mosca.detection.static_background import MOST_VOTES, StaticBackground
from mosca.numba_support.decorators import bare_step, kernel
from mosca.numba_support.order import median_in_place

CELL_SIDE, CELL_PX, LARGEST_CELL_PX, STRIDE_PX = 1.6, 64, 256, 5
"""Side of a cell over that of the largest target, so that targets side by side cover less than half of a cell. The
side is at most the second number [px], or the largest target's side where that is more; never more than the third,
since larger cells do not follow an uneven background. The last is the distance of its samples [px]: with 150 of them,
in 64 px, a cell's standard deviation is right to 10 %, after the median over its neighbours to 5 %."""
FINE_STRIDE_PX = 4
"""Distance of the samples of a cell of half the side: its level is right to 0.13 of a pixel's noise."""
CLIP_SIGMAS = 4.0
"""Samples farther from a cell's median count as those of targets; of the background 6 in 100,000 do."""
BEND = 4.0
"""How far the background may lie off a smooth surface through cells, in units of that surface's own curvature."""
ROUNDING_DN2 = 1 / 12
"""Variance of rounding to whole grey values, the least that an image can have [DN^2]."""
PLAIN = 2.0
"""A spread of up to the square root of this times the noise is no texture: targets may cover a third of a cell."""
FINENESS = 256
"""Steps per grey value in which planes are computed."""
MEMORY = 4
"""Measurements over which level and noise are averaged."""


@dataclass(frozen=True, eq=False)
class LocalBackground:
    """Background of one camera's images."""

    level: Array
    """(rows, columns) mean grey value of each cell [DN]."""
    variance: Array
    """(rows, columns) variance of a pixel without a target [DN^2]."""
    texture: Array
    """(rows, columns) variance of the background's texture about a smooth background [DN^2]."""
    count: int
    """Number of images that it was measured in, up to ``MEMORY``."""
    pixels: StaticBackground | None = None
    """Background of each pixel, where it is textured."""
    rough: Array | None = None
    """(rows, columns) sum of variance and texture, for pixels whose own background is not known [DN^2]."""
    _limits: dict[tuple[float, tuple[int, int], Any, bool], Array] = field(default_factory=dict, repr=False)
    _behind: dict[tuple[int, int], Array] = field(default_factory=dict, repr=False)

    def plus(self, other: "LocalBackground | None") -> "LocalBackground":
        """Return the running mean of both, ``other`` being the later one."""
        if other is None or other.level.shape != self.level.shape:
            return self if other is None else other
        pixels = other.pixels if self.pixels is None else self.pixels.plus(other.pixels)
        if other.rough is not None and self.rough is None:
            # ``other`` is the first one measured without the texture
            return replace(other, pixels=pixels, _limits={}, _behind={})
        count = min(self.count + other.count, MEMORY)
        share = other.count / count
        level, variance, texture = (
            (1 - share) * getattr(self, name) + share * getattr(other, name)
            for name in ("level", "variance", "texture")
        )
        return LocalBackground(level, variance, texture, count, pixels, other.rough)

    @cached_property
    def usual_variance(self) -> float:
        """Variance of a pixel in most of the image [DN^2]."""
        return float(np.median(self.variance))

    @property
    def textured(self) -> bool:
        """Whether the background of each pixel is to be learned."""
        return self.pixels is not None or bool(self.texture.any())

    @property
    def wants_images(self) -> bool:
        """Whether each next image is to be measured, since the background of each pixel is not known yet."""
        return self.textured and (self.pixels is None or self.pixels.images < MOST_VOTES)

    @property
    def usable(self) -> StaticBackground | None:
        """The background of each pixel, if it is known."""
        return self.pixels if self.pixels is not None and self.pixels.usable else None

    def planes(self, shape: tuple[int, int]) -> Array:
        """Return the planes between levels (H, W) float32 [DN]."""
        out = np.empty(shape, np.int32)
        interpolate_cells(FINENESS * self.level, float(np.iinfo(np.int32).max), out)
        return np.asarray(out / np.float32(FINENESS), np.float32)

    def behind(self, shape: tuple[int, int]) -> Array:
        """Return the texture of each pixel, and the standard deviation of its error (2, H, W) float32 [DN].

        At a known pixel the error is that of the mean of the images that voted, at an unknown one what filling
        leaves.
        """
        if self.pixels is None:
            return np.zeros((2, *shape), np.float32)
        rough = self.variance + self.texture if self.rough is None else self.rough
        if shape not in self._behind:
            variance = np.empty(shape, np.int32)
            interpolate_cells(FINENESS * self.pixels.fill_share * rough, float(np.iinfo(np.int32).max), variance)
            own = np.empty(shape, np.int32)
            interpolate_cells(FINENESS * self.variance, float(np.iinfo(np.int32).max), own)
            variance = np.where(self.pixels.known, own / np.maximum(self.pixels.votes, 1), variance)
            error = np.sqrt(variance / FINENESS).astype(np.float32)
            self._behind[shape] = np.stack([self.pixels.behind, error])
        return self._behind[shape]

    def shown_behind(self, image: Array) -> Array:
        """Return the texture that an image (H, W) shows, and the standard deviation of its error, as ``behind``.

        Where the image shows part of the texture, as at the edge of a body, the error is as large as the texture.
        """
        behind = self.behind(image.shape)
        if self.pixels is None:
            return behind
        cells = self.pixels.seen_in(image, self.variance)
        if cells.min() == 1.0:
            return behind
        share = cv2.resize(cells, image.shape[::-1])
        texture, error = behind
        return np.stack([share * texture, np.sqrt((share * error) ** 2 + 4.0 * share * (1.0 - share) * texture**2)])

    def limits(self, sigmas: float, shape: tuple[int, int], dtype: Any, as_if_known: bool = False) -> Array:
        """Return for each pixel (H, W) the largest grey value within ``sigmas`` above the background.

        ``as_if_known``: return the limits of the noise alone, as if no pixel's background had been filled.
        """
        key = (sigmas, shape, dtype, as_if_known)
        if key not in self._limits:
            limits, most = np.empty(shape, dtype), float(np.iinfo(dtype).max - 1)
            interpolate_cells(self.level + sigmas * np.sqrt(self.variance + self.texture), most, limits)
            if self.rough is not None and self.pixels is not None and not as_if_known:
                unknown = np.empty(shape, dtype)
                variance = self.variance + self.pixels.fill_share * self.rough
                interpolate_cells(self.level + sigmas * np.sqrt(variance), most, unknown)
                limits = np.where(self.pixels.known, limits, unknown)
            self._limits[key] = limits
        return self._limits[key]


@bare_step
def cell_position(at: float, pixels: int, cells: int) -> tuple[Any, Any, Any]:
    """Return the cells before and after a pixel coordinate and the share of the second; at the rim outside 0 to 1."""
    if cells == 1:
        return np.int64(0), np.int64(0), 0.0
    u = (at + 0.5) * cells / pixels - 0.5
    first = np.int64(min(max(math.floor(u), 0), cells - 2))
    return first, first + 1, u - first


@bare_step
def plane_at(cells: Array, x: float, y: float, shape: tuple[int, int]) -> tuple[float, float, float]:
    """Return the value of cells (rows, columns) at a pixel of an image (H, W), and its slopes by x and y."""
    i0, i1, v = cell_position(y, shape[0], cells.shape[0])
    j0, j1, u = cell_position(x, shape[1], cells.shape[1])
    top, bottom = (
        cells[i0, j0] + u * (cells[i0, j1] - cells[i0, j0]),
        cells[i1, j0] + u * (cells[i1, j1] - cells[i1, j0]),
    )
    across = (1.0 - v) * (cells[i0, j1] - cells[i0, j0]) + v * (cells[i1, j1] - cells[i1, j0])
    value = top + v * (bottom - top)
    return value, across * cells.shape[1] / shape[1], (bottom - top) * cells.shape[0] / shape[0]


@kernel
def interpolate_cells(cells: Array, most: float, out: Array) -> None:
    """Write the values of cells (rows, columns) at all pixels of ``out`` (H, W), whole numbers from 0 to ``most``."""
    height, width = out.shape
    before, share = np.empty(width, np.int64), np.empty(width)
    for x in range(width):
        before[x], _, share[x] = cell_position(float(x), width, cells.shape[1])
    row, step = np.empty(cells.shape[1]), np.zeros(cells.shape[1])
    for y in range(height):
        i0, i1, v = cell_position(float(y), height, cells.shape[0])
        for j in range(cells.shape[1]):
            row[j] = cells[i0, j] + v * (cells[i1, j] - cells[i0, j])
        for j in range(cells.shape[1] - 1):
            step[j] = row[j + 1] - row[j]
        for x in range(width):
            at = np.uint64(before[x])
            out[y, x] = np.int64(min(max(row[at] + share[x] * step[at], 0.0), most))


@bare_step
def nearest_cell(x: float, y: float, shape: tuple[int, int], cells: tuple[int, int, int]) -> tuple[Any, Any]:
    """Return row and column of the cell that a pixel of an image (H, W) lies in; ``cells``: images, rows, columns."""
    i = np.uint64(y * (cells[1] / shape[0]))
    j = np.uint64(x * (cells[2] / shape[1]))
    return min(i, np.uint64(cells[1] - 1)), min(j, np.uint64(cells[2] - 1))


@bare_step
def cell_samples(image: Array, box: tuple[int, int, int, int], samples: Array) -> int:
    """Copy pairs of neighbouring pixels of ``box`` (x0, y0, x1, y1, ends excluded) to (n, 2); return how many."""
    x0, y0, x1, y1 = box
    last = image.shape[1] - 1
    n = 0
    for y in range(y0, y1, STRIDE_PX):
        for x in range(x0 + (y - y0) % 2, min(x1, max(last, x0 + 1)), STRIDE_PX):
            samples[n, 0], samples[n, 1] = image[y, x], image[y, min(x + 1, last)]
            n += 1
    return n


@kernel
def measure_cells(image: Array, rows: int, columns: int) -> tuple[Array, Array]:
    """Return level [DN] and variance [DN^2] (rows, columns) of an image's cells."""
    height, width = image.shape
    level, variance = np.empty((rows, columns)), np.empty((rows, columns))
    room = (height // rows // STRIDE_PX + 2) * (width // columns // STRIDE_PX + 2)
    samples, first, differences = np.empty((room, 2)), np.empty(room), np.empty(room)
    for i in range(rows):
        for j in range(columns):
            box = (width * j // columns, height * i // rows, width * (j + 1) // columns, height * (i + 1) // rows)
            n = cell_samples(image, box, samples)
            for k in range(n):
                first[k], differences[k] = samples[k, 0], abs(samples[k, 0] - samples[k, 1])
            middle, apart = median_in_place(first[:n]), median_in_place(differences[:n])
            # the median of |a - b| is 0.954 standard deviations; 1 DN more, since grey values are whole
            reach = CLIP_SIGMAS * apart / 0.954 + 1.0
            total = squares = count = 0.0
            for k in range(n):
                a, b = samples[k, 0], samples[k, 1]
                if abs(a - middle) <= reach and abs(b - middle) <= reach:
                    total += a
                    squares += (a - b) ** 2
                    count += 1.0
            level[i, j] = total / count if count > 0.0 else middle
            variance[i, j] = 0.5 * squares / count if count > 0.0 else 0.0
    return level, variance


@kernel
def measure_levels(image: Array, smooth: Array, reach: Array) -> Array:
    """Return the levels [DN] of cells of half the side: the means of pixels within ``reach`` of a smooth background.

    ``smooth``, ``reach``: (rows, columns) of whole cells [DN].
    """
    height, width = image.shape
    rows, columns = 2 * smooth.shape[0], 2 * smooth.shape[1]
    level = np.empty((rows, columns))
    kept = np.empty((height // rows // FINE_STRIDE_PX + 2) * (width // columns // FINE_STRIDE_PX + 2))
    for i in range(rows):
        for j in range(columns):
            n = looked_at = 0
            for y in range(height * i // rows, height * (i + 1) // rows, FINE_STRIDE_PX):
                for x in range(width * j // columns, width * (j + 1) // columns, FINE_STRIDE_PX):
                    looked_at += 1
                    kept[n] = image[y, x]
                    expected = plane_at(smooth, float(x), float(y), (height, width))[0]
                    n += abs(kept[n] - expected) <= reach[i // 2, j // 2]
            if n == 0 or 4 * n < looked_at:
                x, y = (
                    0.5 * (width * j // columns + width * (j + 1) // columns - 1),
                    0.5 * (height * i // rows + height * (i + 1) // rows - 1),
                )
                level[i, j] = plane_at(smooth, x, y, (height, width))[0]
                continue
            level[i, j] = kept[:n].mean()
    return level


@kernel
def measure_spread(image: Array, level: Array, rows: int, columns: int) -> Array:
    """Return the robust standard deviation [DN] (rows, columns) of an image about the planes between its levels."""
    height, width = image.shape
    spread = np.empty((rows, columns))
    room = (height // rows // STRIDE_PX + 2) * (width // columns // STRIDE_PX + 2)
    off = np.empty(room)
    for i in range(rows):
        for j in range(columns):
            n = 0
            for y in range(height * i // rows, height * (i + 1) // rows, STRIDE_PX):
                for x in range(width * j // columns, width * (j + 1) // columns, STRIDE_PX):
                    off[n] = abs(image[y, x] - plane_at(level, float(x), float(y), (height, width))[0])
                    n += 1
            spread[i, j] = median_in_place(off[:n]) / 0.6745
    return spread


def measure_background(image: Array, largest_px: float, known: LocalBackground | None = None) -> LocalBackground:
    """Return the background of one image (H, W) of whole numbers with targets of up to ``largest_px``.

    ``known``: background of earlier images; if it has one of each pixel, that is subtracted first.
    """
    rough = None
    if known is not None and known.usable is not None:
        rough = known.variance + known.texture if known.rough is None else known.rough
        image = image.astype(np.int32) - np.rint(known.shown_behind(image)[0]).astype(np.int32)
    rows, columns = (n // 2 for n in cell_grid(image.shape, largest_px))
    level, variance = measure_cells(image, rows, columns)
    variance = np.maximum(_filtered(variance, 3, _median), ROUNDING_DN2)
    # a surface through medians follows the background even where targets cover cells; at the summit of a paraboloid
    # that falls by 1 to the next cells, the median over 3 x 3 is too low by 1
    smooth = _filtered(_filtered(level, 3, _median), 5, _quadratic)
    reach = CLIP_SIGMAS * np.sqrt(variance) + 1.0 + BEND * np.abs(_filtered(smooth, 3, _bend))
    level = measure_levels(image, smooth, reach)
    spread = _filtered(measure_spread(image, level, rows, columns), 3, _median)
    # what exceeds noise, rounding of the level and a few targets in a cell
    texture = np.maximum(spread**2 - PLAIN * (variance + 0.25), 0.0)
    halves = np.ones((2, 2))
    return LocalBackground(level, np.kron(variance, halves), np.kron(texture, halves), 1, rough=rough)


def _filtered(cells: Array, side: int, of_windows: Callable[[Array], Array]) -> Array:
    """Return a function of the ``side`` x ``side`` cells around each. Cells are extrapolated beyond the rim."""
    reach = side // 2
    before, after = (_extrapolation(n, reach, min(cells.shape) > reach) for n in cells.shape)
    around = before @ cells @ after.T
    windows = sliding_window_view(around, (side, side))
    return of_windows(windows.reshape(*cells.shape, side * side))


@lru_cache(maxsize=64)
def _extrapolation(n: int, reach: int, mirrored: bool) -> Array:
    """Return the matrix (n + 2 reach, n) that continues n values at both ends.

    The last value is repeated or, if ``mirrored``, the values before it are reflected at its point.
    """
    rows, at = np.arange(n + 2 * reach), np.arange(-reach, n + reach)
    out, end, beyond = np.zeros((len(rows), n)), np.clip(at, 0, n - 1), mirrored & ((at < 0) | (at >= n))
    out[rows, end] = np.where(beyond, 2.0, 1.0)
    out[rows[beyond], (2 * end - at)[beyond]] = -1.0
    return out


def _median(windows: Array) -> Array:
    middle = windows.shape[-1] // 2
    return np.asarray(np.partition(windows, middle)[..., middle])


def _quadratic(windows: Array) -> Array:
    """Return the middle values of quadratic surfaces through 5 x 5 values each (Savitzky and Golay 1964)."""
    y, x = np.mgrid[-2:3, -2:3].reshape(2, -1)
    surface = np.stack([np.ones(25), x, y, x * x, x * y, y * y], axis=1)
    return np.asarray((windows * np.linalg.pinv(surface)[0]).sum(axis=-1))


def _bend(windows: Array) -> Array:
    """Return how much the middle of 3 x 3 values lies below the mean of its four nearest ones."""
    return np.asarray(windows[..., 1::2].mean(axis=-1) - windows[..., 4])


def cell_grid(shape: tuple[int, ...], largest_px: float) -> tuple[int, int]:
    """Return rows and columns of levels of an image (H, W): two levels in each direction for a cell."""
    side = min(max(min(CELL_SIDE * largest_px, CELL_PX), largest_px), LARGEST_CELL_PX)
    return 2 * max(1, round(shape[0] / side)), 2 * max(1, round(shape[1] / side))
