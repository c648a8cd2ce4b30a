"""From the frames of a calibration session to sightings: every image is read for the target's marks."""

from collections.abc import Callable
from itertools import islice
from typing import Protocol

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import FrameSource
from mosca.data.sightings import Part, Sightings
from mosca.errors import InputError
from mosca.synchronisation import assemble

Progress = Callable[[int], None]


class MarkReader(Protocol):
    """Finds a target's marks in an image."""

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return what the image (H, W) shows; ``camera`` and ``frame`` of the part are set by the caller."""
        ...

    def seen_instead(self) -> str:
        """Return what images without the target show, "; ..." in words; "" where that is not known."""
        ...


def read_sightings(
    source: FrameSource, reader: MarkReader, every: int = 1, progress: Progress | None = None
) -> Sightings:
    """Return what the frame sets of a source show of a target; each ``every``-th set is examined.

    ``progress`` is called with the number of sets read. InputError where no image shows anything.
    """
    if every < 1:
        raise InputError(f"every = {every} given; a whole number from 1 is wanted")
    infos = source.cameras
    names = tuple(info.name for info in infos)
    sizes = np.array([(info.width, info.height) for info in infos])
    parts: list[Part] = []
    frames = 0
    for number, frame_set in enumerate(islice(assemble(source, infos), 0, None, every)):
        frames = number + 1
        for camera, info in enumerate(infos):
            frame = frame_set.frames.get(info.name)
            if frame is None or frame.image is None:
                continue
            seen = reader.read(frame.image, info.name, info.bit_depth)
            parts.append(Part(camera, number, seen.mark, seen.xy_px, seen.covariance_px2, seen.diameter_px))
        if progress is not None:
            progress(frames)
    sightings = Sightings.joined(names, sizes, frames, parts)
    if len(sightings) == 0:
        raise InputError(
            f"0 of {frames} frame sets of {', '.join(names)} show the target{reader.seen_instead()}; check the "
            "target file, exposure and focus (the marks need contrast and a few pixels)"
        )
    return sightings
