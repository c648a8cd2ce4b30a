"""A FrameSource of numpy arrays: each image is different and known in advance."""

from collections.abc import Iterator

import numpy as np

from mosca.data.frames import CameraInfo, Frame

RATE_HZ = 100.0
EXPOSURE_NS = 1_000_000


def picture(camera: int, number: int, shape: tuple[int, int], depth: int = 8) -> np.ndarray:
    """Return the image of frame ``number``: noise, unique for camera and number."""
    kind = np.uint8 if depth == 8 else np.uint16
    return np.random.default_rng([camera, number]).integers(0, 2**depth, shape, kind)


class ArraySource:
    """``frames`` frames of ``cameras`` cameras, "cam0" and on.

    ``troubles``: (camera, number) -> "dropped" or "corrupt".
    """

    def __init__(
        self,
        cameras: int = 1,
        frames: int = 50,
        shape: tuple[int, int] = (48, 64),
        depth: int = 8,
        rate_hz: float = RATE_HZ,
        troubles: dict[tuple[int, int], str] | None = None,
    ) -> None:
        self.shape, self.depth, self.frames = shape, depth, frames
        self.cameras = tuple(CameraInfo(f"cam{k}", shape[1], shape[0], depth, rate_hz) for k in range(cameras))
        self._period_ns = round(1e9 / rate_hz)
        self._troubles = troubles or {}
        self.iterations = 0

    def __iter__(self) -> Iterator[Frame]:
        self.iterations += 1
        for number in range(self.frames):
            for k, info in enumerate(self.cameras):
                status = self._troubles.get((k, number), "ok")
                image = picture(k, number, self.shape, self.depth) if status == "ok" else None
                time_ns = number * self._period_ns
                yield Frame(info.name, number, time_ns, EXPOSURE_NS, image, status)

    def close(self) -> None:
        pass

    def __enter__(self) -> "ArraySource":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
