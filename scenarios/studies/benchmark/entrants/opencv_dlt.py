"""OpenCV: SimpleBlobDetector, undistortPoints, and linear triangulation of all cameras that see a target."""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from contract import Dataset, linear, projections, run, write_detections, write_points


def blobs(settings: dict[str, Any], diameter_px: float) -> Any:
    """Return the detector of bright blobs of a fifth to four times the area of a marker in the middle."""
    wanted = cv2.SimpleBlobDetector.Params()
    wanted.minThreshold, wanted.thresholdStep = settings["threshold"], settings["step"]
    wanted.maxThreshold, wanted.minRepeatability = 255, settings["repeatability"]
    wanted.filterByColor, wanted.blobColor, wanted.minDistBetweenBlobs = True, 255, 2
    area = np.pi / 4 * diameter_px**2
    wanted.filterByArea, wanted.minArea, wanted.maxArea = True, max(1.0, 0.2 * area), max(20.0, 4 * area)
    wanted.filterByCircularity = wanted.filterByInertia = wanted.filterByConvexity = False
    return cv2.SimpleBlobDetector.create(wanted)


def found(dataset: Dataset, settings: dict[str, Any]) -> Iterator[tuple[str, int, float, float]]:
    """Yield the blobs; no half pixel is added to the contours' moments, since positions refer to pixel centres."""
    detector = blobs(settings, dataset.about["marker_diameter_px"])
    zoom = settings["zoom"]
    for camera in dataset.names:
        read = lambda path: cv2.imread(path, cv2.IMREAD_GRAYSCALE)  # noqa: E731
        for frame, image in dataset.prepared(camera, read, settings["background"]):
            if zoom > 1:
                image = cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
            for key in detector.detect(image):
                yield camera, frame, *((np.array(key.pt) + 0.5) / zoom - 0.5).tolist()


def detect(dataset: Dataset, out: str, settings: dict[str, Any]) -> None:
    """Write the blobs of all images."""
    cv2.setNumThreads(1)
    write_detections(out, found(dataset, settings))


def triangulate(dataset: Dataset, out: str, settings: dict[str, Any], matched: str) -> None:
    """Write the points of targets whose images are known."""
    frame, places = dataset.read_matched(matched)
    flat = np.full(places.shape, np.nan)
    for c, (matrix, coefficients, _, _) in enumerate(dataset.matrices()):
        seen = np.isfinite(places[:, c, 0])
        if seen.any():
            flat[seen, c] = cv2.undistortPoints(places[seen, c][:, None], matrix, coefficients)[:, 0]
    cameras = projections(dataset)
    write_points(out, frame, np.array([linear(cameras, one) for one in flat]).reshape(-1, 3))


if __name__ == "__main__":
    run({"detect": detect, "triangulate": triangulate})
