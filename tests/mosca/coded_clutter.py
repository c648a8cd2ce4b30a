"""Views without any coded target, of eight kinds, for the rate of false identifications."""

from collections.abc import Callable

import cv2
import numpy as np
from coded_views import View, paint
from scipy import ndimage

from mosca.data.target_codes import SECTORS, ring_code

SHAPE = (120, 160)
FINE = 4


def _finished(fine: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Grey values (H, W) uint8 of a drawing FINE times as large: blurred, sampled, with noise."""
    image = cv2.GaussianBlur(fine.astype(np.float32), (0, 0), FINE * rng.uniform(0.4, 1.2))
    image = image.reshape(SHAPE[0], FINE, SHAPE[1], FINE).mean(axis=(1, 3))
    noisy = image + rng.normal(0, rng.choice([0.5, 3.0, 10.0]), SHAPE)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _canvas(rng: np.random.Generator) -> np.ndarray:
    return np.full((SHAPE[0] * FINE, SHAPE[1] * FINE), rng.uniform(0, 60), np.uint8)


def _place(rng: np.random.Generator) -> tuple[int, int]:
    return int(rng.integers(SHAPE[1] * FINE)), int(rng.integers(SHAPE[0] * FINE))


def blobs(rng: np.random.Generator) -> np.ndarray:
    """Bright ellipses, as of lamps, markers and reflections."""
    fine = _canvas(rng)
    for _ in range(int(rng.integers(5, 80))):
        axes = (int(rng.uniform(3, 50)), int(rng.uniform(3, 50)))
        cv2.ellipse(fine, _place(rng), axes, rng.uniform(0, 180), 0, 360, rng.uniform(60, 255), -1)
    return _finished(fine, rng)


def rings(rng: np.random.Generator) -> np.ndarray:
    """Dots within circles, some of them broken."""
    fine = _canvas(rng)
    for _ in range(int(rng.integers(2, 15))):
        centre, radius, grey = _place(rng), rng.uniform(6, 40), rng.uniform(80, 255)
        cv2.circle(fine, centre, int(radius), grey, -1)
        start = rng.uniform(0, 360)
        for _ in range(int(rng.integers(1, 8))):
            end = start + rng.uniform(5, 120)
            reach, width = int(radius * rng.uniform(1.7, 3.2)), max(1, int(radius * rng.uniform(0.3, 1.2)))
            cv2.ellipse(fine, centre, (reach, reach), 0, start, end, rng.uniform(80, 255), width)
            start = end + rng.uniform(5, 120)
    return _finished(fine, rng)


def strokes(rng: np.random.Generator) -> np.ndarray:
    """Letters and lines."""
    fine = _canvas(rng)
    for _ in range(int(rng.integers(3, 15))):
        text = "".join(chr(c) for c in rng.integers(33, 127, int(rng.integers(3, 14))))
        size, width = rng.uniform(0.8, 5), int(rng.integers(2, 14))
        cv2.putText(fine, text, _place(rng), int(rng.integers(0, 8)), size, rng.uniform(80, 255), width)
        cv2.line(fine, _place(rng), _place(rng), rng.uniform(80, 255), width)
    return _finished(fine, rng)


def other_rings(rng: np.random.Generator) -> np.ndarray:
    """Plates exactly like coded targets, of every size and tilt, whose sectors are no number."""
    views = []
    for x, y in ((40, 32), (120, 32), (40, 88), (120, 88)):
        bits = tuple(bool(b) for b in rng.integers(0, 2, SECTORS))
        while ring_code().find(bits) is not None:
            bits = tuple(bool(b) for b in rng.integers(0, 2, SECTORS))
        at = (x + rng.uniform(-3, 3), y + rng.uniform(-3, 3))
        tilt, lean, roll = rng.uniform(0, 1.2), *rng.uniform(0, 2 * np.pi, 2)
        views.append(View(0, at, rng.uniform(3, 10), tilt, lean, roll, z=rng.uniform(30, 200), bits=bits))
    grey = rng.uniform(60, 250)
    noise = grey / rng.choice([10, 50, 200])
    blur = rng.uniform(0.4, 1.0)
    return paint(SHAPE, views, rng=rng, white=grey, black=5.0, around=5.0, noise=noise, blur=blur, samples=3)


def boards(rng: np.random.Generator) -> np.ndarray:
    """Checkerboards, grids of dots and fields of markers, leaning."""
    n = int(rng.integers(4, 24))
    board = np.indices((n, n)).sum(axis=0) % 2 * 255
    kind = rng.integers(3)
    fine = np.kron(board, np.ones((32, 32))).astype(np.uint8)
    if kind == 1:
        y, x = np.mgrid[: n * 32, : n * 32]
        fine = np.where(np.hypot(x % 32 - 16, y % 32 - 16) < rng.uniform(4, 14), 255, 0).astype(np.uint8)
    elif kind == 2:
        markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
        tiles = [cv2.aruco.generateImageMarker(markers, int(k), 30) for k in rng.integers(0, 1000, n * n)]
        tiles = [np.pad(255 - tile if rng.random() < 0.5 else tile, 1) for tile in tiles]
        fine = np.block([[tiles[r * n + c] for c in range(n)] for r in range(n)])
    size = np.array([SHAPE[1], SHAPE[0]]) * FINE
    corners = (np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + rng.uniform(-0.4, 0.4, (4, 2))) * size
    edge = float(n * 32)
    flat = np.array([[0, 0], [edge, 0], [edge, edge], [0, edge]], np.float32)
    warp = cv2.getPerspectiveTransform(flat, corners.astype(np.float32))
    return _finished(cv2.warpPerspective(fine, warp, tuple(int(s) for s in size), flags=cv2.INTER_LINEAR), rng)


def noise(rng: np.random.Generator) -> np.ndarray:
    """Noise, white or smooth."""
    image = ndimage.gaussian_filter(rng.normal(0, 1, SHAPE), rng.uniform(0, 4))
    return np.clip(np.rint(128 + rng.uniform(20, 90) * image / image.std()), 0, 255).astype(np.uint8)


def textures(rng: np.random.Generator) -> np.ndarray:
    """Surfaces with power at all scales (1/f and the like), some cut into grey steps, some with grain or stones."""
    fx, fy = np.meshgrid(np.fft.fftfreq(SHAPE[1]), np.fft.fftfreq(SHAPE[0]) * rng.uniform(0.3, 3))
    power = 1 / np.maximum(np.hypot(fx, fy), 1e-3) ** rng.uniform(0.6, 2.0)
    image = np.fft.ifft2(np.fft.fft2(rng.normal(0, 1, SHAPE)) * power).real
    image /= image.std()
    kind = rng.integers(3)
    if kind == 1:
        image = np.round(image * rng.uniform(0.5, 3))
    elif kind == 2:
        seeds = np.ones(SHAPE, bool)
        seeds[rng.integers(0, SHAPE[0], 300), rng.integers(0, SHAPE[1], 300)] = False
        image = ndimage.distance_transform_edt(seeds)
    image = ndimage.gaussian_filter(image, 0.6)
    low, high = np.percentile(image, [1, 99])
    return np.clip(np.rint(255 * (image - low) / max(high - low, 1e-9)), 0, 255).astype(np.uint8)


def sectors(rng: np.random.Generator) -> np.ndarray:
    """Rings of sectors around nothing, beside their dot, or of another number of sectors."""
    fine = _canvas(rng)
    for _ in range(int(rng.integers(2, 7))):
        (x, y), radius, n = _place(rng), rng.uniform(8, 40), int(rng.integers(8, 33))
        bits = rng.integers(0, 2, n)
        # one ring of 20 random sectors in a hundred is a number: about its dot that is a target, no clutter
        while n == SECTORS and ring_code().find(tuple(bits[::-1].astype(bool).tolist())) is not None:
            bits = rng.integers(0, 2, n)
        for k in np.flatnonzero(bits):
            angle = np.linspace(k, k + 1, 9) * 2 * np.pi / n
            ring = np.concatenate([3 * np.exp(1j * angle), 2 * np.exp(1j * angle[::-1])]) * radius
            cv2.fillPoly(fine, [np.stack([x + ring.real, y + ring.imag], axis=1).astype(np.int32)], 220)
        beside = rng.uniform(-1, 1, 2) * radius if rng.random() < 0.5 else (0, 0)
        cv2.circle(fine, (int(x + beside[0]), int(y + beside[1])), int(radius * rng.uniform(0.6, 1.5)), 220, -1)
    return _finished(fine, rng)


KINDS: tuple[Callable[[np.random.Generator], np.ndarray], ...] = (
    blobs, rings, strokes, other_rings, boards, noise, textures, sectors,
)  # fmt: skip


def view(index: int, seed: int = 0) -> np.ndarray:
    """Return view ``index`` (H, W) uint8; kinds alternate."""
    return KINDS[index % len(KINDS)](np.random.default_rng([seed, index]))
