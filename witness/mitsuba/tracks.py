"""Cameras and moving markers from files: the rig file of a recording, and a table of positions.

A table of positions (CSV) has the columns ``label,time_ns,x,y,z,diameter_m`` and, for discs, ``nx,ny,nz``, the normal
on the visible side; times as in ``truth.csv``. Between these times markers move along cubic splines.
"""

import csv
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from witness.mitsuba.scene import Array, Body, LensCamera, MarkerBall, MarkerDisc, Part, Swing, Triple

LENS = ("k1", "k2", "p1", "p2", "k3")
FEWEST = 4
"""Least number of times of a marker: a cubic spline needs these."""


@dataclass(frozen=True)
class Track(Swing):
    """A path through positions at given times; ``normal`` (as many, or none): direction of the body's z axis."""

    time_s: tuple[float, ...] = ()
    place_m: tuple[Triple, ...] = ()
    normal: tuple[Triple, ...] = ()
    law: str = "cubic spline"
    """Interpolation between the times, on which a kept render depends."""

    @cached_property
    def _splines(self) -> tuple[CubicSpline, CubicSpline | None]:
        return CubicSpline(self.time_s, self.place_m), CubicSpline(self.time_s, self.normal) if self.normal else None

    def pose(self, t: float) -> tuple[Array, Array]:
        """Return world_from_body (3, 3) and the position (3) at ``t``."""
        place, normal = self._splines
        if normal is None:
            return np.eye(3), np.asarray(place(t))
        z = normal(t) / np.linalg.norm(normal(t))
        x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
        x /= np.linalg.norm(x)
        return np.column_stack([x, np.cross(z, x), z]), np.asarray(place(t))


def tracked(path: Path, first_s: float, last_s: float) -> list[Body]:
    """Return the markers of a table, whose times must cover ``first_s`` to ``last_s``."""
    rows: dict[str, list[dict[str, str]]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            rows.setdefault(row["label"], []).append(row)
    bodies = []
    for label, own in rows.items():
        time_s = tuple(int(row["time_ns"]) * 1e-9 for row in own)
        if len(own) < FEWEST or time_s[0] > first_s or time_s[-1] < last_s:
            raise ValueError(
                f"{path}: '{label}' has {len(own)} times from {time_s[0]:g} to {time_s[-1]:g} s; "
                f"{FEWEST} or more from {first_s:g} to {last_s:g} s are wanted"
            )
        size, places = float(own[0]["diameter_m"]), _triples(own, ("x", "y", "z"))
        normals = _triples(own, ("nx", "ny", "nz")) if own[0].get("nx") else ()
        here = (0.0, 0.0, 0.0)
        part: Part = MarkerDisc(label, here, (0.0, 0.0, 1.0), size) if normals else MarkerBall(label, here, size)
        bodies.append(Body(Track(time_s=time_s, place_m=places, normal=normals), (part,)))
    return bodies


def read_cameras(path: Path, aperture_m: float, focus_m: float) -> tuple[LensCamera, ...]:
    """Return the cameras of a rig file: OpenCV's lens with k1, k2, p1, p2, k3, all of one size."""
    with path.open("rb") as file:
        tables = tomllib.load(file)["camera"]
    made: list[LensCamera] = []
    for table in tables:
        lens: dict[str, Any] = dict(table["lens"])
        if lens.pop("model") != "opencv":
            raise ValueError(f"{path}: camera '{table['name']}': lens.model = 'opencv' is wanted")
        focal, principal = ((lens.pop(a), lens.pop(b)) for a, b in (("fx_px", "fy_px"), ("cx_px", "cy_px")))
        distortion = tuple(lens.pop(key, 0.0) for key in LENS)
        if any(lens.values()):
            raise ValueError(
                f"{path}: camera '{table['name']}': of the distortion only {', '.join(LENS)} are rendered"
            )
        pose, size = table["pose"], tuple(table["size"])
        if made and size != made[0].size:
            raise ValueError(f"{path}: camera '{table['name']}' has another size than '{made[0].name}'")
        made.append(
            LensCamera(
                table["name"], size, focal, principal, distortion,
                tuple(pose["position_m"]), tuple(pose["rotation_wxyz"]), aperture_m, focus_m,
            )
        )  # fmt: skip
    return tuple(made)


def _triples(rows: list[dict[str, str]], names: tuple[str, str, str]) -> tuple[Triple, ...]:
    x, y, z = names
    return tuple((float(row[x]), float(row[y]), float(row[z])) for row in rows)
