"""aniposelib: ``CameraGroup.triangulate`` or ``triangulate_ransac`` of image points whose correspondence is known."""

from typing import Any

import cv2
import numpy as np
from aniposelib.cameras import Camera, CameraGroup
from contract import Dataset, run, write_points


def group(dataset: Dataset) -> Any:
    """Return the cameras in aniposelib's form: OpenCV's five coefficients, rvec and tvec."""
    made = []
    for one, (matrix, coefficients, rotation, shift) in zip(dataset.cameras, dataset.matrices(), strict=True):
        made.append(
            Camera(
                matrix=matrix,
                dist=coefficients,
                size=(one["width"], one["height"]),
                rvec=cv2.Rodrigues(rotation)[0],
                tvec=shift,
                name=one["name"],
            )
        )
    return CameraGroup(made)


def triangulate(dataset: Dataset, out: str, settings: dict[str, Any], matched: str) -> None:
    """Write the points; the input has the shape (cameras, points, 2), as in the README."""
    frame, places = dataset.read_matched(matched)
    ask = getattr(group(dataset), settings["method"])
    given = ask(np.ascontiguousarray(places.transpose(1, 0, 2)), undistort=True)
    xyz = given[0] if isinstance(given, tuple) else given
    write_points(out, frame, np.asarray(xyz).reshape(-1, 3))


if __name__ == "__main__":
    run({"triangulate": triangulate})
