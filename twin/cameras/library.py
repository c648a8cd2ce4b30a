"""Named sensors and lenses with their sources, and what the twin makes of them.

The numbers stand in ``library_files/sensors.toml`` and ``lenses.toml``; each entry states where they come from and
which of them are assumptions.
"""

import difflib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

from pydantic import Field, model_validator

from mosca.data.files.toml import Table, check, read_toml
from mosca.data.rig import FisheyeLens, Lens, OpenCVLens
from mosca.errors import InputError
from twin.cameras.optics.blur_parameters import Optics

if TYPE_CHECKING:
    from twin.cameras.sensor.sensor import Sensor

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


class SensorSpec(Sourced):
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
    def _rows_fit(self) -> "SensorSpec":
        if (self.shutter == "rolling") != (self.row_time_s > 0):
            raise ValueError(
                f"row_time_s {self.row_time_s:g} given for a {self.shutter} shutter; 0 means global"
            )
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
            raise ValueError(
                f"f_number_max {self.f_number_max:g} is below f_number_min {self.f_number_min:g}"
            )
        if self.projection == "equidistant" and self.field_deg is None:
            raise ValueError("field_deg is missing; an equidistant lens needs its full field")
        return self


Spec = TypeVar("Spec", bound=Sourced)


def sensors(folder: Path = FILES) -> dict[str, SensorSpec]:
    """Return the named sensors of ``sensors.toml`` in ``folder``; InputError names file, entry, key and value."""
    return _entries(SensorSpec, folder / "sensors.toml")


def lenses(folder: Path = FILES) -> dict[str, LensSpec]:
    """Return the named lenses of ``lenses.toml`` in ``folder``; InputError names file, entry, key and value."""
    return _entries(LensSpec, folder / "lenses.toml")


def sensor(name: str) -> SensorSpec:
    """Return the sensor called ``name``; InputError lists those that there are."""
    return _named("sensor", name, sensors())


def lens(name: str) -> LensSpec:
    """Return the lens called ``name``; InputError lists those that there are."""
    return _named("lens", name, lenses())


def sensor_of(spec: SensorSpec, bits: int | None = None) -> "Sensor":
    """Return the twin's sensor with these electrons; ``bits`` of the output where the camera is set to fewer."""
    from twin.cameras.sensor.sensor import Sensor  # numba: not needed to look things up

    return Sensor(
        full_well_e=spec.full_well_e,
        read_noise_e=spec.read_noise_e,
        bits=spec.bits if bits is None else bits,
        quantum_efficiency=spec.quantum_efficiency,
    )


def optics_of(spec: LensSpec, pixel_pitch_um: float, f_number: float, focus_m: float | None = None) -> Optics:
    """Return the optics of a lens at an f-number, focused at ``focus_m`` (None: sharp everywhere); no gap.

    InputError for an f-number that the lens does not have.
    """
    if not spec.f_number_min <= f_number <= spec.f_number_max:
        raise InputError(
            f"lens '{spec.title}': f_number = {f_number:g} given; {spec.f_number_min:g} to {spec.f_number_max:g} "
            "is allowed"
        )
    return Optics(
        focus_m=focus_m,
        f_mm=spec.focal_length_mm,
        f_number=f_number,
        pixel_pitch_mm=pixel_pitch_um / 1000.0,
        gap_px=0.0,
    )


def interior_of(spec: LensSpec, camera: SensorSpec) -> Lens:
    """Return the nominal interior orientation: principal point in the middle, the first distortion term alone.

    It gives the stated distortion at the rim of the image circle: ``k1 = distortion / (slope there)^2``, where an
    equidistant lens has the angle in place of the slope.
    """
    pitch_mm = camera.pixel_pitch_um / 1000.0
    focal_px = spec.focal_length_mm / pitch_mm
    centre = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    if spec.projection == "equidistant":
        assert spec.field_deg is not None
        rim = math.radians(spec.field_deg / 2)
        return FisheyeLens(focal_px, focal_px, *centre, k1=spec.distortion / rim**2)
    # the rim is where the distorted image ends: slope (1 + distortion) * focal length = radius
    rim = spec.image_circle_mm / 2 / spec.focal_length_mm / (1.0 + spec.distortion)
    return OpenCVLens(focal_px, focal_px, *centre, k1=spec.distortion / rim**2)


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
