"""Where a run's frames come from besides the twin: recordings, and sources that pass frames on."""

from collections.abc import Iterator
from pathlib import Path
from typing import Self

from mosca.data.frames import Frame, FrameSource
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.recording import RecordingWriter, open_recording


def recorded(source: str, rig: Rig) -> FrameSource:
    """Return the recording that ``--source recording:DIR`` names; InputError for another source."""
    kind, _, place = source.partition(":")
    if kind == "hardware":
        raise InputError(f"--source {source}: no camera driver is installed; use twin or recording:DIR")
    if kind != "recording" or not place:
        raise InputError(f"--source {source}: allowed are twin, recording:DIR and hardware:RIG.toml")
    return open_recording(Path(place), rig)


class PassedOn:
    """A source that passes another's frames on; closing it closes the other."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self.cameras = source.cameras

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._source)

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class Written(PassedOn):
    """A source whose frames are written down on their way through."""

    def __init__(self, source: FrameSource, writer: RecordingWriter) -> None:
        super().__init__(source)
        self._writer = writer

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._source:
            self._writer.write(frame)
            yield frame


class Chosen(PassedOn):
    """A source without the frames of cameras that the rig does not have: those that ride on the subject."""

    def __init__(self, source: FrameSource, names: tuple[str, ...]) -> None:
        super().__init__(source)
        self._names = frozenset(names)
        self.cameras = tuple(info for info in source.cameras if info.name in self._names)

    def __iter__(self) -> Iterator[Frame]:
        return (frame for frame in self._source if frame.camera in self._names)
