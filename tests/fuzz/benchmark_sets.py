"""Readers of the benchmark's plain files, and what csv and json say is in them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.reader import Reader
from fuzz.tables import _blanks, _rows, whole
from rigs import ring

from mosca.data.rig import OpenCVLens
from mosca.data.truth import Truth
from scenarios.studies.benchmark.folder import MadeSet, read_about, read_set_truth, write_set
from scenarios.studies.benchmark.scoring import match_detections, read_found

LENS = OpenCVLens(900.5, 901.25, 320.0, 250.0, k1=-0.1, k2=0.02, p1=1e-3)
CAMERAS = ("left", "right")
T, M, C = 4, 3, 2


def _some_truth() -> Truth:
    rng = np.random.default_rng(8)
    images = rng.uniform(0, 400, (T, M, C, 2))
    images[0, 0, 0] = np.nan
    times = np.arange(T) * 10_000_000
    return Truth(
        times, ("a", "b", "c"), rng.normal(size=(T, M, 3)), rng.random((T, M, C)), CAMERAS, images,
        rng.uniform(3, 9, (T, M, C)), np.tile(times[:, None], C),
    )  # fmt: skip


def _seed(folder: Path) -> None:
    box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    rig = ring(C, (LENS,) * C)
    write_set(MadeSet("s", "a set", "a test", 1, rig, _some_truth(), 100.0, 1e-3, box, 0.01), folder)


def _truth(folder: Path) -> Any:
    truth = read_set_truth(folder / "truth" / "s")
    names = ("time_ns", "names", "xyz", "visible", "cameras", "image_xy_px", "diameter_px")
    return {name: getattr(truth, name) for name in names}


def _truth_expected(folder: Path) -> Any:
    points, images = (_rows(folder / "truth" / "s" / f"{name}.csv")[1:] for name in ("points", "images"))
    names, cameras = list(dict.fromkeys(r[2] for r in points)), list(dict.fromkeys(r[2] for r in images))
    shape = (len(points) // len(names), len(names), len(cameras))

    def column(k: int) -> np.ndarray:
        return _blanks([row[k] for row in images]).reshape(shape)

    whole([row[0] for row in points])
    return {
        "time_ns": whole([row[1] for row in points])[:: len(names)],
        "names": names,
        "xyz": np.stack([_blanks([row[k] for row in points]) for k in (3, 4, 5)], 1).reshape(*shape[:2], 3),
        "visible": column(5),
        "cameras": cameras,
        "image_xy_px": np.stack([column(3), column(4)], axis=-1),
        "diameter_px": column(6),
    }


def _about(folder: Path) -> Any:
    return read_about(folder / "s" / "dataset.json").model_dump(mode="json")


def _found_seed(folder: Path) -> None:
    rows = [f"{k % T},{0.1 * k!r},-0.5,{1e-3 * k!r}" for k in range(12)]
    (folder / "p.csv").write_text("frame,x,y,z\n" + "\n".join(rows) + "\n")


def _found(folder: Path) -> Any:
    found = read_found(folder / "p.csv", _some_truth())
    return {"frame": found.frame, "xyz": found.xyz}


def _found_expected(folder: Path) -> Any:
    rows = _rows(folder / "p.csv")[1:]
    xyz = [_blanks([row[k] for row in rows]) for k in (1, 2, 3)]
    return {"frame": whole([row[0] for row in rows]), "xyz": np.stack(xyz, axis=1)}


def _detections_seed(folder: Path) -> None:
    places = _some_truth().image_xy_px
    rows = [
        f"{name},{f},{float(places[f, 1, c, 0])!r},{float(places[f, 1, c, 1])!r}"
        for c, name in enumerate(CAMERAS)
        for f in range(T)
    ]
    (folder / "d.csv").write_text("camera,frame,u,v\n" + "\n".join(rows) + "\n")


def _detections(folder: Path) -> Any:
    """Return how many image points there are, all told: which are of which marker is not the file's matter."""
    match_detections(folder / "d.csv", _some_truth(), folder / "m.csv")
    return len(_rows(folder / "d.csv")) - 1


READERS = (
    Reader("benchmark truth", (_seed,), ("truth/s/*.csv",), _truth, _truth_expected),
    Reader(
        "benchmark about",
        (_seed,),
        ("s/dataset.json",),
        _about,
        lambda folder: json.loads((folder / "s" / "dataset.json").read_text(encoding="utf-8")),
    ),
    Reader("benchmark points", (_found_seed,), ("p.csv",), _found, _found_expected),
    Reader(
        "benchmark detections", (_detections_seed,), ("d.csv",), _detections, lambda f: len(_rows(f / "d.csv")) - 1
    ),
)
