"""Light on each pixel: rays through OpenCV's lens and a thin lens, Mitsuba's intersections, surfaces and lamps.

A sample of pixel (i, j) has six low-discrepancy coordinates: two in the pixel, two on the lamps, two on the lens.
They are Sobol points with digital shifts, one for each pixel. The pixel is a square of even response. Distortion is
undone by Newton steps for each sample, so that the integral over each distorted pixel is exact but for noise. Thin
lens: the ray of a sample goes from its point on the lens to where the ray through the lens's centre meets the plane
of focus.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

from witness.mitsuba.scene import Array, LensCamera
from witness.mitsuba.surfaces import MARKER, load_mitsuba

SUB = 8
"""Sub-pixels along each axis of a pixel in the maps of targets."""
NEWTON_STEPS = 5
"""Newton steps of the samples' undistortion in float32; the start is off by at most some per cent."""
MOST_SAMPLES = 1 << 23
"""Most samples in one launch."""
DIMENSIONS = 6


@dataclass(frozen=True)
class PixelLight:
    """Light of n pixels: ``total`` (n) mean radiance, ``target`` (n, SUB, SUB) that from targets, ``hits``
    (n, SUB, SUB) the share of rays that met a target; sub-pixels are (row, column).
    """

    total: Array
    target: Array
    hits: Array


class Pixels:
    """Pixels to be rendered: ``camera`` (n) numbers, ``x``, ``y`` (n)."""

    def __init__(self, camera: Array, x: Array, y: Array) -> None:
        self.camera, self.x, self.y = (np.ascontiguousarray(a, dtype=np.int32) for a in (camera, x, y))

    def __len__(self) -> int:
        return len(self.x)

    def where(self, chosen: Array) -> "Pixels":
        """Return the pixels that ``chosen`` (n) marks."""
        return Pixels(self.camera[chosen], self.x[chosen], self.y[chosen])

    def part(self, first: int, last: int) -> "Pixels":
        """Return pixels ``first`` to ``last``."""
        return Pixels(self.camera[first:last], self.x[first:last], self.y[first:last])


