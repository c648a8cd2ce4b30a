"""Compiled reading of coded targets: from bright patches to dots, and from dots to the sectors around them.

Called by ``mosca.coded``, which tells the method. Free of the GIL, one thread. A *frame* maps the plate into the
image: ``x = c + A u / (1 + g . u)``, with u in radii of the dot, A (2, 2) symmetric, so that |u| = 1 is the
dot's ellipse, and g (2,) the perspective that remains. Angles on the plate run counter-clockwise seen from the
front: u = (cos t, -sin t), since y points down in the image.
"""

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from mosca.data.arrays import Array

# A kernel and all its steps stand in one file: numba keeps a cached kernel as long as its own file is unchanged.
kernel = numba.njit(nogil=True, cache=True, error_model="numpy")
step = numba.njit(nogil=True, error_model="numpy")

X, Y, AXX, AXY, AYY, WORD, START, MARGIN, PLATE_DN, CONTRAST_DN, LIKENESS = range(11)
N_COLUMNS = 11

SECTORS = 20
WINDOW = 3  # sectors to each side: of 7 in a row, one at least is white and one black (runs of at most 5)
PER_SECTOR = 6
STEPS = SECTORS * PER_SECTOR
BANDS = 3
RAYS = 24
COS = np.cos(2.0 * np.pi * np.arange(STEPS) / STEPS)
SIN = np.sin(2.0 * np.pi * np.arange(STEPS) / STEPS)
# the contour's polygon has a slightly smaller second moment than its ellipse: (2 + cos(2 pi / n)) / 3
POLYGON = math.sqrt(3.0 / (2.0 + math.cos(2.0 * math.pi / RAYS)))
LEAST_SOLID, MOST_SOLID = 0.8, 1.15  # a patch's area over that of the ellipse of its second moments
LARGEST_BOX_PX = 56
COARSE_STAIN = 0.6  # of the contrast, as long as the frame is that of the patch
SHORTEST_SECTOR_PX = 1.0  # on the ring's inner edge, where the ellipse is narrow: below, sectors run together
SURE = 0.4  # margin from which on no other perspective is tried
BAND_TOLERANCE = 0.35
USUAL_BLUR_PX, MOST_PEAKING = 0.8, 0.6
HALF_PX = 0.5  # no dot is thinner than a pixel


class Reading(NamedTuple):
    """What a target looks like; radii in radii of the dot, grey values in those of the image."""

    gap: float
    ring_inner: float
    ring_outer: float
    outside: float
    contrast_dn: float
    noise_dn: float
    least_area_px: int
    least_axis_px: float
    flattest: float
    roughest: float
    stain: float
    least_swing: float
    least_margin: float
    least_likeness: float


@step
def least_contrast(reading: Reading) -> float:
    """Return by how much dot and plate must differ [DN]."""
    return max(reading.contrast_dn, 4.0 * reading.noise_dn)


@step
def grey(image: Array, x: float, y: float) -> float:
    """Return the grey value at (x, y), which must lie within the image, by bilinear interpolation."""
    column, row = min(int(x), image.shape[1] - 2), min(int(y), image.shape[0] - 2)
    fx, fy = x - column, y - row
    upper = image[row, column] * (1.0 - fx) + image[row, column + 1] * fx
    lower = image[row + 1, column] * (1.0 - fx) + image[row + 1, column + 1] * fx
    return upper * (1.0 - fy) + lower * fy


@step
def grey_of(image: Array, frame: Array, radius: float, c: float, s: float) -> float:
    """Return the grey value at ``radius`` in the direction (c, s) of a frame (x, y, axx, axy, ayy, gx, gy)."""
    u, v = radius * c, -radius * s
    w = 1.0 / (1.0 + frame[5] * u + frame[6] * v)
    x = frame[0] + (frame[2] * u + frame[3] * v) * w
    y = frame[1] + (frame[3] * u + frame[4] * v) * w
    return grey(image, x, y)


