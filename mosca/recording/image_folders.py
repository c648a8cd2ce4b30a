"""A recording as other programs keep it: a folder of numbered images for each camera."""

from collections.abc import Callable
from pathlib import Path

import cv2

from mosca.data.frames import FrameSource
from mosca.errors import InputError


def write_image_folders(source: FrameSource, folder: Path, progress: Callable[[int], object] = id) -> int:
    """Write each frame of ``source`` as ``FOLDER/CAMERA/000012.png``, 12 its index; return how many.

    PNG keeps 8 and 16 bit images as they are, but no times: their reader needs a frame rate. Frames without an
    image are left out. ``progress`` is called with the number so far. InputError where a file cannot be written.
    """
    written = 0
    for info in source.cameras:
        (folder / info.name).mkdir(parents=True, exist_ok=True)
    for frame in source:
        if frame.image is None:
            continue
        path = folder / frame.camera / f"{frame.index:06d}.png"
        # encoded here, since cv2.imwrite does not report why it failed
        _, data = cv2.imencode(".png", frame.image)
        try:
            path.write_bytes(data.tobytes())
        except OSError as error:
            raise InputError(f"{path}: not written: {error.strerror}; make room, or choose another place") from error
        written += 1
        progress(written)
    return written
