"""A recording of numbered frames, camera by camera: image folders and videos alike."""

from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from typing import Protocol

from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, Frame
from mosca.errors import InputError
from mosca.recording.stamps import Stamp, Stamps


class Feed(Protocol):
    """One camera's numbered frames on disk."""

    @property
    def info(self) -> CameraInfo:
        """What is known of the camera."""
        ...

    def frames(self, first: int, last: int, stamps: Stamps) -> Generator[Frame]:
        """Yield exactly the frames ``first`` to ``last``, in order; lost ones with status dropped."""
        ...


class NumberedRecording:
    """A FrameSource that yields frame by number, and for each number camera by camera.

    Every camera has a frame of every number from the smallest to the largest of all cameras; one that is missing is
    ``dropped``, one that cannot be read ``corrupt``, each with a note that names it. ``notes``: irregularities of the
    recording as a whole.
    """

    def __init__(
        self, feeds: tuple[Feed, ...], first: int, last: int, stamps: Stamps, notes: tuple[str, ...] = ()
    ) -> None:
        self._feeds = feeds
        self._first = first
        self._last = last
        self._stamps = stamps
        self._running: set[ExitStack] = set()
        self._closed = False
        self.notes = notes

    @property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """What is known of each camera."""
        return tuple(feed.info for feed in self._feeds)

    @property
    def n_frames(self) -> int:
        """How many frames an iteration yields, lost ones included."""
        return (self._last - self._first + 1) * len(self._feeds)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames from the start; may be done again."""
        if self._closed:
            raise InputError("recording: it is closed; open it again")
        with ExitStack() as stack:
            self._running.add(stack)
            stack.callback(self._running.discard, stack)
            feeds = [
                stack.enter_context(closing(feed.frames(self._first, self._last, self._stamps)))
                for feed in self._feeds
            ]
            for frames in zip(*feeds, strict=True):
                yield from frames

    def close(self) -> None:
        """Free the files of every iteration that is under way; may be called twice."""
        self._closed = True
        for stack in tuple(self._running):
            stack.close()

    def __enter__(self) -> "NumberedRecording":
        """Return the recording itself."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Close it."""
        self.close()


def numbered_frame(camera: str, number: int, stamp: Stamp, image: Array | None, fault: str) -> Frame:
    """Return the frame of an image that was found (``fault`` empty), or of one that cannot be read."""
    if stamp.status != "ok":
        return Frame(camera, number, stamp.time_ns, stamp.exposure_ns, None, stamp.status, note="by frames.csv")
    status = "ok" if image is not None else "corrupt"
    return Frame(camera, number, stamp.time_ns, stamp.exposure_ns, image, status, note=fault)  # type: ignore[arg-type]


def dropped_frame(camera: str, number: int, stamp: Stamp, note: str) -> Frame:
    """Return the frame that represents a missing one."""
    return Frame(camera, number, stamp.time_ns, stamp.exposure_ns, None, "dropped", note=note)
