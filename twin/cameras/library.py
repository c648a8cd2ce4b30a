"""Named sensors and lenses with their sources.

The numbers are in ``library_files/sensors.toml`` and ``lenses.toml``. Each entry states the sources of its numbers
and which of them are assumptions.
"""

import difflib
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, model_validator

from mosca.data.files.toml import Table, check, read_toml
from mosca.errors import InputError

FILES = Path(__file__).parent / "library_files"
Positive = Annotated[float, Field(gt=0)]
Pixels = Annotated[int, Field(gt=0, le=65535)]


class Sourced(Table):
    """What every entry has: a title, ``source`` and ``urls`` of public documents, and the ``assumed`` fields."""

    title: Annotated[str, Field(min_length=1)]
    source: Annotated[str, Field(min_length=1, description="where the numbers come from, and how")]
    urls: tuple[Annotated[str, Field(pattern="^https?://")], ...]
    assumed: tuple[str, ...]

    @model_validator(mode="after")
    def _names_its_own_fields(self) -> "Sourced":
        fields = set(type(self).model_fields) - set(Sourced.model_fields)
        for name in self.assumed:
            if name not in fields:
                near = difflib.get_close_matches(name, fields, n=1)
                hint = f"; did you mean '{near[0]}'?" if near else f"; there are {', '.join(sorted(fields))}"
                raise ValueError(f"assumed names '{name}', which is no field{hint}")
        return self


class SensorEntry(Sourced):
    """A sensor in the terms of EMVA 1288; ``wavelength_nm`` is that of the quantum efficiency."""

    width: Pixels
    height: Pixels
    pixel_pitch_um: Positive
    full_well_e: Annotated[float, Field(gt=0, description="saturation capacity [e-]")]
    read_noise_e: Annotated[float, Field(gt=0, description="temporal dark noise [e-]")]
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)]
    wavelength_nm: Annotated[float, Field(ge=200, le=1200)]
    bits: Literal[8, 10, 12]
    max_frame_rate_hz: Positive
    shutter: Literal["global", "rolling"]
    row_time_s: Annotated[float, Field(ge=0, description="from row to row, 0 for a global shutter [s]")] = 0.0

    @model_validator(mode="after")
    def _rows_fit(self) -> "SensorEntry":
        if (self.shutter == "rolling") != (self.row_time_s > 0):
            raise ValueError(f"row_time_s {self.row_time_s:g} given for a {self.shutter} shutter; 0 means global")
        if self.row_time_s * self.height > 1.0 / self.max_frame_rate_hz:
            raise ValueError(
                f"{self.height} rows of {self.row_time_s:g} s do not fit into a frame at "
                f"{self.max_frame_rate_hz:g} Hz"
            )
        return self


class LensSpec(Sourced):
    """A lens: ``distortion`` is the optical one at the rim of the image circle, ``field_deg`` the full angle."""

    projection: Literal["central", "equidistant"]
    focal_length_mm: Positive
    f_number_min: Positive
    f_number_max: Positive
    image_circle_mm: Positive
    distortion: Annotated[float, Field(gt=-0.6, lt=0.6, description="share of the image radius at the rim")]
    field_deg: Annotated[float, Field(gt=0, lt=360)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "LensSpec":
        if self.f_number_max < self.f_number_min:
            raise ValueError(f"f_number_max {self.f_number_max:g} is below f_number_min {self.f_number_min:g}")
        if self.projection == "equidistant" and self.field_deg is None:
            raise ValueError("field_deg is missing; an equidistant lens needs its full field")
        return self


Spec = TypeVar("Spec", bound=Sourced)


def sensors(folder: Path = FILES) -> dict[str, SensorEntry]:
    """Return the named sensors of ``sensors.toml`` in ``folder``; InputError names file, entry, key and value."""
    return _entries(SensorEntry, folder / "sensors.toml")


def lenses(folder: Path = FILES) -> dict[str, LensSpec]:
    """Return the named lenses of ``lenses.toml`` in ``folder``; InputError names file, entry, key and value."""
    return _entries(LensSpec, folder / "lenses.toml")


def sensor(name: str) -> SensorEntry:
    """Return the sensor called ``name``; InputError lists the known names."""
    return _named("sensor", name, sensors())


def lens(name: str) -> LensSpec:
    """Return the lens called ``name``; InputError lists the known names."""
    return _named("lens", name, lenses())


def _entries(kind: type[Spec], path: Path) -> dict[str, Spec]:
    document = read_toml(path)
    entries = {}
    for name, table in document.items():
        where = f"{path}: [{name}]"
        if not isinstance(table, dict):
            raise InputError(f"{where}: {table!r} given; a table is wanted, one for each entry")
        entries[name] = check(kind, table, where)
    return entries


def _named(kind: str, name: str, entries: dict[str, Spec]) -> Spec:
    if name in entries:
        return entries[name]
    near = difflib.get_close_matches(name, entries, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise InputError(f"library: {kind} '{name}' is unknown; {hint}There are {', '.join(entries)}")