class PixelRenderer:
    """Renders pixels of ``cameras``; ``bounces`` diffuse reflections before the lamp are followed."""

    def __init__(self, cameras: tuple[LensCamera, ...], bounces: int) -> None:
        mi = load_mitsuba()
        rows = [
            [
                *camera.focal_px,
                *camera.principal_px,
                *camera.distortion,
                camera.aperture_m / 2,
                camera.focus_m,
                *camera.position_m,
                *camera.rotation.ravel(),
            ]
            for camera in cameras
        ]
        self._row = len(rows[0])
        self._table = mi.Float(np.array(rows, dtype=np.float32).ravel())
        self._bounces = bounces
        # the first coordinates are spread best: for pixel and lamp, or for lens and pixel where edges are blurred
        self._order = (2, 3, 4, 5, 0, 1) if any(camera.aperture_m for camera in cameras) else (0, 1, 2, 3, 4, 5)

    def render(
        self, scene: Any, pixels: Pixels, samples: int, seed: int, maps: bool = True, part: tuple[int, int] = (0, 1)
    ) -> PixelLight:
        """Return the light on ``pixels`` in Mitsuba's ``scene`` by ``samples`` (a power of two) a pixel.

        ``part``: number of the part, and number of equal parts, of one series of points, which the instants of an
        exposure share.
        """
        n, step = len(pixels), max(1, MOST_SAMPLES // samples)
        total = np.zeros(n)
        bins = SUB * SUB if maps else 1
        target, hits = np.zeros((n, bins), np.float32), np.zeros((n, bins), np.float32)
        marks = _marker_table(scene)
        points = _sobol(samples, seed, *part)
        for first in range(0, n, step):
            some = pixels.part(first, min(n, first + step))
            here = slice(first, first + len(some))
            total[here], target[here], hits[here] = self._launch(scene, marks, points, some, samples, seed, maps)
        scale = bins / samples
        shape = (n, SUB, SUB) if maps else (n, 1, 1)
        return PixelLight(total / samples, (target * scale).reshape(shape), (hits * scale).reshape(shape))

    def _launch(
        self, scene: Any, marks: Any, points: Any, pixels: Pixels, samples: int, seed: int, maps: bool
    ) -> tuple[Array, Array, Array]:
        import drjit as dr
        import mitsuba as mi

        n = len(pixels)
        index = dr.arange(mi.UInt32, n * samples)
        per_pixel = dr.opaque(mi.UInt32, samples)
        which = index // per_pixel
        k = index - which * per_pixel
        camera = dr.gather(mi.UInt32, mi.UInt32(pixels.camera), which)
        px = dr.gather(mi.Int32, mi.Int32(pixels.x), which)
        py = dr.gather(mi.Int32, mi.Int32(pixels.y), which)
        shift = _hashed(mi, camera, px, py, dr.opaque(mi.UInt32, seed))
        u = [self._coordinate(points, k, shift, d) for d in self._order]
        ray = self._ray(camera, mi.Float(px) + u[0] - 0.5, mi.Float(py) + u[1] - 0.5, u[4], u[5])
        light, on_target = self._radiance(scene, marks, ray, u[2], u[3], index, seed)
        total = dr.zeros(mi.Float, n)
        dr.scatter_reduce(dr.ReduceOp.Add, total, light, which)
        bins = SUB * SUB if maps else 1
        place = which * bins
        if maps:
            place += mi.UInt32(u[1] * SUB) * SUB + mi.UInt32(u[0] * SUB)
        target, hits = dr.zeros(mi.Float, n * bins), dr.zeros(mi.Float, n * bins)
        dr.scatter_reduce(dr.ReduceOp.Add, target, light, place, on_target)
        dr.scatter_reduce(dr.ReduceOp.Add, hits, mi.Float(1), place, on_target)
        dr.eval(total, target, hits)
        return np.array(total), np.array(target).reshape(n, bins), np.array(hits).reshape(n, bins)

    def _coordinate(self, points: Any, k: Any, shift: Any, dimension: int) -> Any:
        import drjit as dr
        import mitsuba as mi

        bits = dr.gather(mi.UInt32, points, k * DIMENSIONS + dimension)
        bits = bits ^ _mix(mi, shift + mi.UInt32(0x9E3779B9 * (dimension + 1) & 0xFFFFFFFF))
        # a float32 below 1 holds 24 bits
        return mi.Float(bits >> 8) * (1.0 / (1 << 24))

    def _ray(self, camera: Any, u: Any, v: Any, lens_1: Any, lens_2: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        def value(column: int) -> Any:
            return dr.gather(mi.Float, self._table, camera * self._row + column)

        fx, fy, cx, cy, k1, k2, p1, p2, k3, radius, focus = (value(c) for c in range(11))
        centre = mi.Point3f(*(value(c) for c in range(11, 14)))
        rows = [mi.Vector3f(*(value(14 + 3 * r + c) for c in range(3))) for r in range(3)]
        wanted_x, wanted_y = (u - cx) / fx, (v - cy) / fy
        x, y = mi.Float(wanted_x), mi.Float(wanted_y)
        for _ in range(NEWTON_STEPS):
            r2 = x * x + y * y
            q = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
            off_x = x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - wanted_x
            off_y = y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - wanted_y
            a = q + x * x * slope + 2 * p1 * y + 6 * p2 * x
            b = x * y * slope + 2 * p1 * x + 2 * p2 * y
            d = q + y * y * slope + 6 * p1 * y + 2 * p2 * x
            det = a * d - b * b
            x, y = x - (d * off_x - b * off_y) / det, y - (a * off_y - b * off_x) / det
        reach, angle = radius * dr.sqrt(lens_1), lens_2 * (2 * np.pi)
        lens = mi.Vector3f(reach * dr.cos(angle), reach * dr.sin(angle), 0)
        through = mi.Vector3f(x * focus, y * focus, focus) - lens

        def to_world(vector: Any) -> Any:
            return mi.Vector3f(*(dr.dot(row, vector) for row in rows))

        return mi.Ray3f(centre + to_world(lens), dr.normalize(to_world(through)))

    def _radiance(
        self, scene: Any, marks: Any, ray: Any, lamp_1: Any, lamp_2: Any, index: Any, seed: int
    ) -> tuple[Any, Any]:
        import drjit as dr
        import mitsuba as mi

        si = scene.ray_intersect(ray)
        seen = si.is_valid()
        number = dr.select(seen, dr.reinterpret_array(mi.UInt32, si.shape), 0)
        on_target = dr.gather(mi.UInt32, marks, number) > 0
        light = _direct(scene, si, mi.Point2f(lamp_1, lamp_2), seen)
        if self._bounces:
            state = mi.PCG32(initstate=mi.UInt64(index) + dr.opaque(mi.UInt64, seed << 32))
            weight = mi.Float(1)
            for _ in range(self._bounces):
                chosen = mi.Point2f(state.next_float32(), state.next_float32())
                sample, value = si.bsdf().sample(mi.BSDFContext(), si, state.next_float32(), chosen, seen)
                weight *= dr.select(seen, value[0], 0)
                si = scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), seen)
                seen &= si.is_valid()
                lamp = mi.Point2f(state.next_float32(), state.next_float32())
                light += weight * _direct(scene, si, lamp, seen)
        return light, on_target


def _direct(scene: Any, si: Any, lamp: Any, active: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    sample, weight = scene.sample_emitter_direction(si, lamp, True, active)
    active = active & (sample.pdf > 0)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(sample.d), active)
    return dr.select(active, (value * weight)[0], 0)


def _marker_table(scene: Any) -> Any:
    """Return 1 for the registry numbers of targets' shapes."""
    import drjit as dr
    import mitsuba as mi

    numbers = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
    marked = np.array([shape.id().startswith(MARKER) for shape in scene.shapes()])
    table = np.zeros(max(4096, int(numbers.max(initial=0)) + 1), np.uint32)
    table[numbers[marked]] = 1
    return mi.UInt32(table)


def _sobol(samples: int, seed: int, part: int, parts: int) -> Any:
    import mitsuba as mi

    exponent = (samples * parts).bit_length() - 1
    if 1 << exponent != samples * parts:
        raise ValueError(f"samples = {samples} in {parts} parts: powers of two are wanted")
    points = qmc.Sobol(DIMENSIONS, scramble=True, rng=np.random.default_rng(seed)).random_base2(exponent)
    points = points[part * samples : (part + 1) * samples]
    return mi.UInt32((points * 2.0**32).astype(np.uint64).astype(np.uint32).ravel())


def _mix(mi: Any, h: Any) -> Any:
    """Return ``h`` well mixed (finalizer of MurmurHash3)."""
    h = (h ^ (h >> 16)) * mi.UInt32(0x85EBCA6B)
    h = (h ^ (h >> 13)) * mi.UInt32(0xC2B2AE35)
    return h ^ (h >> 16)


def _hashed(mi: Any, camera: Any, x: Any, y: Any, seed: Any) -> Any:
    h = _mix(mi, seed + mi.UInt32(0x27D4EB2F))
    for value in (camera, x, y):
        h = _mix(mi, h + mi.UInt32(value) * mi.UInt32(0x165667B1) + mi.UInt32(0x3C6EF372))
    return h
