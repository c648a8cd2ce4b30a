"""Parts that all adapters share: command line, files of the data set, output tables. It needs only numpy.

An adapter is called as ``python ADAPTER.py PHASE DATASET OUT.csv SETTINGS.json [MATCHED.csv]``:

- ``points``: from images to OUT.csv with ``frame,x,y,z`` [m], in the world of ``cameras.json``;
- ``detect``: from images to OUT.csv with ``camera,frame,u,v`` [px], and ``var_u,cov_uv,var_v`` [px^2] where the
  entrant states the covariance of its image points;
- ``triangulate``: from MATCHED.csv with ``frame,target,camera,u,v`` (the same target: the same marker), and those
  covariances, to OUT.csv as for ``points``.

It writes its results; any failure is an exception.
"""

import csv
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Arrays = Any
Read = Callable[[str], Arrays]
PLACE, COVARIANCE = ("u", "v"), ("var_u", "cov_uv", "var_v")


class Dataset:
    """A data set's folder: the data that an entrant may use."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.about = json.loads((self.folder / "dataset.json").read_text(encoding="utf-8"))
        self.cameras = json.loads((self.folder / "cameras.json").read_text(encoding="utf-8"))["cameras"]
        self.names = [camera["name"] for camera in self.cameras]

    def matrices(self) -> Iterator[tuple[Arrays, Arrays, Arrays, Arrays]]:
        """Yield K (3, 3), OpenCV's five distortion coefficients, R (3, 3) and t (3,) [m] of each camera."""
        for one in self.cameras:
            matrix = np.array([[one["fx"], 0, one["cx"]], [0, one["fy"], one["cy"]], [0, 0, 1.0]])
            coefficients = np.array([one[key] for key in ("k1", "k2", "p1", "p2", "k3")])
            yield matrix, coefficients, np.array(one["R"]), np.array(one["t"])

    def images(self, camera: str, read: Read) -> Iterator[tuple[int, Arrays]]:
        """Yield number and image of each frame of a camera."""
        for path in sorted((self.folder / "images" / camera).glob("*.png")):
            yield int(path.stem), read(str(path))

    def prepared(self, camera: str, read: Read, background: str) -> Iterator[tuple[int, Arrays]]:
        """Yield the images; with ``background`` "median", minus the median of all images of the camera."""
        images = list(self.images(camera, read))
        if background == "median":
            still = np.median([image for _, image in images], axis=0).astype(np.int16)
            images = [(k, np.clip(image.astype(np.int16) - still, 0, 255).astype(np.uint8)) for k, image in images]
        yield from images

    def read_matched(self, path: str, names: Sequence[str] = PLACE) -> tuple[Arrays, Arrays]:
        """Return the frame (n,) and the columns ``names`` (n, cameras, k) of each target's images, NaN for none.

        By default the columns are their positions [px].
        """
        found: dict[tuple[int, int], Arrays] = {}
        with open(path, newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                key = int(row["frame"]), int(row["target"])
                place = found.setdefault(key, np.full((len(self.names), len(names)), np.nan))
                place[self.names.index(row["camera"])] = [float(row[name]) for name in names]
        keys = sorted(found)
        places = [found[key] for key in keys]
        return np.array([frame for frame, _ in keys], int), np.array(places).reshape(-1, len(self.names), len(names))


def projections(dataset: Dataset) -> list[Arrays]:
    """Return R and t of each camera as a 3 x 4 matrix, for normalised image positions without distortion."""
    return [np.column_stack([rotation, shift]) for _, _, rotation, shift in dataset.matrices()]


def linear(projection: Sequence[Arrays], places: Arrays) -> Arrays:
    """Return the point (3,) from normalised positions (cameras, 2), NaN where a camera has none.

    The method is linear triangulation (DLT) by the singular vector of all cameras' equations (Hartley and Zisserman
    2004, 12.2).
    """
    rows = []
    for matrix, (x, y) in zip(projection, places, strict=True):
        if np.isfinite(x):
            rows += [x * matrix[2] - matrix[0], y * matrix[2] - matrix[1]]
    if len(rows) < 4:
        return np.full(3, np.nan)
    last = np.linalg.svd(np.array(rows))[2][-1]
    return last[:3] / last[3]


def write_points(path: str, frame: Arrays, xyz: Arrays) -> None:
    """Write ``frame,x,y,z`` of all finite points."""
    good = np.isfinite(xyz).all(axis=1)
    _write(
        path,
        ("frame", "x", "y", "z"),
        ((int(f), *map(float, p)) for f, p in zip(frame[good], xyz[good], strict=True)),
    )


def write_detections(path: str, rows: Iterator[tuple[Any, ...]], more: Sequence[str] = ()) -> None:
    """Write ``camera,frame,u,v`` and the columns ``more``."""
    _write(path, ("camera", "frame", *PLACE, *more), rows)


def _write(path: str, names: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(names)
        table.writerows(rows)


def run(phases: dict[str, Callable[..., None]]) -> None:
    """Run the phase named on the command line; exit code 2 for a phase that the adapter does not have."""
    phase, folder, out, settings, *rest = sys.argv[1:]
    if phase not in phases:
        sys.exit(f"phase '{phase}': this entrant has {', '.join(phases)}")
    phases[phase](Dataset(folder), out, json.loads(Path(settings).read_text(encoding="utf-8")), *rest)
