"""A few discs that move before four cameras, as frames of numpy arrays: no renderer, no truth but the projection."""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from rigs import ring

from mosca.camera.projection import project
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import OpenCVLens

SIZE = (320, 240)
RATE = 50.0
NAMES = ("a1", "a2", "b1", "b2")


def rig(names=NAMES, size=SIZE):
    """Cameras on a ring, looking at the origin."""
    f = 1.1 * size[0]
    lens = OpenCVLens(f, f, (size[0] - 1) / 2, (size[1] - 1) / 2)
    return ring(len(names), lens, radius_m=2.5, size=size, names=names)


def points(pulse, rate=RATE, count=5):
    """Positions (n, 3) [m] at a pulse."""
    k = np.arange(count)
    turn = 2 * np.pi * (k / count + 0.2 * pulse / rate)
    return np.column_stack(
        [0.4 * np.cos(turn), 0.4 * np.sin(turn), 0.12 * k * (5 / count) - 0.25 + 0.05 * np.sin(3 * turn)]
    )


def image(camera, pulse, rate=RATE, count=5, radius_px=3.0, cut=None):
    """A dark image with soft-edged discs; noise from camera and pulse.

    ``cut``: discs are of one size, with this radius 2.5 m away; True: something hides the left of the first.
    """
    rng = np.random.default_rng([pulse, sum(camera.name.encode())])
    grey = 4 + 1.0 * rng.standard_normal((camera.height, camera.width))
    places = points(pulse, rate, count)
    away_m = np.linalg.norm(places - camera.world_from_camera.translation, axis=1)
    for k, (x, y) in enumerate(project(camera, places)):
        if not (8 < x < camera.width - 9 and 8 < y < camera.height - 9):
            continue
        x0, y0 = int(x) - 7, int(y) - 7
        yy, xx = np.mgrid[y0 : y0 + 15, x0 : x0 + 15]
        away = np.hypot(xx - x, yy - y)
        radius = radius_px if cut is None else radius_px * 2.5 / away_m[k]
        seen = 1 / (1 + np.exp((x - 1.0 - xx) / 0.35)) if cut and k == 0 else 1.0
        grey[y0 : y0 + 15, x0 : x0 + 15] += 190 * seen / (1 + np.exp((away - radius) / 0.35))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


class Scene:
    """Frames of some cameras; ``faults`` maps (camera, pulse) -> "dropped" or "corrupt".

    ``cut``: names of cameras in whose images the left of a disc is hidden; all discs are of one size then.
    """

    def __init__(self, cameras, pulses, rate=RATE, faults=None, cut=None):
        self._cameras, self._pulses, self._rate, self._faults = cameras, pulses, rate, faults or {}
        self._cut = cut
        self.cameras = tuple(CameraInfo(c.name, c.width, c.height, 8, rate) for c in cameras)

    def __iter__(self):
        for pulse in range(self._pulses):
            for camera in self._cameras:
                status = self._faults.get((camera.name, pulse), "ok")
                cut = None if self._cut is None else camera.name in self._cut
                picture = image(camera, pulse, self._rate, cut=cut) if status == "ok" else None
                yield Frame(camera.name, pulse, round(pulse * 1e9 / self._rate), 500_000, picture, status)

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()
