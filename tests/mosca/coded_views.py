"""Coded targets rendered by brute force for the tests: every pixel is the mean of many samples.

Shares only the table of code numbers with the code under test and the twin: rays of a pinhole camera meet
the plate's plane, where the print is evaluated in polar coordinates.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from mosca.data.target_codes import code_bits

SAMPLES = 6


@dataclass(frozen=True)
class View:
    """One plate before a camera of principal distance ``f`` [px] at ``z`` dot radii from its centre.

    ``xy`` image of its centre [px]; it leans by ``tilt`` to the side ``lean`` and is rolled by ``roll`` [rad].
    """

    number: int
    xy: tuple[float, float]
    dot_px: float
    tilt: float = 0.0
    lean: float = 0.0
    roll: float = 0.0
    z: float = 100.0
    bits: tuple[bool, ...] | None = None

    @property
    def rotation(self) -> np.ndarray:
        """Plate -> camera: the plate's x right, y up, its face to the camera; camera y down, z forward."""
        facing = np.diag([1.0, -1.0, -1.0])
        axis = np.array([np.cos(self.lean), np.sin(self.lean), 0.0])
        return (
            Rotation.from_rotvec(self.tilt * axis).as_matrix()
            @ facing
            @ Rotation.from_euler("z", self.roll).as_matrix()
        )

    @property
    def centre(self) -> np.ndarray:
        """The plate's centre in the camera frame whose z axis goes through it [dot radii]."""
        return np.array([0.0, 0.0, self.z])


def printed(bits: tuple[bool, ...], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """What is white (1), black (0) or no plate (nan) at plate coordinates in radii of the dot, y up."""
    radius, angle = np.hypot(x, y), np.arctan2(y, x) % (2 * np.pi)
    sector = np.minimum((angle / (2 * np.pi / 20)).astype(int), 19)
    white = (radius < 1) | ((radius > 2) & (radius < 3) & np.array(bits)[sector])
    return np.where(np.maximum(np.abs(x), np.abs(y)) <= 4, white.astype(float), np.nan)


def paint(
    shape: tuple[int, int],
    views: list[View],
    *,
    blur: float = 0.7,
    white: float = 200.0,
    black: float = 8.0,
    around: float = 8.0,
    noise: float = 0.5,
    light=None,
    rng: np.random.Generator | None = None,
    samples: int = SAMPLES,
    hide=None,
    raw: bool = False,
) -> np.ndarray:
    """Return an image (H, W) uint8. ``light(x, y)``: factor on all grey values; ``hide(x, y, u, v)``: what hides.

    ``hide`` gets plate coordinates (x, y) and returns (n,) the grey value that hides a sample, nan for none.
    """
    out = np.full(shape, around)
    for view in views:
        f = view.dot_px / 2 * view.z
        reach = int(np.ceil(2.9 * view.dot_px * (1.6 if view.tilt else 1.0) + 5 * blur + 2))
        left, top = round(view.xy[0]) - reach, round(view.xy[1]) - reach
        n = 2 * reach + 1
        fine = (np.arange(n * samples) + 0.5) / samples - 0.5
        px, py = np.meshgrid(fine + left - view.xy[0], fine + top - view.xy[1])
        rays = np.stack([px / f, py / f, np.ones_like(px)], axis=-1)
        normal = view.rotation[:, 2]
        depth = (normal @ view.centre) / (rays @ normal)
        plate = (rays * depth[..., None] - view.centre) @ view.rotation
        bits = code_bits(view.number) if view.bits is None else view.bits
        what = printed(bits, plate[..., 0], plate[..., 1])
        grey = np.where(np.isnan(what), around, black + (white - black) * np.nan_to_num(what))
        if hide is not None:
            hidden = hide(plate[..., 0], plate[..., 1])
            grey = np.where(np.isnan(hidden), grey, np.nan_to_num(hidden))
        if blur:
            grey = ndimage.gaussian_filter(grey, blur * samples, mode="nearest", truncate=4)
        pixels = grey.reshape(n, samples, n, samples).mean(axis=(1, 3))
        y0, y1, x0, x1 = max(top, 0), min(top + n, shape[0]), max(left, 0), min(left + n, shape[1])
        part = pixels[y0 - top : y1 - top, x0 - left : x1 - left]
        window = out[y0:y1, x0:x1]
        np.copyto(window, part, where=np.abs(part - around) > np.abs(window - around))
    if light is not None:
        rows, columns = np.mgrid[: shape[0], : shape[1]]
        out = out * light(columns, rows)
    if raw:
        return out
    if noise:
        assert rng is not None
        out = out + rng.normal(0, noise, shape)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)
