"""What a scenario file may say of the calibration that its pipeline believes in.

Without the table the pipeline gets the true poses and the best fit of its lens model to the true lenses: what a
perfect calibration would give. With it the rig is estimated, as in a lab, from rendered images of a calibration
session that the same cameras take beforehand.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mosca.data.toml import NotNegative, Positive, Table

Codes = tuple[str, ...]


class TargetScale(Table):
    """The target is not as large as its file says."""

    kind: Literal["wrong_size"]
    factor: Positive = Field(description="true size over the one in the file")


class TargetUnits(Table):
    """The marks' places stand in the file in another unit, the dots' sizes do not."""

    kind: Literal["wrong_units"]
    factor: Positive = Field(1000.0, description="what the file has over the true lengths")


class SwappedSession(Table):
    """Two cameras' images stand for each other in the session; the earlier calibration is at hand."""

    kind: Literal["swapped_cameras"]
    cameras: tuple[str, str]


class FlatTarget(Table):
    """Only a flat part of the target is used, seen from afar: one plane, upright, at one stand."""

    kind: Literal["flat_target"]
    depth: NotNegative = Field(0.0, description="depth that is left, share of the target's size")


class FewViews(Table):
    """Little of the target is used."""

    kind: Literal["few_marks"]
    marks: int = Field(7, ge=1, description="how many marks")


class MovedCamera(Table):
    """A camera was moved since an earlier calibration, which is used for the measurement."""

    kind: Literal["moved_camera"]
    camera: str
    turn_px: float = Field(3.0, description="how far its image moved [px]")


CalibrationFault = Annotated[
    TargetScale | TargetUnits | SwappedSession | FlatTarget | FewViews | MovedCamera,
    Field(discriminator="kind"),
]


class CalibrationSpec(Table):
    """``[calibration]``: the session from which the rig is estimated before the measurement."""

    target: Literal["field", "board", "wand"] = Field("field", description="what is put before the cameras")
    markers: int = Field(150, ge=6, le=507, description="coded targets of a field")
    layout: Literal["tower", "corner"] = Field("tower", description="how they stand")
    size_m: tuple[Positive, Positive, Positive] | None = Field(
        None, description="edges of the field; default: the working space's"
    )
    known_to: NotNegative = Field(
        1e-5, description="standard deviation of the marks' places, share of the longest edge"
    )
    stands: int = Field(
        1, ge=1, le=200, description="places at which the field is put; the first is the world"
    )
    shift: NotNegative = Field(0.2, description="how far from the first stand, share of the field's edges")
    tilt_deg: NotNegative = Field(15.0, le=60, description="how far it leans there at most")
    frames: int = Field(20, ge=1, le=2000, description="exposures at each stand")
    exterior_only: bool = Field(False, description="keep the true lenses' best fit, estimate poses alone")
    fault: CalibrationFault | None = None

    @model_validator(mode="after")
    def _fits(self) -> "CalibrationSpec":
        if self.target != "field" and {"markers", "layout", "stands"} & self.model_fields_set:
            raise ValueError(f"markers, layout and stands are a field's; target = '{self.target}' has none")
        return self
