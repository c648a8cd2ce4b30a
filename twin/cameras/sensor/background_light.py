"""Light of a pixel besides the targets: background, glass, fixed patterns of the sensor, stray light.

The mean of each pixel is rounded to the nearest of many levels (0.15 of the noise apart), and that level is the
pixel's light by definition. A pixel without a target then costs one lookup in the exact distribution of its level.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step
from twin.cameras.sensor.counter_rng import STEP, mix, normal, uniform
from twin.cameras.sensor.level_lookup import LevelBank, level_bank
from twin.cameras.sensor.sensor import Sensor

_DUST = 0xD0575607


@dataclass(frozen=True, eq=False)
class Ambient:
    """The light of every pixel besides the targets, as levels."""

    bank: LevelBank
    """The levels of the sensor."""
    mean_e: Array
    """(H, W) or (1, 1) float32: the light before rounding to levels, without extra light [electrons]."""
    index: Array
    """(H, W) uint16: index of each pixel's level in ``bank.levels_e``; (1, 1) where all pixels have one level."""
    flat: Array | None
    """(H, W) float32: factor on all light that comes through the lens (vignetting, dust, PRNU; 0: a dead pixel);
    None: 1."""
    shape: tuple[int, int] | None
    """(H, W); None: for images of any size."""

    @staticmethod
    def of(
        sensor: Sensor, mean_e: Array | float, flat: Array | None = None, *, shape: tuple[int, int] | None = None
    ) -> "Ambient":
        """Return the ambient light of mean electrons ``mean_e``, (H, W) or one number for all pixels.

        A single number gets a level of its own, so that even light is exact. ``shape`` (H, W) is needed only where
        neither ``mean_e`` nor ``flat`` has it and a coarse map will be added. Raises ValueError where sizes disagree.
        """
        given = np.asarray(mean_e, dtype=np.float32)
        given = given.reshape(1, 1) if given.ndim == 0 else np.ascontiguousarray(given)
        even = given.size == 1
        anchor = float(mean_e) if np.ndim(mean_e) == 0 else sensor.background_e
        if not even:
            shape = (given.shape[0], given.shape[1])
        if flat is not None:
            flat = np.ascontiguousarray(flat, dtype=np.float32)
            shape = (flat.shape[0], flat.shape[1]) if shape is None else shape
            if flat.shape != shape:
                raise ValueError(f"flat: shape {flat.shape} given, the light's is {shape}")
        bank = level_bank(sensor, anchor)
        index = np.full((1, 1), bank.anchor, dtype=np.uint16) if even else bank.number(given)
        bank.make(index)
        return Ambient(bank, _fixed(given), _fixed(index), None if flat is None else _fixed(flat), shape)

    def with_extra(self, extra_e: Array | float) -> "Ambient":
        """Return this light plus ``extra_e`` for one frame [electrons; through the lens, so times ``flat``].

        ``extra_e``: one number, (H, W), or a coarser map (h, w) with values at the centres of the h x w parts of the
        image, which are interpolated linearly. Deterministic, and thread-safe.
        """
        extra = np.atleast_2d(np.ascontiguousarray(extra_e, dtype=np.float32))
        shape = self.shape
        if extra.size == self.mean_e.size == 1 and self.flat is None:
            even = self.bank.number(self.mean_e + extra)
            self.bank.make(even)
            return Ambient(self.bank, self.mean_e, _fixed(even), None, shape)
        if shape is None:
            shape = (extra.shape[0], extra.shape[1])
        if extra.shape[0] > shape[0] or extra.shape[1] > shape[1]:
            raise ValueError(f"extra_e: shape {extra.shape} given, {shape} at most")
        bank = self.bank
        index = np.empty(shape, dtype=np.uint16)
        used = np.zeros(len(bank.levels_e), dtype=np.uint8)
        flat = np.ones((1, 1), dtype=np.float32) if self.flat is None else self.flat
        _onto_levels(self.mean_e, extra, flat, index, used, bank.scale)
        bank.make(np.flatnonzero(used))
        return Ambient(bank, self.mean_e, _fixed(index), self.flat, shape)

    def window(self, x: int, y: int, width: int, height: int) -> "Ambient":
        """Return the part of a windowed readout whose top-left pixel is (x, y)."""
        if self.shape is not None and (x < 0 or y < 0 or x + width > self.shape[1] or y + height > self.shape[0]):
            raise ValueError(f"window: {width} x {height} at ({x}, {y}) leaves the image {self.shape}")

        def part(values: Array) -> Array:
            if values.size == 1:
                return values
            return _fixed(np.ascontiguousarray(values[y : y + height, x : x + width]))

        flat = None if self.flat is None else part(self.flat)
        return Ambient(self.bank, part(self.mean_e), part(self.index), flat, (height, width))


