"""A camera's images in a folder, numbered by the digits at the end of their names."""

import re
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

from mosca.data.arrays import Array
from mosca.data.files.bounded import MOST_IMAGE_BYTES, read_bytes
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera
from mosca.errors import InputError
from mosca.recording.image_sequence import dropped_frame, numbered_frame
from mosca.recording.images import IMAGE_SUFFIXES, decode_image
from mosca.recording.stamps import Stamps

_NUMBER = re.compile(r"([0-9]{1,18})$")


@dataclass(frozen=True)
class FolderFeed:
    """One camera's numbered image files."""

    info: CameraInfo
    folder: Path
    files: dict[int, Path]

    def frame_numbers(self) -> set[int]:
        """Return the numbers of the images that are there."""
        return set(self.files)

    def frames(self, first: int, last: int, stamps: Stamps) -> Generator[Frame]:
        """Yield the frames ``first`` to ``last``: a missing number is dropped, an unreadable file corrupt."""
        name = self.info.name
        for number in range(first, last + 1):
            stamp = stamps.of(name, number)
            path = self.files.get(number)
            if path is None:
                yield dropped_frame(name, number, stamp, f"no image {number} in {self.folder}")
            elif stamp.status != "ok":
                yield numbered_frame(name, number, stamp, None, "")
            else:
                image, fault = read_image(path)
                size = None if image is None else (image.shape[1], image.shape[0])
                if size is not None and size != (self.info.width, self.info.height):
                    wanted = f"{self.info.width}x{self.info.height}"
                    image, fault = None, f"{path}: {size[0]}x{size[1]} px, the others are {wanted}"
                yield numbered_frame(name, number, stamp, image, fault)


def read_image(path: Path) -> tuple[Array | None, str]:
    """Return the mono image in ``path`` and "", or None and a note that names the file and the fault."""
    try:
        image, fault = decode_image(read_bytes(path, MOST_IMAGE_BYTES))
    except OSError as error:
        return None, f"{path}: {error.strerror}"
    return image, f"{path}: {fault}" if fault else ""


def numbered_images(folder: Path) -> dict[int, Path]:
    """Return number -> image file of ``folder``, rising; files without a number at the end are left out.

    Raises InputError where two files have the same number.
    """
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = _number(path)
        if number is None:
            continue
        same = files.setdefault(number, path)
        if same is not path:
            raise InputError(
                f"{folder}: '{same.name}' and '{path.name}' are both number {number}; "
                "keep one series of images in a folder"
            )
    return dict(sorted(files.items()))


def has_numbered_images(folder: Path) -> bool:
    """Return whether ``folder`` holds an image whose name ends with a number."""
    return any(_number(path) is not None for path in folder.iterdir())


def _number(path: Path) -> int | None:
    number = _NUMBER.search(path.stem)
    if number is None or path.suffix.lower() not in IMAGE_SUFFIXES or path.name.startswith("."):
        return None
    return int(number[1])


def folder_feed(name: str, folder: Path, camera: Camera | None, rate_hz: float) -> FolderFeed:
    """Return the feed of the images in ``folder`` for the camera called ``name``.

    The image size and depth are those of the first image that can be read. Raises InputError where that is
    not the size of the rig's ``camera``, and where no image can be read.
    """
    files = numbered_images(folder)
    fault = ""
    for path in files.values():
        image, note = read_image(path)
        if image is not None:
            height, width = image.shape
            check_size(path, (width, height), camera)
            depth = 8 * image.dtype.itemsize
            return FolderFeed(CameraInfo(name, width, height, depth, rate_hz), folder, files)
        fault = fault or note
    raise InputError(f"{folder}: none of its {len(files)} images can be read; the first: {fault}")


def check_size(path: Path, size: tuple[int, int], camera: Camera | None) -> None:
    """Raise InputError where pictures (width, height) are not of the size of the rig's ``camera``."""
    if camera is not None and size != (camera.width, camera.height):
        raise InputError(
            f"{path}: {size[0]}x{size[1]} px, but the rig's camera '{camera.name}' is "
            f"{camera.width}x{camera.height}; use the rig that belongs to these images"
        )
