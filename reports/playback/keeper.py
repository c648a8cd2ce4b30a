"""Data that a run keeps for its page: small images of some frame sets, and the cameras that measured each point."""

import io
from collections.abc import Mapping

import numpy as np
from PIL import Image

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.tracks import Points
from reports.evidence import KeptImage, KeptSet, MeasuredBy
from reports.images import block_maxima, stretched

MOST_SETS = 40
"""Frame sets whose images are kept."""
VIEW_AT = 0.4
"""Instant at which a page begins and the pictures of the cameras are taken, as a share of the run's length."""
MOST_FRAMES = 500
"""Most instants of the page; longer runs show every second, third ... frame."""
LONGEST_PX = 720
"""Longest side of a kept image; targets of a few pixels survive, since it is thinned by block maxima."""
QUALITY = 45
"""Quality of WebP, 1 to 100: with this one targets stay sharp, and an image takes 1 to 20 kB."""
SEARCHED = 0
"""Effort of WebP's search for a small file, 0 to 6 (OpenCV's 4: 25 ms an image, 34 kB; 0: 7 ms, 32 kB)."""


class PageKeeper:
    """Collects images and rays of a running pipeline; ``attend`` takes each frame set.

    ``pulses``: number in the run. ``cameras``: number in the rig, in the order of the columns of ``Points.rays``; 0
    where these are not the rig's. ``images``: whether images are kept.
    """

    def __init__(self, pulses: int, cameras: int, images: bool = True) -> None:
        shown = np.unique(np.linspace(0, max(pulses - 1, 0), MOST_SETS).round().astype(int))
        self._image_pulses = set(shown.tolist()) if images else set()
        self._stride, self._cameras = frame_stride(pulses), cameras
        self._sets: dict[int, KeptSet] = {}
        self._frames: list[Array] = []
        self._xyz: list[Array] = []
        self._used: list[Array] = []

    def attend(
        self, pulse: int, images: Mapping[str, Array | None], detections: Mapping[str, Detections], points: Points
    ) -> None:
        """Keep the data of one frame set that the page shows."""
        if pulse in self._image_pulses:
            kept = [kept_image(image, detections[name]) for name, image in images.items() if image is not None]
            if kept:
                self._sets[pulse] = KeptSet(pulse, tuple(kept))
        if pulse % self._stride == 0 and self._cameras and len(points):
            self._frames.append(np.full(len(points), pulse))
            self._xyz.append(points.xyz)
            self._used.append(points.rays[:, : self._cameras] >= 0)

    def sets(self) -> tuple[KeptSet, ...]:
        """Return the kept images, by pulse."""
        return tuple(self._sets[pulse] for pulse in sorted(self._sets))

    def measured_by(self) -> MeasuredBy | None:
        """Return the cameras that measured each point at the instants of the page; None where unknown."""
        if not self._frames:
            return None
        return MeasuredBy(np.concatenate(self._frames), np.concatenate(self._xyz), np.concatenate(self._used))


def frame_stride(frames: int) -> int:
    """Return n so that every n-th of ``frames`` is on the page: 1, or more where there are over ``MOST_FRAMES``."""
    return max(1, -(-frames // MOST_FRAMES))


def kept_image(image: Array, found: Detections) -> KeptImage:
    """Return a small copy of ``image`` (H, W) uint8 or uint16 with the detections in it."""
    height, width = image.shape
    factor = max(1, -(-max(height, width) // LONGEST_PX))
    small = block_maxima(image, factor)
    # the result is the same for all pixels of one value: a table of values takes a tenth of the time
    counts = np.bincount(small.ravel())
    median = float(np.searchsorted(np.cumsum(counts), small.size / 2))
    table = np.round(255 * stretched(np.arange(len(counts)), 0.5 * median)).astype(np.uint8)
    Image.fromarray(table[small]).save(file := io.BytesIO(), "WEBP", quality=QUALITY, method=SEARCHED)
    return KeptImage(found.camera, file.getvalue(), (width, height), found.xy_px, found.diameter_px)