@dataclass(frozen=True)
class Backdrop:
    """Unevenness of the background, and dust on the glass."""

    gradient: tuple[float, float] = (0.0, 0.0)
    """(x, y): change of the background from edge to edge, as a share of the background."""
    blob_e: float = 0.0
    """Additional electrons at the middle of a soft spot of light."""
    blob_xy: tuple[float, float] = (0.5, 0.5)
    """Its position, share of width and height."""
    blob_radius: float = 0.2
    """Its sigma, share of the width."""
    dust: int = 0
    """Number of dark spots."""
    dust_loss: float = 0.1
    """Largest share of light that a spot takes."""
    dust_radius_px: float = 6.0
    """Their mean radius."""


class AmbientMap(NamedTuple):
    """The arguments of ``Ambient.of``."""

    mean_e: Array | float
    """(H, W) or one number."""
    flat: Array | None
    """(H, W) or None."""


def ambient_map(
    sensor: Sensor,
    width: int,
    height: int,
    key: int,
    *,
    exposure_s: float = 0.0,
    vignetting: float = 0.0,
    backdrop: Backdrop | None = None,
) -> AmbientMap:
    """Return the mean light of a camera's pixels besides the targets, and the factor on light through its lens.

    ``key``: the camera's own (64 bit), the same for all its frames. Dust, DSNU, PRNU, hot and dead pixels are drawn
    from it. ``vignetting``: share of light lost at the corner, by the cos^4 law of a lens whose corner loses that
    share. Background, gradient and blob come through the lens; dark current x exposure, DSNU and hot pixels do not.
    """
    given = Backdrop() if backdrop is None else backdrop
    light: Array | float = sensor.background_e
    dark: Array | float = sensor.dark_current_e_per_s * exposure_s
    flat: Array | None = None
    x = (np.arange(width) + 0.5) / width
    y = (np.arange(height)[:, None] + 0.5) / height
    if any(given.gradient):
        light = light * (1.0 + given.gradient[0] * (x - 0.5) + given.gradient[1] * (y - 0.5))
    if given.blob_e:
        dx, dy = x - given.blob_xy[0], (y - given.blob_xy[1]) * (height / width)
        light = light + given.blob_e * np.exp(-(dx * dx + dy * dy) / (2.0 * given.blob_radius**2))
    if vignetting:
        tan2 = 1.0 / math.sqrt(1.0 - vignetting) - 1.0
        far2 = ((x - 0.5) * width) ** 2 + ((y - 0.5) * height) ** 2
        flat = 1.0 / (1.0 + tan2 * far2 * (4.0 / (width * width + height * height))) ** 2
    if given.dust:
        shade = _dust(width, height, key, given)
        flat = shade if flat is None else flat * shade
    if any((sensor.dsnu_e, sensor.prnu, sensor.hot_pixels, sensor.dead_pixels)):
        more, factor = np.empty((height, width)), np.empty((height, width))
        _fixed_pattern(
            more.ravel(), factor.ravel(), np.uint64(key), sensor.dsnu_e, sensor.prnu, sensor.hot_pixels,
            sensor.hot_e, sensor.dead_pixels,
        )  # fmt: skip
        flat = factor if flat is None else flat * factor
        mean: Array | float = np.where(factor == 0.0, 0.0, light * flat + dark + more)
    else:
        mean = (light if flat is None else light * flat) + dark
    return AmbientMap(mean, flat)


