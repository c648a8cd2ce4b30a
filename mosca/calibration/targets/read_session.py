"""Sightings from the frames of a calibration session: every image is searched for the target's marks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import Protocol

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, FrameSet, FrameSource
from mosca.data.sightings import Part, Sightings
from mosca.errors import InputError
from mosca.synchronisation import assemble

Progress = Callable[[int], None]

SPREAD_SETS_BESIDE_OTHERS, SPREAD_SETS = 60, 300
"""Numbers of sets without the target, spread evenly over a recording, after which the recording is refused: the first
if other marks are seen in them, the second in any case. A target that is in 5 % (1 %) of the sets is missed by all
with 0.95^60 = 0.99^300 = 5 %, and never if one of its stretches is longer than 1/60 (1/300) of the recording."""


class MarkReader(Protocol):
    """Finds a target's marks in an image."""

    def read(self, image: Array, camera: str, bit_depth: int) -> Part:
        """Return what the image (H, W) shows; ``camera`` and ``frame`` of the part are set by the caller."""
        ...

    def seen_instead(self) -> str:
        """Return what images without the target show, "; ..." in words; "" where that is not known."""
        ...

    def advice(self) -> str:
        """Return what the target file should say by what the images show, "; ..." in words; "" where all is well."""
        ...

    def sees_others(self) -> bool:
        """Return whether an image without the target has shown marks of another; False where that is not known."""
        ...


def check_shown(
    source: FrameSource,
    reader: Callable[[], MarkReader],
    n_frames: int | None,
    every: int = 1,
    progress: Progress | None = None,
) -> None:
    """Raise InputError where sets that are spread over a long recording show nothing of the target.

    ``source`` is read up to the first set that shows it, and can be read again; ``reader`` makes a reader.
    ``n_frames``: of all cameras in the source, None where unknown. A recording of less than twice as many sets as
    are examined, or of unknown length, is not checked: reading all of it gives the same answer.
    """
    infos = source.cameras
    sets = 0 if n_frames is None else n_frames // len(infos) // max(every, 1)
    for count in (SPREAD_SETS_BESIDE_OTHERS, SPREAD_SETS):
        if sets < 2 * count:
            return
        looking, examined = reader(), 0
        for frame_set in islice(assemble(source, infos), 0, None, every * (sets // count)):
            if any(len(part.mark) for part in _parts(frame_set, infos, looking, examined)):
                return
            examined += 1
            if progress is not None:
                progress(examined)
        if looking.sees_others() or count == SPREAD_SETS:
            raise _nothing_shown(f"{examined} frame sets spread over {sets}", infos, looking)


def read_sightings(
    source: FrameSource, reader: MarkReader, every: int = 1, progress: Progress | None = None
) -> Sightings:
    """Return the sightings of a target in the frame sets of a source; each ``every``-th set is examined.

    ``progress`` is called with the number of sets read. InputError where no image shows anything.
    """
    if every < 1:
        raise InputError(f"every = {every} given; a whole number from 1 is wanted")
    infos = source.cameras
    sizes = np.array([(info.width, info.height) for info in infos])
    parts: list[Part] = []
    frames = 0
    for number, frame_set in enumerate(islice(assemble(source, infos), 0, None, every)):
        frames = number + 1
        parts += _parts(frame_set, infos, reader, number)
        if progress is not None:
            progress(frames)
    sightings = Sightings.joined(tuple(info.name for info in infos), sizes, frames, parts)
    if len(sightings) == 0:
        raise _nothing_shown(f"{frames} frame sets", infos, reader)
    return sightings


def _parts(frame_set: FrameSet, infos: Sequence[CameraInfo], reader: MarkReader, number: int) -> Iterator[Part]:
    """Yield the marks that each image of a set shows; ``number``: of the set."""
    for camera, info in enumerate(infos):
        frame = frame_set.frames.get(info.name)
        if frame is None or frame.image is None:
            continue
        seen = reader.read(frame.image, info.name, info.bit_depth)
        yield replace(seen, camera=camera, frame=number)


def _nothing_shown(looked: str, infos: Sequence[CameraInfo], reader: MarkReader) -> InputError:
    shown = reader.seen_instead() + reader.advice()
    return InputError(
        f"0 of {looked} of {', '.join(info.name for info in infos)} show the target{shown}; check the target "
        "file, exposure and focus (the marks need contrast and a few pixels)"
    )
