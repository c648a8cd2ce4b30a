"""What free-running cameras see of points that move on sums of sinusoids, projected by the pinhole equations."""

from dataclasses import dataclass

import numpy as np
from rigs import looking_at

from mosca.continuous.association.frame_detections import CameraDetections
from mosca.data.frames import CameraInfo
from mosca.data.rig import Camera, OpenCVLens, Rig

FOCAL, WIDTH, HEIGHT = 700.0, 656, 491
POINTS, RATE_HZ, SIGMA_PX = 10, 50.0, 0.05
BEGIN_S = (0.0, 0.313, 0.127)
DRIFT = (0.0, 40e-6, -60e-6)
EPOCH_NS = (0, 5_000_000_000, -77_000_000_000)


def rig() -> Rig:
    """Three cameras 1.8 m from the middle, which they are aimed at."""
    lens = OpenCVLens(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    azimuths, heights = np.deg2rad([0.0, 75.0, 200.0]), (0.0, 0.3, 0.6)
    centres = [(1.8 * np.cos(a), 1.8 * np.sin(a), h) for a, h in zip(azimuths, heights, strict=True)]
    return Rig(tuple(Camera(f"c{k}", WIDTH, HEIGHT, lens, looking_at(c)) for k, c in enumerate(centres)))


@dataclass(frozen=True)
class Motion:
    """Points on sums of three sinusoids an axis, about 0.7 m/s."""

    seed: int = 3
    frequencies_hz: tuple[float, ...] = (0.4, 0.9, 1.3)

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Return (t, points, 3)."""
        random = np.random.default_rng(self.seed)
        size, phase = random.normal(0, 0.05, (3, POINTS, 3)), random.uniform(0, 2 * np.pi, (3, POINTS, 3))
        centre = random.uniform(-0.25, 0.25, (POINTS, 3))
        wave = [
            size[k] * np.sin(2 * np.pi * f * np.asarray(time_s)[:, None, None] + phase[k])
            for k, f in enumerate(self.frequencies_hz)
        ]
        return centre + sum(wave)


def pinhole(camera: Camera, xyz: np.ndarray) -> np.ndarray:
    v = (xyz - camera.world_from_camera.translation) @ camera.world_from_camera.rotation
    return FOCAL * v[..., :2] / v[..., 2:] + [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]


def as_detections(info: CameraInfo, frame_ns: np.ndarray, images, sigma_px: float) -> CameraDetections:
    """Return round detections of one size at the image points (k, 2) of each frame."""
    xy = np.concatenate(images)
    start = np.concatenate([[0], np.cumsum([len(image) for image in images])])
    covariance, each = np.tile(sigma_px**2 * np.eye(2), (len(xy), 1, 1)), np.ones(len(xy))
    return CameraDetections(
        info, frame_ns, start, xy, covariance, 6 * each, 200 * each, each, np.zeros(len(xy), np.uint8)
    )


def seen_by(
    camera: Camera, k: int, duration_s: float, own_clock: bool, motion: Motion = Motion(), rate_hz: float = RATE_HZ
) -> tuple[CameraDetections, np.ndarray, np.ndarray]:
    """Return what a camera saw, which point each image point is, and the true instants of its frames."""
    random = np.random.default_rng(10 + k)
    true_s = np.arange(BEGIN_S[k], duration_s, 1 / rate_hz)
    stamp = np.rint(true_s * (1 + DRIFT[k] * own_clock) * 1e9).astype(np.int64) + EPOCH_NS[k] * own_clock
    xy = pinhole(camera, motion.at(true_s)) + random.normal(0, SIGMA_PX, (len(true_s), POINTS, 2))
    rows, names = [], []
    for image in xy:
        order = random.permutation(POINTS)
        inside = [p for p in order if 0 < image[p, 0] < WIDTH - 1 and 0 < image[p, 1] < HEIGHT - 1]
        rows.append(image[inside])
        names.append(np.array(inside))
    info = CameraInfo(camera.name, WIDTH, HEIGHT, 8, rate_hz, "device" if own_clock else "session")
    return as_detections(info, stamp, rows, SIGMA_PX), np.concatenate(names), true_s


def session(
    duration_s: float = 3.0, own_clock: bool = True, motion: Motion = Motion(), rate_hz: float = RATE_HZ
) -> tuple[list[CameraDetections], list[np.ndarray], list[np.ndarray]]:
    found = [seen_by(camera, k, duration_s, own_clock, motion, rate_hz) for k, camera in enumerate(rig().cameras)]
    return [f[0] for f in found], [f[1] for f in found], [f[2] for f in found]