@step
def is_inside(image: Array, frame: Array, radius: float) -> bool:
    """Tell whether a frame's disc of ``radius``, with room for its perspective, lies within the image."""
    room = radius / (1.0 - radius * math.hypot(frame[5], frame[6]))
    half_x, half_y = room * math.hypot(frame[2], frame[3]), room * math.hypot(frame[3], frame[4])
    right, bottom = image.shape[1] - 1, image.shape[0] - 1
    return half_x <= frame[0] <= right - half_x and half_y <= frame[1] <= bottom - half_y


@step
def half_extent(frame: Array) -> float:
    """Return the longer half of the dot's box [px]."""
    return max(math.hypot(frame[2], frame[3]), math.hypot(frame[3], frame[4]))


@step
def ellipse_of(frame: Array, mxx: float, mxy: float, myy: float) -> float:
    """Write the root of 4 M to a frame, M the second moments of its dot; return the axes' ratio, 0 for none."""
    det = mxx * myy - mxy * mxy
    if not det > (HALF_PX / 2.0) ** 4:
        return 0.0
    root = math.sqrt(det)
    scale = 2.0 / math.sqrt(mxx + myy + 2.0 * root)
    frame[2], frame[3], frame[4] = scale * (mxx + root), scale * mxy, scale * (myy + root)
    half, spread = 0.5 * (mxx + myy), math.hypot(0.5 * (mxx - myy), mxy)
    return math.sqrt((half - spread) / (half + spread))


@step
def patch_sums(labels: Array, count: int) -> Array:
    """Return for each label the sums of 1, x, y, xx, xy, yy over its pixels, and its box (left, right, top, bottom)."""
    sums = np.zeros((count, 10), np.int64)
    sums[:, 6], sums[:, 8] = labels.shape[1], labels.shape[0]
    for y in range(labels.shape[0]):
        for x in range(labels.shape[1]):
            if labels[y, x] == 0:
                continue
            own = sums[labels[y, x]]
            own[0] += 1
            own[1] += x
            own[2] += y
            own[3] += x * x
            own[4] += x * y
            own[5] += y * y
            own[6], own[7] = min(own[6], x), max(own[7], x)
            own[8], own[9] = min(own[8], y), max(own[9], y)
    return sums


@step
def dot_of(sums: Array, frame: Array, reading: Reading) -> bool:
    """Write the ellipse of a bright patch to ``frame``; False where the patch is no filled ellipse."""
    area = sums[0]
    if area < reading.least_area_px or max(sums[7] - sums[6], sums[9] - sums[8]) >= LARGEST_BOX_PX:
        return False
    x, y = sums[1] / area, sums[2] / area
    mxx, mxy, myy = sums[3] / area - x * x + 1 / 12, sums[4] / area - x * y, sums[5] / area - y * y + 1 / 12
    ratio = ellipse_of(frame, mxx, mxy, myy)
    if ratio < 0.7 * reading.flattest:
        return False
    frame[0], frame[1] = x, y
    frame[5] = frame[6] = 0.0
    if half_extent(frame) < reading.least_axis_px:
        return False
    solid = area / (4.0 * math.pi * math.sqrt(mxx * myy - mxy * mxy))
    return LEAST_SOLID < solid < MOST_SOLID


@step
def plate_level(image: Array, frame: Array, reading: Reading, plate: Array) -> float:
    """Fit the plate's light (mean, its slopes along u and v [DN per radius]) to gap and outside.

    Returns the largest departure from it [DN].
    """
    values = np.empty((2, SECTORS))
    radii = (reading.gap, reading.outside)
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
    return total / 9.0


@step
def trace_dot(image: Array, frame: Array, level: float, reading: Reading) -> tuple[float, float]:
    """Refine a frame by the dot's contour at grey value ``level``.

    Returns the rms distance of the contour from its ellipse, in radii, and the ellipse's ratio of axes; (9, 0)
    where a ray from the middle does not cross the contour before the middle of the gap.
    """
    x, y = np.empty(RAYS), np.empty(RAYS)
    reach = 0.5 * (reading.gap + reading.ring_inner)
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


@step
def sector_length(frame: Array, t: float, radius: float) -> float:
    """Return how long a sector is in the image [px], at the angle t and at ``radius`` on the plate."""
    c, s = math.cos(t), math.sin(t)
    along = math.hypot(frame[2] * s + frame[3] * c, frame[3] * s + frame[4] * c)
    return 2.0 * math.pi / SECTORS * radius * along


