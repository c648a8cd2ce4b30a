"""Compiled search for the dots of coded targets, and the light of the rings about them.

Called by ``mosca.coded_targets.detect``, which describes the method. Free of the GIL, one thread. A *frame* is a row
(x, y, axx, axy, ayy, gx, gy) that maps the plate into the image: ``(x, y) + A u / (1 + g . u)``, with u in radii of
the dot, A symmetric, so that |u| = 1 is the dot's ellipse, and g the perspective that remains. Angles on the
plate run counter-clockwise seen from the front: u = r (cos t, -sin t), since y points down in the image.
"""

import math
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import kernel, step

X, Y, AXX, AXY, AYY, GX, GY = range(7)
FRAME = 7
PLATE_DN, CONTRAST_DN = range(2)
LEVELS = 2

SECTORS, PER_SECTOR, BANDS, RAYS = 20, 6, 3, 24
STEPS = SECTORS * PER_SECTOR
# Directions of the samples along a ring.
COS = np.cos(2.0 * np.pi * np.arange(STEPS) / STEPS)
SIN = np.sin(2.0 * np.pi * np.arange(STEPS) / STEPS)
# the contour's polygon has a slightly smaller second moment than its ellipse: (2 + cos(2 pi / n)) / 3
POLYGON = math.sqrt(3.0 / (2.0 + math.cos(2.0 * math.pi / RAYS)))
LEAST_SOLID, MOST_SOLID = 0.8, 1.15  # a patch's area over that of the ellipse of its second moments
LEAST_AREA_PX, LARGEST_BOX_PX = 5, 56
HALF_PX = 0.5  # no dot is thinner than a pixel
SHORTEST_SECTOR_PX = 1.0  # on the ring's inner edge, where the ellipse is narrow: below, sectors run together
ROUGHEST = 0.05  # rms distance of a contour from its ellipse, in radii, besides that of noise and pixels
STAIN, COARSE_STAIN = 0.4, 0.6
"""Largest departure of a plate from even light, as a share of the contrast; the second before the frame is
refined."""


class TargetAppearance(NamedTuple):
    """Appearance of a target; radii in radii of the dot, grey values in those of the image."""

    gap: float
    """Middle of the gap between dot and ring."""
    ring_inner: float
    ring_outer: float
    outside: float
    """Middle between the ring and the plate's edge."""
    contrast_dn: float
    """Dot and plate differ by more than this,"""
    noise_dn: float
    """and by more than four times this, the standard deviation of a pixel."""
    flattest: float
    """Shorter over longer axis of the flattest dot."""
    least_axis_px: float
    """Longer half of the smallest dot's box."""


@step
def least_contrast(target: TargetAppearance) -> float:
    """Return by how much dot and plate must differ [DN]."""
    return max(target.contrast_dn, 4.0 * target.noise_dn)


@step
def grey(image: Array, x: float, y: float) -> float:
    """Return the grey value at (x, y), which must lie within the image's pixel centres, by bilinear interpolation.

    x and y must also be less than the last column and row, where there is nothing to interpolate with.
    """
    column, row = int(x), int(y)
    fx, fy = x - column, y - row
    i, j = np.uintp(column), np.uintp(row)  # unsigned: spares the test for indices from the end
    right, below = i + np.uintp(1), j + np.uintp(1)
    upper = image[j, i] * (1.0 - fx) + image[j, right] * fx
    lower = image[below, i] * (1.0 - fx) + image[below, right] * fx
    result: float = upper * (1.0 - fy) + lower * fy
    return result


@step
def grey_of(image: Array, frame: Array, radius: float, c: float, s: float) -> float:
    """Return the grey value at ``radius`` in the direction (c, s) of a frame (x, y, axx, axy, ayy, gx, gy)."""
    u, v = radius * c, -radius * s
    x, y = frame[2] * u + frame[3] * v, frame[3] * u + frame[4] * v
    if frame[5] != 0.0 or frame[6] != 0.0:
        w = 1.0 / (1.0 + frame[5] * u + frame[6] * v)
        x, y = x * w, y * w
    result: float = grey(image, frame[0] + x, frame[1] + y)
    return result


@step
def is_inside(image: Array, frame: Array, radius: float) -> bool:
    """Return whether a frame's disc of ``radius``, enlarged by its perspective, lies within the image."""
    room = radius / (1.0 - radius * math.hypot(frame[5], frame[6]))
    half_x, half_y = room * math.hypot(frame[2], frame[3]), room * math.hypot(frame[3], frame[4])
    right, bottom = image.shape[1] - 1, image.shape[0] - 1
    across = half_x <= frame[0] < right - half_x
    result: bool = across and half_y <= frame[1] < bottom - half_y
    return result


