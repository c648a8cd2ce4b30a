"""The recordings to which a lab twin is fitted: ``KIND:FOLDER`` each, and sums over each camera's images."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from mosca.accuracy.lab_twin.frame_losses import FrameArrivals, arrived
from mosca.accuracy.lab_twin.pixel_statistics import PixelStatistics
from mosca.data.frames import CameraInfo, FrameSource
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.recording import open_recording

KINDS = {
    "dark": "caps on the lenses",
    "lit": "an even surface without targets, bright and not saturated",
    "static": "targets at rest",
    "moving": "a wand or a person with markers; needs --rig",
}
Progress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class LabRecording:
    """A recording and its kind."""

    kind: str
    folder: Path

    @property
    def given(self) -> str:
        """The recording as on the command line."""
        return f"{self.kind}:{self.folder}"


@dataclass(eq=False)
class CameraImages:
    """Sums over one camera's images of one recording."""

    info: CameraInfo
    pixels: PixelStatistics
    numbers: set[int] = field(default_factory=set)
    damaged: set[int] = field(default_factory=set)
    arrived: FrameArrivals | None = None


def parse_recording(text: str) -> LabRecording:
    """Return the recording that ``KIND:FOLDER`` names; InputError for another kind or no folder."""
    kind, colon, folder = text.partition(":")
    if not colon or kind not in KINDS or not folder:
        kinds = "; ".join(f"{name}: {what}" for name, what in KINDS.items())
        raise InputError(f"{text}: KIND:FOLDER is wanted, for example dark:lab/dark; kinds are {kinds}")
    if not Path(folder).exists():
        raise InputError(f"{text}: no such folder; a recording is a folder")
    return LabRecording(kind, Path(folder))


@contextmanager
def opened(one: LabRecording, rig: Rig | None, fps: float | None) -> Iterator[FrameSource]:
    """Yield the source of a recording's frames."""
    with open_recording(one.folder, rig, fps, times_matter=one.kind == "moving") as source:
        yield source


def image_sums(
    one: LabRecording, rig: Rig | None, fps: float | None, bits: int | None, progress: Progress | None = None
) -> dict[str, CameraImages]:
    """Return the sums over the images of a recording, by camera.

    ``bits``: significant bits of a pixel; None: those stated in the recording. InputError where it has no image.
    """
    with opened(one, rig, fps) as source:
        found = {
            info.name: CameraImages(info, PixelStatistics(info.height, info.width, bits or info.bit_depth))
            for info in source.cameras
        }
        total = getattr(source, "n_frames", None)
        for k, frame in enumerate(source):
            camera = found[frame.camera]
            if frame.image is not None:
                if frame.index not in camera.numbers:
                    camera.pixels.add(frame.image)
                camera.numbers.add(frame.index)
            elif frame.status == "corrupt":
                camera.damaged.add(frame.index)
            if progress is not None:
                progress(k + 1, total)
    if not any(camera.numbers for camera in found.values()):
        raise InputError(f"{one.given}: not one image could be read; look into the folder")
    what = arrived({n: c.numbers for n, c in found.items()}, {n: c.damaged for n, c in found.items()})
    for name, camera in found.items():
        camera.arrived = what[name]
    return found
