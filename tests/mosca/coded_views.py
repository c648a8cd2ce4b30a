"""Coded targets rendered by brute force for the tests: every pixel is the mean of many samples.

Shares only the table of code numbers with the code under test and the twin: rays of a pinhole camera meet
the plate's plane, where the print is evaluated in polar coordinates.
"""

from dataclasses import dataclass

import numpy as np
from pixel_parts import averaged
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
    radius2 = x * x + y * y
    white = (radius2 < 1).astype(float)
    ring = (radius2 > 4) & (radius2 < 9)
    angle = np.arctan2(y[ring], x[ring]) % (2 * np.pi)
    white[ring] = np.array(bits)[np.minimum((angle / (2 * np.pi / 20)).astype(int), 19)]
    white[(np.abs(x) > 4) | (np.abs(y) > 4)] = np.nan
    return white


def on_plate(view: View, px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays through image points, relative to the image of the plate's centre [px], meet the plate."""
    f, turn = view.dot_px / 2 * view.z, view.rotation
    depth = view.z * turn[2, 2] / (turn[0, 2] / f * px + (turn[1, 2] / f * py + turn[2, 2]))
    x, y = (depth * (turn[0, k] / f * px + (turn[1, k] / f * py + turn[2, k])) - view.z * turn[2, k] for k in (0, 1))
    return x, y


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
        # a corner of the plate that leans towards the camera is nearer to it
        nearer = 1 / (1 - 4 * np.sqrt(2) * np.sin(view.tilt) / view.z)
        reach = int(np.ceil(2.9 * view.dot_px * nearer + 5 * blur + 2))
        left, top = round(view.xy[0]) - reach, round(view.xy[1]) - reach
        n = 2 * reach + 1
        fine = (np.arange(n * samples) + 0.5) / samples - 0.5
        plate_x, plate_y = on_plate(view, fine + left - view.xy[0], (fine + top - view.xy[1])[:, None])
        bits = code_bits(view.number) if view.bits is None else view.bits
        grey = black + (white - black) * printed(bits, plate_x, plate_y)
        grey[np.isnan(grey)] = around
        if hide is not None:
            hidden = hide(plate_x, plate_y)
            grey = np.where(np.isnan(hidden), grey, np.nan_to_num(hidden))
        pixels = averaged(grey, samples, blur, mode="nearest", truncate=4)
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