@step
def half_extent(frame: Array) -> float:
    """Return the longer half of the dot's box [px]."""
    return max(math.hypot(frame[2], frame[3]), math.hypot(frame[3], frame[4]))


@step
def ellipse_of(frame: Array, mxx: float, mxy: float, myy: float) -> float:
    """Write the root of 4 M to a frame, with M the second moments of its dot; return the axes' ratio, 0 for none."""
    det = mxx * myy - mxy * mxy
    if not det > (HALF_PX / 2.0) ** 4:
        return 0.0
    root = math.sqrt(det)
    scale = 2.0 / math.sqrt(mxx + myy + 2.0 * root)
    frame[2], frame[3], frame[4] = scale * (mxx + root), scale * mxy, scale * (myy + root)
    half, spread = 0.5 * (mxx + myy), math.hypot(0.5 * (mxx - myy), mxy)
    return math.sqrt((half - spread) / (half + spread))


@step
def dot_of(sums: Array, frame: Array, target: TargetAppearance) -> bool:
    """Write the ellipse of a bright patch to ``frame``; False where the patch is no filled ellipse."""
    area = sums[0]
    if area < LEAST_AREA_PX or max(sums[7] - sums[6], sums[9] - sums[8]) >= LARGEST_BOX_PX:
        return False
    x, y = sums[1] / area, sums[2] / area
    mxx, mxy, myy = sums[3] / area - x * x + 1 / 12, sums[4] / area - x * y, sums[5] / area - y * y + 1 / 12
    ratio = ellipse_of(frame, mxx, mxy, myy)
    if ratio < 0.7 * target.flattest:
        return False
    frame[0], frame[1] = x, y
    frame[5] = frame[6] = 0.0
    if half_extent(frame) < target.least_axis_px:
        return False
    solid = area / (4.0 * math.pi * math.sqrt(mxx * myy - mxy * mxy))
    result: bool = LEAST_SOLID < solid < MOST_SOLID
    return result


@step
def plate_level(image: Array, frame: Array, target: TargetAppearance, plate: Array) -> float:
    """Fit the plate's light (mean, its slopes along u and v [DN per radius]) to gap and outside.

    Returns the largest departure from it [DN].
    """
    values = np.empty((2, SECTORS))
    radii = (target.gap, target.outside)
    plate[:] = 0.0
    for k in range(SECTORS):
        c, s = COS[k * PER_SECTOR], SIN[k * PER_SECTOR]
        for i in range(2):
            values[i, k] = grey_of(image, frame, radii[i], c, s)
            plate[0] += values[i, k]
            plate[1] += values[i, k] * radii[i] * c
            plate[2] -= values[i, k] * radii[i] * s
    plate[0] /= 2 * SECTORS
    squares = 0.5 * SECTORS * (radii[0] ** 2 + radii[1] ** 2)
    plate[1] /= squares
    plate[2] /= squares
    largest = 0.0
    for k in range(SECTORS):
        slope = plate[1] * COS[k * PER_SECTOR] - plate[2] * SIN[k * PER_SECTOR]
        for i in range(2):
            largest = max(largest, abs(values[i, k] - plate[0] - radii[i] * slope))
    return largest


