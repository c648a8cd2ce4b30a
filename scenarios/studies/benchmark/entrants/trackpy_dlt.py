"""trackpy: ``locate`` (Crocker and Grier's centroid), then OpenCV's undistortPoints and linear triangulation."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from contract import Dataset, run, write_detections
from opencv_dlt import triangulate


def found(dataset: Dataset, settings: dict[str, Any]) -> Iterator[tuple[str, int, float, float]]:
    """Yield the features: the diameter is odd and "a bit larger" than a marker's image, as in trackpy's guide.

    ``separation_scale`` 0: trackpy's own least separation, its diameter and 1 px, which loses markers side by side.
    """
    import trackpy

    trackpy.quiet()
    wanted = settings["diameter_scale"] * dataset.about["marker_diameter_px"] + 2
    odd = max(3, 2 * round((wanted - 1) / 2) + 1)
    separation = settings["separation_scale"] * dataset.about["marker_diameter_px"] or None
    for camera in dataset.names:
        read = lambda path: cv2.imread(path, cv2.IMREAD_GRAYSCALE)  # noqa: E731
        for frame, image in dataset.prepared(camera, read, settings["background"]):
            # without preprocessing the black level would count as light
            image = image if settings["preprocess"] else np.where(image > settings["threshold"], image, 0)
            features = trackpy.locate(
                image, odd, minmass=settings["minmass_per_px"] * np.pi / 4 * dataset.about["marker_diameter_px"] ** 2,
                threshold=settings["threshold"], preprocess=settings["preprocess"], engine="python",
                separation=separation,
            )  # fmt: skip
            for x, y in features[["x", "y"]].to_numpy():
                yield camera, frame, float(x), float(y)


def detect(dataset: Dataset, out: str, settings: dict[str, Any]) -> None:
    """Write the features of all images."""
    write_detections(out, found(dataset, settings))


if __name__ == "__main__":
    run({"detect": detect, "triangulate": triangulate})