def _dust(width: int, height: int, key: int, given: Backdrop) -> Array:
    """Return the share of light (H, W) that the dust lets through: discs, darkest at their middle."""
    through, spots = np.ones((height, width)), np.empty((given.dust, 4))
    _uniforms(spots.ravel(), np.uint64(key ^ _DUST))
    for u, v, size, strength in spots:
        x, y = u * width - 0.5, v * height - 0.5
        radius, loss = given.dust_radius_px * (0.5 + size), given.dust_loss * strength
        x0, x1 = max(0, math.floor(x - radius)), min(width, math.ceil(x + radius) + 1)
        y0, y1 = max(0, math.floor(y - radius)), min(height, math.ceil(y + radius) + 1)
        far2 = ((np.arange(x0, x1) - x) ** 2 + (np.arange(y0, y1)[:, None] - y) ** 2) / radius**2
        through[y0:y1, x0:x1] *= 1.0 - loss * np.maximum(1.0 - far2, 0.0) ** 2
    return through


@kernel
def _uniforms(out: Array, key: np.uint64) -> None:
    """Fill with numbers in (0, 1)."""
    for i in range(out.size):
        out[i] = uniform(mix(key + np.uint64(i) * STEP))


@kernel
def _fixed_pattern(
    more: Array, factor: Array, key: np.uint64, dsnu: float, prnu: float, hot: float, hot_e: float, dead: float
) -> None:
    """Write each pixel's dark electrons and its factor on light; each property has its own random stream."""
    for p in range(more.size):
        state = mix(key + np.uint64(p) * STEP)
        more[p] = dsnu * normal(mix(state + STEP))
        factor[p] = max(1.0 + prnu * normal(mix(state + np.uint64(2) * STEP)), 0.0)
        if uniform(mix(state + np.uint64(3) * STEP)) < hot:
            more[p] -= hot_e * math.log(uniform(mix(state + np.uint64(4) * STEP)))
        if uniform(mix(state + np.uint64(5) * STEP)) < dead:
            more[p] = factor[p] = 0.0


@kernel
def _onto_levels(
    mean: Array, extra: Array, flat: Array, index: Array, used: Array, scale: tuple[float, float, float, float]
) -> None:
    """Fill the levels nearest to ``mean + flat * extra`` and mark which are in use; see ``LevelBank.number``."""
    height, width = index.shape
    full = extra.shape == index.shape
    columns = _columns(extra.shape[1], width)
    line = np.empty(width)
    for y in range(height):
        if full:
            for x in range(width):
                line[x] = extra[y, x]
        else:
            _stretched(extra, y, height, columns, line)
        if flat.size > 1:
            line *= flat[y]
        if mean.size > 1:
            line += mean[y]
        else:
            line += mean[0, 0]
        _row_onto_levels(line, index[y], used, scale)


@step
def _row_onto_levels(line: Array, index: Array, used: Array, scale: tuple[float, float, float, float]) -> None:
    """Fill one row's levels from its electrons (which it overwrites)."""
    floor_e, anchor, anchor_scale, step = scale
    floor2, per_step, per_floor = floor_e * floor_e, 1.0 / step, 1.0 / floor_e
    first = anchor - anchor_scale * per_step
    last = used.size - 1.0
    for x in range(line.size):
        above = line[x] if line[x] > 0.0 else 0.0
        level = first + (2.0 * math.sqrt(above + floor2) + (line[x] - above) * per_floor) * per_step + 0.5
        level = level if level > 0.0 else 0.0
        index[x] = np.uint16(np.int32(level if level < last else last))
    for x in range(line.size):
        used[index[x]] = 1


@step
def _columns(columns: int, width: int) -> Any:
    """Return, for each pixel of a row, the position (width,) in a coarse map's columns."""
    u = np.empty(width)
    for x in range(width):
        u[x] = min(max((x + 0.5) * columns / width - 0.5, 0.0), columns - 1.0)
    return u


@step
def _stretched(coarse: Array, y: int, height: int, columns: Array, line: Array) -> None:
    """Fill row ``y`` of a coarse map stretched over the image, bilinear, constant beyond the outer middles."""
    rows = coarse.shape[0]
    v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
    r = min(int(v), max(rows - 2, 0))
    down, under = v - r, coarse[min(r + 1, rows - 1)]
    blend = np.empty(coarse.shape[1] + 1)
    for c in range(coarse.shape[1]):
        blend[c] = coarse[r, c] + (under[c] - coarse[r, c]) * down
    blend[-1] = blend[-2]
    for x in range(line.size):
        c = int(columns[x])
        line[x] = blend[c] + (blend[c + 1] - blend[c]) * (columns[x] - c)


def _fixed(values: Array) -> Array:
    values.setflags(write=False)
    return values