@step
def dot_level(image: Array, frame: Array) -> float:
    """Return the grey value of the dot's middle [DN]."""
    total = grey(image, frame[0], frame[1])
    for k in range(8):
        total += grey_of(image, frame, 0.4, COS[STEPS // 8 * k], SIN[STEPS // 8 * k])
    result: float = total / 9.0
    return result


@step
def trace_dot(image: Array, frame: Array, level: float, target: TargetAppearance) -> tuple[float, float]:
    """Refine a frame by the dot's contour at grey value ``level``.

    Returns the rms distance of the contour from its ellipse, in radii, and the ellipse's ratio of axes; (9, 0)
    where a ray from the middle does not cross the contour before the middle of the gap.
    """
    x, y = np.empty(RAYS), np.empty(RAYS)
    reach = 0.5 * (target.gap + target.ring_inner)
    for k in range(RAYS):
        c, s = COS[STEPS // RAYS * k], SIN[STEPS // RAYS * k]
        last, radius, below = grey_of(image, frame, 0.3, c, s), 0.3, False
        while radius < reach:
            radius += 0.1
            value = grey_of(image, frame, radius, c, s)
            if value <= level < last:
                radius -= 0.1 * (level - value) / (last - value)
                below = True
                break
            last = value
        if not below:
            return 9.0, 0.0
        x[k] = radius * (frame[2] * c - frame[3] * s)
        y[k] = radius * (frame[3] * c - frame[4] * s)
    area = mx = my = mxx = mxy = myy = 0.0
    for k in range(RAYS):
        n = (k + 1) % RAYS
        cross = y[k] * x[n] - x[k] * y[n]  # rays run counter-clockwise as seen, y down
        area += cross / 2.0
        mx += cross * (x[k] + x[n]) / 6.0
        my += cross * (y[k] + y[n]) / 6.0
        mxx += cross * (x[k] ** 2 + x[k] * x[n] + x[n] ** 2) / 12.0
        myy += cross * (y[k] ** 2 + y[k] * y[n] + y[n] ** 2) / 12.0
        mxy += cross * (x[k] * (2.0 * y[k] + y[n]) + x[n] * (2.0 * y[n] + y[k])) / 24.0
    if not area > 0.0:
        return 9.0, 0.0
    mx, my = mx / area, my / area
    ratio = ellipse_of(frame, mxx / area - mx * mx, mxy / area - mx * my, myy / area - my * my)
    if ratio == 0.0:
        return 9.0, 0.0
    for i in range(2, 5):
        frame[i] *= POLYGON
    frame[0] += mx
    frame[1] += my
    det = frame[2] * frame[4] - frame[3] ** 2
    squares = 0.0
    for k in range(RAYS):
        dx, dy = x[k] - mx, y[k] - my
        u, v = (frame[4] * dx - frame[3] * dy) / det, (frame[2] * dy - frame[3] * dx) / det
        squares += (math.hypot(u, v) - 1.0) ** 2
    return math.sqrt(squares / RAYS), ratio


@kernel
def find_dots(image: Array, patches: Array, target: TargetAppearance) -> Array:
    """Return the frames (n, FRAME) of the dots among the bright patches (m, N_SUMS) of an image."""
    frames, plate = np.zeros((len(patches) + 1, FRAME)), np.empty(3)
    n = 0
    for sums in patches:
        frame = frames[n]
        if not (dot_of(sums, frame, target) and is_inside(image, frame, target.outside)):
            continue
        stain = plate_level(image, frame, target, plate)
        contrast = dot_level(image, frame) - plate[0]
        if contrast < least_contrast(target) or stain > COARSE_STAIN * contrast + 2.0 * target.noise_dn:
            continue
        rough, ratio = trace_dot(image, frame, plate[0] + 0.5 * contrast, target)
        radius = math.sqrt(max(frame[AXX] * frame[AYY] - frame[AXY] ** 2, 1e-9))
        limit = ROUGHEST + (0.1 + 2.5 * target.noise_dn / contrast) / radius
        sector = 2.0 * math.pi / SECTORS * target.ring_inner * radius * math.sqrt(ratio)
        if rough < limit and ratio > target.flattest and sector > SHORTEST_SECTOR_PX:
            n += 1
    return frames[:n]


@kernel
def light_at(image: Array, frames: Array, target: TargetAppearance, radii: Array) -> tuple[Array, Array]:
    """Return the light (n, m, STEPS) at ``radii`` (m,) of frames (n, FRAME), and their levels (n, LEVELS) [DN].

    Light 0 is that of the plate, 1 that of the dot; levels are PLATE_DN and CONTRAST_DN, which is 0 where the plate
    is no plate.
    """
    light, levels = np.empty((len(frames), len(radii), STEPS)), np.zeros((len(frames), LEVELS))
    plate = np.empty(3)
    for n in range(len(frames)):
        frame = frames[n]
        if not is_inside(image, frame, target.outside):
            continue
        stain = plate_level(image, frame, target, plate)
        contrast = dot_level(image, frame) - plate[0]
        if contrast < least_contrast(target) or stain > STAIN * contrast + 2.0 * target.noise_dn:
            continue
        levels[n, PLATE_DN], levels[n, CONTRAST_DN] = plate[0], contrast
        for b, radius in enumerate(radii):
            for i in range(STEPS):
                c, s = COS[i], SIN[i]
                value = grey_of(image, frame, radius, c, s)
                light[n, b, i] = (value - plate[0] - radius * (plate[1] * c - plate[2] * s)) / contrast
    return light, levels
