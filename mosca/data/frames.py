"""Frames, camera properties, and sources of frames.

A Frame contains only what a real camera provides: its own counter, its own clock's stamp, the pixels. True times,
jitter, identity and visibility belong to ``mosca.data.truth``.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, Protocol, Self, runtime_checkable

from mosca.data.arrays import Array, read_only_image

FrameStatus = Literal["ok", "dropped", "corrupt"]
StampEvent = Literal["exposure_start", "exposure_middle", "readout"]


@dataclass(frozen=True)
class CameraInfo:
    """Properties that a camera states before the first frame.

    ``bit_depth``: significant bits of a pixel (8, 10, 12 or 16). ``clock``: whose clock stamps the
    frames. ``frame_rate_hz``: the nominal rate of pulses (trigger) or of the free-running camera.
    """

    name: str
    width: int
    height: int
    bit_depth: int
    frame_rate_hz: float
    clock: Literal["device", "host", "session"] = "session"
    stamp_event: StampEvent = "exposure_start"

    @property
    def image_bytes(self) -> int:
        """Size of an image in memory [bytes]: one byte a pixel up to 8 bits, else two."""
        return self.width * self.height * (1 if self.bit_depth <= 8 else 2)


@dataclass(frozen=True, eq=False)
class Frame:
    """One exposure of one camera."""

    camera: str
    index: int
    """The camera's own frame counter."""
    time_ns: int
    """The camera's stamp of ``stamp_event``."""
    exposure_ns: int
    """Length of the exposure window."""
    image: Array | None
    """(H, W), uint8 or uint16, read-only; None where the frame was dropped or is corrupt."""
    status: FrameStatus = "ok"
    stamp_event: StampEvent = "exposure_start"
    row_time_ns: int = 0
    """Delay from one row's exposure to the next row's (0 for a global shutter)."""
    note: str = ""
    """For people: why a frame was dropped or is corrupt; for an ok frame, what is uncertain about it (``doubt``)."""
    rows: int = 0
    """Height of ``image``; without an image, the height known to the source (CameraInfo.height), else 0."""

    def __post_init__(self) -> None:
        if self.image is not None:
            object.__setattr__(self, "image", read_only_image(self.image))
            object.__setattr__(self, "rows", self.image.shape[0])
        if (self.status == "ok") != (self.image is not None):
            raise ValueError(
                f"frame {self.index} of {self.camera}: status {self.status} with an image of "
                f"{None if self.image is None else self.image.shape}"
            )

    @property
    def doubt(self) -> str:
        """What is not certain about the pulse or the time of a frame that is ok; "" where both are known."""
        return self.note if self.status == "ok" else ""


def mid_exposure_ns(frame: Frame) -> int:
    """Time of the middle of the frame's exposure window, in the clock that stamped it [ns].

    The image's intensity centroid belongs to this instant (for constant velocity exactly). With a
    rolling shutter it is the middle of the window of the image's central row. For a dropped or
    corrupt frame whose ``rows`` are unknown (0) it is the first row's, half a readout too early
    (with ``readout`` stamps: the last row's, half a readout too late).
    """
    half_readout = frame.row_time_ns * (frame.rows - 1) // 2 if frame.rows else 0
    if frame.stamp_event == "exposure_start":
        return frame.time_ns + frame.exposure_ns // 2 + half_readout
    if frame.stamp_event == "exposure_middle":
        return frame.time_ns
    return frame.time_ns - frame.exposure_ns // 2 - half_readout


@dataclass(frozen=True, eq=False)
class FrameSet:
    """The frames of one trigger pulse, one for each camera that delivered.

    ``pulse`` counts pulses from 0 at the first set; ``time_ns`` is the median mid-exposure of its
    frames, or the pulse's expected time where no frame came. ``frames`` maps camera name -> Frame;
    a camera that delivered nothing usable is absent.
    """

    pulse: int
    time_ns: int
    frames: Mapping[str, Frame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", MappingProxyType(dict(self.frames)))


@runtime_checkable
class FrameSource(Protocol):
    """Source of frames: common interface of twin, recording and hardware.

    Iterating yields Frames in order of arrival; per camera their indices rise. Iteration may be
    left early. ``close`` frees everything and may be called twice; ``with`` calls it.
    """

    @property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """Properties of each camera, in the order of the rig."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until the source ends."""
        ...

    def close(self) -> None:
        """Free devices, files and workers."""
        ...

    def __enter__(self) -> "FrameSource":
        """Return the source itself."""
        ...

    def __exit__(self, *exc: object) -> None:
        """Close the source."""
        ...


class WrappedSource:
    """A source that yields another's frames; closing it closes the other."""

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
