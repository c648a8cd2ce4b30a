"""mosca with default settings: ``mosca.reconstruct``; with given correspondence, its detections and ``triangulate``.

The covariances are those stated by its detections, which ``mosca.match`` and ``mosca.reconstruct`` use as weights.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from contract import COVARIANCE, PLACE, Dataset, run, write_detections, write_points

import mosca
from mosca.pipeline import run as run_pipeline


def rig_of(dataset: Dataset) -> mosca.Rig:
    """Return the cameras of ``cameras.json``."""
    cameras = []
    for one, (_, _, rotation, shift) in zip(dataset.cameras, dataset.matrices(), strict=True):
        lens = mosca.OpenCVLens(
            one["fx"], one["fy"], one["cx"], one["cy"], one["k1"], one["k2"], one["p1"], one["p2"], one["k3"]
        )
        pose = mosca.Pose(rotation.T, -rotation.T @ shift)
        cameras.append(mosca.Camera(one["name"], one["width"], one["height"], lens, pose))
    return mosca.Rig(tuple(cameras))


def points(dataset: Dataset, out: str, settings: dict[str, Any]) -> None:
    """Write the measured samples of all tracks."""
    tracks = mosca.reconstruct(dataset.folder / "images", rig_of(dataset))
    measured = np.asarray(tracks.status) == "measured"
    write_points(out, np.asarray(tracks.frame)[measured], np.asarray(tracks.xyz)[measured])


def found(dataset: Dataset) -> Iterator[tuple[str | int | float, ...]]:
    """Yield the detections of the pipeline and their covariances."""
    rig = rig_of(dataset)
    with mosca.open_recording(dataset.folder / "images", rig, None) as source:
        for step in run_pipeline(source, rig):
            for camera, seen in step.detections.items():
                for (u, v), ((uu, uv), (_, vv)) in zip(
                    seen.xy_px.tolist(), seen.covariance_px2.tolist(), strict=True
                ):
                    yield camera, step.frame_set.pulse, u, v, uu, uv, vv


def detect(dataset: Dataset, out: str, settings: dict[str, Any]) -> None:
    """Write all detections."""
    write_detections(out, found(dataset), COVARIANCE)


def triangulate(dataset: Dataset, out: str, settings: dict[str, Any], matched: str) -> None:
    """Write the points of targets whose images are known."""
    frame, table = dataset.read_matched(matched, (*PLACE, *COVARIANCE))
    images = {name: table[:, c, :2] for c, name in enumerate(dataset.names)}
    covariances = {name: table[:, c][:, [[2, 3], [3, 4]]] for c, name in enumerate(dataset.names)}
    write_points(out, frame, mosca.triangulate(rig_of(dataset), images, covariances_px2=covariances).xyz)


if __name__ == "__main__":
    run({"points": points, "detect": detect, "triangulate": triangulate})