@step
def likeness(light: Array, word: int, start: float, frame: Array, radius: float) -> float:
    """Return the correlation of a ring's light (STEPS) with that of ``word`` under ``USUAL_BLUR_PX``.

    ``start`` of the first sector in steps.
    """
    n = sx = sy = sxx = sxy = syy = 0.0
    for i in range(STEPS):
        place = (i - start) / PER_SECTOR % SECTORS
        k = min(int(place), SECTORS - 1)
        share = place - k
        length = sector_length(frame, 2.0 * math.pi * i / STEPS, radius) / (math.sqrt(2.0) * USUAL_BLUR_PX)
        before, after = 0.5 * math.erfc(share * length), 0.5 * math.erfc((1.0 - share) * length)
        x = before * (word >> (k - 1) % SECTORS & 1) + after * (word >> (k + 1) % SECTORS & 1)
        x += (1.0 - before - after) * (word >> k & 1)
        y = light[i]
        n += 1.0
        sx += x
        sy += y
        sxx += x * x
        sxy += x * y
        syy += y * y
    spread = (n * sxx - sx * sx) * (n * syy - sy * sy)
    return (n * sxy - sx * sy) / math.sqrt(spread) if spread > 0.0 else 0.0


@step
def peaking_of(frame: Array, start: float, radius: float) -> Array:
    """Return how much of its neighbours' light is to be taken off each sector (SECTORS), by its length in px.

    A blur of ``USUAL_BLUR_PX`` lets a share a = erfc(length / (sqrt(8) blur)) / 2 of each neighbour into the
    middle of a sector; to first order that is undone by a / (1 - 4 a) of the difference.
    """
    peaking = np.empty(SECTORS)
    for k in range(SECTORS):
        length = sector_length(frame, start + 2.0 * math.pi * (k + 0.5) / SECTORS, radius)
        a = 0.5 * math.erfc(length / (math.sqrt(8.0) * USUAL_BLUR_PX))
        peaking[k] = min(a / max(1.0 - 4.0 * a, 1e-3), MOST_PEAKING)
    return peaking


@step
def sharpen(level: Array, peaking: Array) -> None:
    """Take the neighbours' light off the sectors' levels, in place."""
    first, last = level[0], level[-1]
    for k in range(SECTORS):
        after = level[k + 1] if k + 1 < SECTORS else first
        own = level[k]
        level[k] += peaking[k] * (2.0 * own - last - after)
        last = own


@step
def read_ring(image: Array, frame: Array, plate: Array, contrast: float, reading: Reading) -> tuple[Any, ...]:
    """Read the sectors; ``contrast`` of the dot and what is left of it on the ring must agree.

    Returns the word, bit k for the k-th sector, where the first sector starts [rad], and the smallest margin of
    a sector; a margin of -1 where the ring is no ring of sectors.
    """
    light = np.zeros((BANDS + 1, STEPS))
    width = reading.ring_outer - reading.ring_inner
    for i in range(STEPS):
        c, s = COS[i], SIN[i]
        for b in range(BANDS):
            radius = reading.ring_inner + width * (0.5 + 0.22 * (b - 1))
            value = grey_of(image, frame, radius, c, s)
            light[b, i] = (value - plate[0] - radius * (plate[1] * c - plate[2] * s)) / contrast
            light[BANDS, i] += light[b, i] / BANDS
    real = imaginary = 0.0
    for i in range(STEPS):
        edge = light[BANDS, (i + 1) % STEPS] - light[BANDS, i - 1]
        turn = i % PER_SECTOR * SECTORS  # a sector is a full turn of the phase
        real += edge * edge * COS[turn]
        imaginary += edge * edge * SIN[turn]
    start = math.atan2(imaginary, real) / (2.0 * math.pi) * PER_SECTOR  # in steps
    start_rad, middle = 2.0 * math.pi * start / STEPS, 0.5 * (reading.ring_inner + reading.ring_outer)
    peaking = peaking_of(frame, start_rad, middle)
    word, margin = 0, 9.0
    level = np.empty(SECTORS)
    for b in range(BANDS, -1, -1):
        for k in range(SECTORS):
            level[k] = 0.0
            for j in range(-2, 3):
                place = start + (k + 0.5 + 0.15 * j) * PER_SECTOR
                below = math.floor(place)
                share = place - below
                i = int(below) % STEPS
                level[k] += 0.2 * ((1.0 - share) * light[b, i] + share * light[b, (i + 1) % STEPS])
        sharpen(level, peaking)
        for k in range(SECTORS):
            low = high = level[k]
            for j in range(-WINDOW, WINDOW + 1):
                low, high = min(low, level[(k + j) % SECTORS]), max(high, level[(k + j) % SECTORS])
            swing = 0.5 * (high - low)
            if b == BANDS:
                if 2.0 * swing < reading.least_swing or high > 1.0 / reading.least_swing:
                    return 0, 0.0, -1.0, 0.0
                margin = min(margin, abs(level[k] - 0.5 * (high + low)) / swing)
                word |= int(level[k] > 0.5 * (high + low)) << k
            elif (level[k] - 0.5 * (high + low)) * (2 * (word >> k & 1) - 1) < -BAND_TOLERANCE * swing:
                return 0, 0.0, -1.0, 0.0  # a sector is of one colour from its inner to its outer edge
    return word, start_rad, margin, likeness(light[BANDS], word, start, frame, middle)


