"""The target file of a calibration: the object before the cameras, and the files of its measured points.

kind = "points"                      # known points, measured in the images by any means
unit = "mm"
columns = ["u", "v", "X", "Y", "Z"]
pixel_origin = "centre"
lens = "mosca"
size_px = [1280, 1024]

[[camera]]
name = "left"
file = "Calibration/left_points.txt"   # relative to the recording

Objects that the cameras see are described by the kinds "field", "board", "wand", "light", "l_frame" and "scale_bar"
of ``mosca.data.files.target_tables``.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, TypeAdapter, model_validator

from mosca.data.arrays import Array, set_read_only
from mosca.data.files.bounded import read_text
from mosca.data.files.decimals import real
from mosca.data.files.file_kind import other_kind
from mosca.data.files.target_tables import (
    PIXEL_ORIGINS,
    TABLES,
    CalibrationTable,
    CalibrationTarget,
    PixelOrigin,
    Size,
    WandPointsTable,
    WandTable,
)
from mosca.data.files.toml import Positive, Table, check, described, read_toml
from mosca.errors import InputError

Column = Literal["u", "v", "X", "Y", "Z", "-"]
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Metres in the units that a target file may state."""
NEEDED_COLUMNS: tuple[Column, ...] = ("u", "v", "X", "Y", "Z")
SKIPPED_COLUMN = "-"

LensModel = Literal["mosca", "opencv", "fisheye"]


class PointsCamera(Table):
    """A camera's measured points; lens and size default to those of the target."""

    name: str = Field(min_length=1, description="the camera's name")
    file: str = Field(min_length=1, description="text file of measured points, relative to the recording")
    lens: LensModel | None = Field(None, description="lens model; default: the target's")
    size_px: Size | None = Field(None, description="[width, height] of its images; default: the target's")
    pixel_pitch_mm: Positive | None = Field(None, description="mx of a Mosca lens; default: the target's")


class PointsTarget(Table):
    """Known points in the world with their measured pixels, a text file for each camera.

    ``columns`` the order of the file's columns, "-" for one to skip; u to the right, v down.
    ``pixel_origin``: what is (0, 0): "centre" or "corner" of the top-left pixel; "one": its centre is (1, 1).
    ``pixel_pitch_mm``: mx of a Mosca lens, held in the adjustment.
    """

    kind: Literal["points"] = Field(description='"points"')
    unit: Literal["mm", "cm", "m"] = Field(description='unit of X, Y, Z: "mm", "cm" or "m"')
    columns: tuple[Column, ...] = Field(
        NEEDED_COLUMNS, description="order of the file's columns, '-' for one to skip"
    )
    pixel_origin: PixelOrigin = Field(
        "centre", description="what (0, 0) is: the first pixel's centre or corner; 'one': its centre is (1, 1)"
    )
    lens: LensModel = Field("mosca", description="lens model of all cameras that name none")
    size_px: Size | None = Field(None, description="[width, height] of the images of all cameras that name none")
    pixel_pitch_mm: Positive = Field(0.01, description="mx of a Mosca lens, held in the adjustment")
    camera: Annotated[tuple[PointsCamera, ...], Field(min_length=1, description="[[camera]] tables")]

    @model_validator(mode="after")
    def _complete(self) -> "PointsTarget":
        named = [c for c in self.columns if c != SKIPPED_COLUMN]
        if sorted(named) != sorted(NEEDED_COLUMNS):
            raise ValueError(f"'columns' has {', '.join(named)}; each of u, v, X, Y, Z must stand in it once")
        names = [c.name for c in self.camera]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"camera name '{name}' stands twice; give each camera its own name")
        for one in self.camera:
            if one.size_px is None and self.size_px is None:
                raise ValueError(f"camera '{one.name}' has no 'size_px'; give [width, height] of the image")
        return self


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """World points ``xyz`` (n, 3) [m] at pixels ``xy_px`` (n, 2); the top-left pixel's centre is (0, 0)."""

    xy_px: Array
    xyz: Array

    def __post_init__(self) -> None:
        n = len(np.asarray(self.xy_px))
        set_read_only(self, xy_px=(n, 2), xyz=(n, 3))


def read_target_file(path: Path) -> PointsTarget | CalibrationTarget:
    """Read a target file of any kind; InputError names the key, the value and what is allowed."""
    document = read_toml(Path(path))
    if other := other_kind(document, "target"):
        raise InputError(f"{path}: {other}")
    kind, allowed = document.get("kind"), ("points", *TABLES)
    if not isinstance(kind, str) or kind not in allowed:
        given = "no 'kind'" if kind is None else f"kind = {kind!r}"
        raise InputError(f"{path}: {given} given; allowed: {', '.join(map(repr, allowed))}")
    if kind == "points":
        return check(PointsTarget, document, path)
    table: CalibrationTable = check(TABLES[kind], document, path)
    try:
        return table.made()
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def read_wand_points_table(path: Path) -> WandPointsTable:
    """Return the table ``[points]`` of a wand's file; InputError where it has none."""
    table = check(WandTable, read_toml(Path(path)), path)
    if table.points is None:
        raise InputError(
            f"{path}: no table [points]; for a table of image points it states size_px = [width, height] and y_axis "
            '= "up" (origin at the lower left: Argus, DLTdv up to 5) or "down" (at the upper left: DLTdv8, easyWand)'
        )
    return table.points


def target_schema() -> dict[str, Any]:
    """Return the JSON schema of the target file of all kinds, for editors that complete and check it."""
    every = Annotated[PointsTarget | CalibrationTable, Field(discriminator="kind")]
    return described(TypeAdapter(every).json_schema())


def read_measured_points(path: Path, target: PointsTarget) -> MeasuredPoints:
    """Read a text file of measured points as ``target`` describes it.

    Numbers are separated by blanks, commas, semicolons or tabs; empty lines and text after a # are skipped.
    InputError names the file and the line.
    """
    text = read_text(path, "the 'file' of a target, relative to the recording,")
    wanted = len(target.columns)
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        parts = [part for part in re.split(r"[\s,;]+", line.split("#")[0]) if part]
        if not parts:
            continue
        if len(parts) != wanted:
            raise InputError(
                f"{path}: line {number}: {len(parts)} values given, {wanted} wanted "
                f"({' '.join(target.columns)}); mend the line or set 'columns'"
            )
        rows.append([_number(path, number, target.columns[k], part) for k, part in enumerate(parts)])
    if not rows:
        raise InputError(f"{path}: no measured points; a line {' '.join(target.columns)} for each is wanted")
    values = np.array(rows)
    column = {name: values[:, k] for k, name in enumerate(target.columns)}
    xy = np.column_stack([column["u"], column["v"]]) - PIXEL_ORIGINS[target.pixel_origin]
    xyz = np.column_stack([column["X"], column["Y"], column["Z"]]) * METRES[target.unit]
    return MeasuredPoints(xy, xyz)


def _number(path: Path, line: int, column: str, text: str) -> float:
    if column == SKIPPED_COLUMN:
        return 0.0
    try:
        value = real(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: line {line}: {column} = '{text[:40]}' given; a finite number is wanted")
    return value
