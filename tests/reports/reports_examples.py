"""A synthetic run for the tests of the package reports: cameras in a ring, markers on circles, known errors."""

from dataclasses import replace

import numpy as np
from rigs import ring

from mosca.data.detections import Detections
from mosca.data.rig import OpenCVLens, Rig
from mosca.data.tracks import Tracks
from reports.evidence import CameraView, ErrorTable, Evidence, MarkerCounts
from reports.record import Metric, MetricBlocks, RunRecord


def example_rig(n: int = 6) -> Rig:
    lens = OpenCVLens(800.0, 800.0, 327.5, 245.0, k1=-0.08)
    return ring(n, lens, radius_m=3.2, height_m=2.4, target=(0.0, 0.0, 0.9), names="cam{}")


def example_view(rng: np.random.Generator, camera: str = "cam0", n: int = 40) -> CameraView:
    height, width = 491, 656
    xy = rng.uniform((25, 25), (width - 25, height - 25), (n, 2))
    image = rng.normal(18, 2.2, (height, width))
    for x, y in xy:
        x0, y0 = int(x) - 8, int(y) - 8
        v, u = np.mgrid[y0 : y0 + 17, x0 : x0 + 17]
        image[y0 : y0 + 17, x0 : x0 + 17] += 190 * np.clip(4.5 - np.hypot(u - x, v - y), 0, 1)
    covariance = np.tile(0.02**2 * np.eye(2), (n, 1, 1))
    found = Detections(
        camera, xy + rng.normal(0, 0.02, xy.shape), covariance, np.full(n, 8.2), np.full(n, 210.0), np.ones(n)
    )
    return CameraView(camera, np.clip(image, 0, 255).astype(np.uint8), found, xy)


def example_evidence(seed: int = 3, frames: int = 120, markers: int = 8, views: int = 1) -> Evidence:
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / 100.0
    names = tuple(f"marker {i:02d}" for i in range(markers))
    phase, size = rng.uniform(0, 6.28, markers), rng.uniform(0.3, 0.9, markers)
    xyz = np.stack(
        [
            size * np.cos(1.1 * t[:, None] + phase),
            size * np.sin(1.1 * t[:, None] + phase),
            0.9 + 0.5 * size * np.sin(2.3 * t[:, None] + 2 * phase),
        ],
        axis=-1,
    )
    found = rng.random((frames, markers)) > np.linspace(0.0, 0.02, markers)
    rows, columns = np.nonzero(found)
    spread = (
        1e-4 * np.linspace(0.8, 1.6, markers)[columns] * (1 + 0.8 * np.linalg.norm(xyz[rows, columns, :2], axis=1))
    )
    error = rng.normal(0, 1, (len(rows), 3)) * spread[:, None]
    k = len(rows)
    tracks = Tracks(
        rows, np.round(1e9 * t[rows]), columns, np.array(names)[columns], xyz[rows, columns] + error,
        np.tile(1e-8 * np.eye(3), (k, 1, 1)), np.full(k, 4), np.abs(rng.normal(0, 0.03, k)), np.full(k, "measured"),
    )  # fmt: skip
    ghosts = (rng.random(frames) > 0.97).astype(int)
    return Evidence(
        example_rig(), np.array([0.0, 0.0, 0.9]), np.array([2.0, 2.0, 1.8]), tracks,
        tuple(example_view(rng, f"cam{i}") for i in range(views)),
        np.round(1e9 * t).astype(np.int64), xyz, names, np.full(markers, frames),
        ErrorTable(rows, t[rows], columns, error),
        MarkerCounts(t, np.full(frames, markers), found.sum(axis=1), ghosts),
    )  # fmt: skip


def without_truth(evidence: Evidence) -> Evidence:
    """Return what a real recording would have of ``evidence``."""
    return replace(
        evidence, truth_time_ns=None, truth_xyz=None, truth_names=(), marker_seen=None, errors=None, counts=None
    )


def example_record(**changes: object) -> RunRecord:
    blocks = MetricBlocks(tuple(1e-8 * (4 + i % 5) * 100 for i in range(20)), (100.0,) * 20)
    metrics = (
        Metric("position_rms", 2.45e-4, "m", 960, (2.3e-4, 2.6e-4), "none", 3e-4, "at_most", True, blocks),
        Metric("relative_accuracy", 1.22e-4, "1", 960, (1.15e-4, 1.3e-4), "none", 1e-4, "at_most", False),
        Metric("completeness", 0.9917, "1", 960, (0.985, 0.996), "none", 0.98, "at_least", True),
        Metric("ghosts_per_frame", 0.025, "1", 120, (0.0, 0.05), "none", 0.1, "at_most", True),
        Metric("reprojection_rms", 0.031, "px", 3840),
        Metric("frame_rate", 412.0, "1/s", 120),
    )
    fields: dict[str, object] = {
        "scenario": "accuracy/ring_of_six",
        "title": "Six cameras around a walking subject",
        "seed": 7,
        "source": "twin",
        "model_gap": "measured",
        "expect": "pass",
        "passed": True,
        "verdict": "every limit met",
        "metrics": metrics,
        "premises": {
            "views_per_marker": {"value": 4.2, "minimum": 2.0, "holds": True},
            "blur_px": {"value": 0.8, "maximum": 2.0, "holds": True},
        },
        "counts": {"frames": 720, "frame_sets": 120, "dropped": 0, "late": 2},
        "timings": {"render": 14.2, "pipeline": 0.31, "score": 0.05, "total": 14.9},
        "provenance": {"versions": {"mosca": "0.1.0", "numpy": "2.4"}, "platform": "Linux", "git": "abc1234"},
    }
    return RunRecord(**{**fields, **changes})  # type: ignore[arg-type]