@step
def read_dot(image: Array, frame: Array, ratio: float, reading: Reading, out: Array) -> bool:
    """Read the ring around a dot, the flatter the dot with the more perspectives; tell whether it could be."""
    plate = np.empty(3)
    # across the ellipse's longer axis the plate leans away: there its perspective lies
    angle = 0.5 * math.atan2(2.0 * frame[3], frame[2] - frame[4]) + 0.5 * math.pi
    out[MARGIN] = -1.0
    for attempt in range(5 if ratio < 0.9 else 1):
        if out[MARGIN] > SURE:
            break
        g = (0.0, 0.03, -0.03, 0.06, -0.06)[attempt]
        frame[5], frame[6] = g * math.cos(angle), g * math.sin(angle)
        if not is_inside(image, frame, reading.outside):
            continue
        stain = plate_level(image, frame, reading, plate)
        contrast = dot_level(image, frame) - plate[0]
        if contrast < least_contrast(reading):
            continue
        if stain > reading.stain * contrast + 2.0 * reading.noise_dn:
            continue
        word, start, margin, like = read_ring(image, frame, plate, contrast, reading)
        if margin > max(out[MARGIN], reading.least_margin) and like > reading.least_likeness:
            out[:5] = frame[:5]
            out[WORD], out[START], out[MARGIN] = word, start, margin
            out[LIKENESS] = like
            out[PLATE_DN], out[CONTRAST_DN] = plate[0], contrast
    return out[MARGIN] > 0.0


@kernel
def read_targets(image: Array, labels: Array, count: int, reading: Reading) -> Array:
    """Return what is read around the bright patches of an image, a table (n, N_COLUMNS).

    ``labels`` (H, W): 0, or the number of the patch, below ``count``.
    """
    sums = patch_sums(labels, count)
    table = np.empty((count, N_COLUMNS))
    frame, plate = np.empty(7), np.empty(3)
    n = 0
    for label in range(1, count):
        if not (dot_of(sums[label], frame, reading) and is_inside(image, frame, reading.outside)):
            continue
        stain = plate_level(image, frame, reading, plate)
        contrast = dot_level(image, frame) - plate[0]
        if contrast < least_contrast(reading) or stain > COARSE_STAIN * contrast + 2.0 * reading.noise_dn:
            continue
        rough, ratio = trace_dot(image, frame, plate[0] + 0.5 * contrast, reading)
        radius = math.sqrt(max(frame[2] * frame[4] - frame[3] ** 2, 1e-9))
        limit = reading.roughest + (0.1 + 2.5 * reading.noise_dn / contrast) / radius
        sector = 2.0 * math.pi / SECTORS * reading.ring_inner * radius * math.sqrt(ratio)
        if rough > limit or ratio < reading.flattest or sector < SHORTEST_SECTOR_PX:
            continue
        if read_dot(image, frame, ratio, reading, table[n]):
            n += 1
    return table[:n]
