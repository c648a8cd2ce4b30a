"""Pose2Sim: weighted linear triangulation of image points whose correspondence is known.

The steps are those of ``Pose2Sim.triangulation.triangulate_all`` with ``undistort_points = true``: image positions go
through ``cv2.undistortPoints`` onto an undistorted pinhole camera, then ``triangulation_from_best_cameras`` leaves
cameras out while the reprojection error is above its threshold. Every likelihood is 1.
"""

from typing import Any

import cv2
import numpy as np
from contract import Dataset, run, write_points
from Pose2Sim.triangulation import triangulation_from_best_cameras


def triangulate(dataset: Dataset, out: str, settings: dict[str, Any], matched: str) -> None:
    """Write the points."""
    frame, places = dataset.read_matched(matched)
    flat = np.full(places.shape, np.nan)
    known: dict[str, list[Any]] = {"K": [], "dist": [], "R": [], "T": [], "optim_K": []}
    matrices = []
    for c, (camera, given) in enumerate(zip(dataset.cameras, dataset.matrices(), strict=True)):
        matrix, coefficients, rotation, shift = given
        size = (camera["width"], camera["height"])
        optimal = cv2.getOptimalNewCameraMatrix(matrix, coefficients, size, 1, size)[0]
        seen = np.isfinite(places[:, c, 0])
        if seen.any():
            flat[seen, c] = cv2.undistortPoints(places[seen, c][:, None], matrix, coefficients, None, optimal)[:, 0]
        for key, value in zip(
            known, (matrix, coefficients, cv2.Rodrigues(rotation)[0].ravel(), shift, optimal), strict=True
        ):
            known[key].append(value)
        matrices.append(optimal @ np.column_stack([rotation, shift]))
    config = {
        "triangulation": {
            "reproj_error_threshold_triangulation": settings["reproj_error_threshold_px"],
            "min_cameras_for_triangulation": 2,
            "undistort_points": True,
            "handle_LR_swap": False,
        }
    }
    xyz = np.full((len(frame), 3), np.nan)
    for k, place in enumerate(flat):
        likelihood = np.where(np.isfinite(place[:, 0]), 1.0, np.nan)
        one = place[:, 0], place[:, 1], likelihood
        if np.isfinite(likelihood).sum() >= 2:
            xyz[k] = triangulation_from_best_cameras(config, one, one, matrices, known)[0][:3]
    write_points(out, frame, xyz)


if __name__ == "__main__":
    run({"triangulate": triangulate})
