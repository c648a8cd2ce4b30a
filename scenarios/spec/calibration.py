"""Keys of a scenario file: the calibration that its pipeline gets.

Without the table, and with ``target = "none"``, the pipeline gets the true poses and the best fit of its lens model
to the true lenses: the result of a perfect calibration, as a diagnostic. With the table the rig is estimated, as in a
lab, from rendered images of a calibration session that the same cameras take beforehand, at rest. The defaults are a
field of targets at ten stands in the working space. The estimate is cached for all scenarios with the same cameras
(``scenarios.run.kept_calibrations``).
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mosca.data.files.toml import NotNegative, Positive, Table

LEAST_CARRIED = 30
"""Least exposures of a board or wand: fewer are a mistake, as the default is that of a field, one at each stand."""
FIELD_ONLY = {"markers", "layout", "relief", "stands", "shift", "tilt_deg", "world_frames"}


class WrongSizeFault(Table):
    """The target's size differs from its file's, as of a sheet that was printed scaled."""

    kind: Literal["wrong_size"]
    factor: Positive = Field(description="true lengths over those in the file")


class WrongUnitsFault(Table):
    """The marks' positions in the file have a wrong unit; the dots' sizes do not."""

    kind: Literal["wrong_units"]
    factor: Positive = Field(1000.0, description="places in the file over the true ones")


class SwappedSessionFault(Table):
    """Two cameras are swapped in the session; an earlier calibration exists."""

    kind: Literal["swapped_cameras"]
    cameras: tuple[str, str] = Field(description="names of the two cameras")


class MovedCameraFault(Table):
    """A camera was rotated since an earlier calibration, with which the session is compared."""

    kind: Literal["moved_camera"]
    camera: str = Field(description="name of the camera")
    turn_px: float = Field(5.0, description="how far its image moved [px]")


CalibrationFault = Annotated[
    WrongSizeFault | WrongUnitsFault | SwappedSessionFault | MovedCameraFault, Field(discriminator="kind")
]


class CalibrationSpec(Table):
    """``[calibration]``: the session from which the rig is estimated before the measurement."""

    target: Literal["field", "board", "wand", "none"] = Field(
        "field",
        description="what is put before the cameras; boards and wands are followed by an L-frame for the axes; "
        "'none': the true rig instead, as of a perfect calibration",
    )
    markers: int = Field(100, ge=4, le=507, description="coded targets of a field")
    layout: Literal["tower", "corner", "plate"] = Field("tower", description="how they stand")
    relief: NotNegative = Field(0.0, le=1, description="depth of a plate's targets, share of its edge")
    size_m: tuple[Positive, Positive, Positive] | None = Field(
        None,
        description="edges of the field, or of the box that a target is carried in; default: the working space, of a "
        "field a tenth more",
    )
    known_to: NotNegative = Field(
        1e-5, description="standard deviation of the marks' places or lengths, share of the longest edge"
    )
    stands: int = Field(10, ge=1, le=200, description="places at which the field is put; the first is the world")
    shift: NotNegative = Field(0.45, description="how far from the first stand, share of the field's edges")
    tilt_deg: NotNegative = Field(25.0, le=60, description="how far it leans there at most")
    frames: int = Field(2, ge=1, le=5000, description="exposures (of a field: at each stand)")
    world_frames: int = Field(
        10, ge=0, le=5000, description="exposures of a field at the first stand, which is the world, if more"
    )
    rate_hz: Positive = Field(
        10.0, le=2000, description="exposures a second; a target that is carried must move between them [Hz]"
    )
    lengths: bool = Field(False, description="hold the result against a certified bar that it did not use")
    earlier: bool = Field(False, description="hold the result against an earlier calibration, the true one")
    exterior_only: bool = Field(False, description="keep the earlier calibration's lenses, estimate the poses")
    fault: CalibrationFault | None = Field(None, description="what is wrong with the session, and must be found")

    @model_validator(mode="after")
    def _fits(self) -> "CalibrationSpec":
        wrong = FIELD_ONLY & self.model_fields_set
        if self.target in ("board", "wand") and wrong:
            raise ValueError(f"'{min(wrong)}' belongs to a field; target = '{self.target}' has none")
        if self.target in ("board", "wand") and self.frames < LEAST_CARRIED:
            raise ValueError(
                f"frames = {self.frames} given; a {self.target} is carried about and seen in hundreds: at least "
                f"{LEAST_CARRIED} are wanted"
            )
        if self.relief and self.layout != "plate":
            raise ValueError(f"'relief' belongs to layout = 'plate'; '{self.layout}' has its own")
        if self.target == "wand" and self.exterior_only:
            raise ValueError("a wand finds lenses, too; exterior_only goes with a field or a board")
        return self
