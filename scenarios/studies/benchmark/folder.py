"""A data set as plain files, written and read; the format is described in ``docs/benchmark.md``.

``NAME/`` is the input of an entrant: ``dataset.json``, ``cameras.json``, ``images/CAMERA/000000.png``,
``images/frames.csv``, ``calibration/points.csv``. Only scoring reads ``truth/NAME/``: ``points.csv`` and
``images.csv``.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from mosca.camera.projection import project
from mosca.data.arrays import Array
from mosca.data.files.bounded import parse_json, read_text
from mosca.data.files.toml import Positive, Table, Vector, check
from mosca.data.files.whole_file import write_text
from mosca.data.rig import OpenCVLens, Rig
from mosca.data.truth import Truth
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import integers, parsed, read_columns, reals, write_columns

FORMAT = 1
"""Version of the folder's format."""
POINTS = ("frame", "time_ns", "label", "x", "y", "z")
IMAGES = ("frame", "label", "camera", "u", "v", "visible", "diameter_px")
CALIBRATION = ("camera", "x", "y", "z", "u", "v")
FRAMES = ("frame", "camera", "time_ns", "exposure_ns", "status")
GRID = 7
"""Points of the calibration list along each edge of the volume."""
CALIBRATION_SIGMA_PX = 0.02
"""Noise of its image coordinates, that of good centroids of a test field [px]."""
LENS = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, eq=False)
class MadeSet:
    """A data set before it is written: its rig with OpenCV's lenses, its truth, its description."""

    name: str
    title: str
    made_by: str
    seed: int
    rig: Rig
    truth: Truth
    frame_rate_hz: float
    exposure_s: float
    volume_m: tuple[tuple[float, float, float], tuple[float, float, float]]
    marker_diameter_m: float


def write_set(made: MadeSet, data: Path) -> None:
    """Write all files of a set, except its images, below ``data``."""
    folder, truth = data / made.name, made.truth
    for part in ("images", "calibration"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    (data / "truth" / made.name).mkdir(parents=True, exist_ok=True)
    seen = truth.visible > 0.5
    about = {
        "format": FORMAT,
        "name": made.name,
        "title": made.title,
        "made_by": made.made_by,
        "seed": made.seed,
        "frames": len(truth.time_ns),
        "frame_rate_hz": made.frame_rate_hz,
        "exposure_s": made.exposure_s,
        "bits": 8,
        "volume_m": made.volume_m,
        "marker_diameter_m": made.marker_diameter_m,
        "marker_diameter_px": round(float(np.median(truth.diameter_px[seen])), 2),
    }
    write_text(folder / "dataset.json", json.dumps(about, indent=1) + "\n")
    write_text(folder / "cameras.json", json.dumps({"cameras": _cameras(made.rig)}, indent=1) + "\n")
    _write_frames(made, folder / "images" / "frames.csv")
    _write_calibration(made, folder / "calibration" / "points.csv")
    _write_truth(truth, data / "truth" / made.name)


def _cameras(rig: Rig) -> list[dict[str, Any]]:
    """Return the cameras in OpenCV's terms: ``x_camera = R x_world + t``."""
    cameras = []
    for camera in rig.cameras:
        lens, pose = camera.lens, camera.world_from_camera.inverse()
        assert isinstance(lens, OpenCVLens)
        one = {"name": camera.name, "width": camera.width, "height": camera.height}
        one |= {"fx": lens.fx_px, "fy": lens.fy_px, "cx": lens.cx_px, "cy": lens.cy_px}
        one |= {key: getattr(lens, key) for key in LENS}
        cameras.append(one | {"R": np.asarray(pose.rotation).tolist(), "t": np.asarray(pose.translation).tolist()})
    return cameras


def _write_frames(made: MadeSet, path: Path) -> None:
    rows: list[tuple[str, ...]] = []
    half = round(made.exposure_s * 5e8)
    for frame, time_ns in enumerate(made.truth.time_ns.tolist()):
        for name in made.rig.names:
            rows.append((str(frame), name, str(time_ns - half), str(2 * half), "ok"))
    write_columns(path, FRAMES, list(zip(*rows, strict=True)))


def _write_calibration(made: MadeSet, path: Path) -> None:
    """Write a list of known points and their images with noise, as from a test field that fills the volume."""
    rng = np.random.default_rng([made.seed, 7])
    low, high = np.array(made.volume_m)
    steps = np.stack(np.meshgrid(*[np.linspace(0, 1, GRID)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = low + steps * (high - low)
    columns: list[list[str]] = [[] for _ in CALIBRATION]
    for camera in made.rig.cameras:
        places = project(camera, points)
        places = places + rng.normal(0.0, CALIBRATION_SIGMA_PX, places.shape)
        inside = ((places >= 0) & (places <= (camera.width - 1, camera.height - 1))).all(axis=1)
        columns[0] += [camera.name] * int(inside.sum())
        for column, values in zip(columns[1:], (*points[inside].T, *places[inside].T), strict=True):
            column += reals(values)
    write_columns(path, CALIBRATION, columns)


def _write_truth(truth: Truth, folder: Path) -> None:
    frames, markers, cameras = truth.visible.shape
    frame, marker = (axis.ravel() for axis in np.indices((frames, markers)))
    write_columns(
        folder / "points.csv",
        POINTS,
        [
            integers(frame),
            integers(truth.time_ns[frame]),
            [truth.names[m] for m in marker],
            *(reals(truth.xyz[frame, marker, k]) for k in range(3)),
        ],
    )
    frame, marker, camera = (axis.ravel() for axis in np.indices((frames, markers, cameras)))
    write_columns(
        folder / "images.csv",
        IMAGES,
        [
            integers(frame),
            [truth.names[m] for m in marker],
            [truth.cameras[c] for c in camera],
            *(reals(truth.image_xy_px[frame, marker, camera, k]) for k in range(2)),
            reals(truth.visible[frame, marker, camera]),
            reals(truth.diameter_px[frame, marker, camera]),
        ],
    )


class AboutSet(Table):
    """``dataset.json``."""

    format: Literal[1]
    name: str
    title: str
    made_by: str
    seed: int
    frames: int = Field(ge=1)
    frame_rate_hz: Positive
    exposure_s: Positive
    bits: int
    volume_m: tuple[Vector, Vector]
    marker_diameter_m: Positive
    marker_diameter_px: Positive


def read_about(path: Path) -> AboutSet:
    """Return the contents of ``dataset.json``; InputError names file, key, value and what is allowed."""
    try:
        document = parse_json(read_text(path, "a data set's dataset.json"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: no JSON: {error}") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: holds a {type(document).__name__}; a table of keys is wanted")
    return check(AboutSet, document, path)


def read_set_truth(folder: Path) -> Truth:
    """Return the truth in ``points.csv`` and ``images.csv`` of a ``truth/NAME`` folder.

    InputError names file and row of unusable values.
    """
    path = folder / "points.csv"
    cells = read_columns(path, POINTS, "benchmark's true points")
    images_path = folder / "images.csv"
    images = read_columns(images_path, IMAGES, "benchmark's true images")
    names, cameras = tuple(dict.fromkeys(cells["label"])), tuple(dict.fromkeys(images["camera"]))
    frame = parsed(cells["frame"], "frame", int, path)
    count = len(frame) // max(len(names), 1)
    if len(names) == 0 or not np.array_equal(frame, np.repeat(np.arange(count), len(names))):
        raise InputError(f"{path}: frames 0, 1, ... with the same markers each, in order, are wanted")
    if tuple(cells["label"]) != names * count:
        raise InputError(f"{path}: the same markers in the same order in each frame are wanted")
    shape = (count, len(names), len(cameras))
    wanted = [(str(f), n, c) for f in range(count) for n in names for c in cameras]
    if list(zip(images["frame"], images["label"], images["camera"], strict=True)) != wanted:
        raise InputError(
            f"{images_path}: one row for each frame, marker and camera, in the order of points.csv, is wanted"
        )
    time_ns = parsed(cells["time_ns"], "time_ns", int, path).reshape(shape[:2])[:, 0]
    if (np.diff(time_ns) <= 0).any():
        raise InputError(f"{path}: time_ns must rise from frame to frame")
    columns = _numbers(images, ("u", "v", "visible", "diameter_px"), images_path)
    return Truth(
        time_ns=time_ns,
        names=names,
        xyz=np.stack(_numbers(cells, ("x", "y", "z"), path), axis=1).reshape(*shape[:2], 3),
        visible=columns[2].reshape(shape),
        cameras=cameras,
        image_xy_px=np.stack(columns[:2], axis=1).reshape(*shape, 2),
        diameter_px=columns[3].reshape(shape),
        exposure_mid_ns=np.repeat(time_ns[:, None], len(cameras), axis=1),
    )


def _numbers(cells: Mapping[str, Sequence[str]], names: Sequence[str], path: Path) -> list[Array]:
    return [parsed(cells[name], name, float, path) for name in names]
