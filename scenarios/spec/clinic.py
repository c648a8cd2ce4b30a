"""Keys of a scenario file: ``[clinic]``, the cause that the clinic must name, and faults planted in frames."""

from typing import Literal

from pydantic import Field, model_validator

from mosca.clinic.causes import CAUSES
from mosca.data.files.toml import NotNegative, Positive, Table


class DropSpec(Table):
    """A camera loses frames that nobody counts: later ones take their numbers and stamps."""

    camera: str = Field(description="name of the camera")
    at_s: NotNegative = Field(description="when [s]")
    frames: int = Field(1, ge=1, description="how many")


class BlurSpec(Table):
    """A camera's focus drifts: its images are blurred more and more."""

    camera: str = Field(description="name of the camera")
    px_per_s: Positive = Field(description="growth of the blur (standard deviation) [px/s]")


class SwappedSpec(Table):
    """Labels of the take change places from an instant on."""

    at_s: NotNegative = Field(description="when [s]")
    what: Literal["labels", "bodies"] = Field("labels", description="two markers, or two bodies of three markers")


class ClinicSpec(Table):
    """``[clinic]``: what the clinic is told and must find; goes with ``expect = "diagnosed"``."""

    cause: str = Field(description="the cause that must come first, or 'none': " + ", ".join(CAUSES))
    known_length_m: Positive | None = Field(None, description="a length that it is told [m], as mosca clinic is")
    drop: DropSpec | None = Field(None, description="frames that one camera loses unnoticed")
    blur: BlurSpec | None = Field(None, description="focus of one camera that drifts")
    swapped: SwappedSpec | None = Field(None, description="labels or bodies that change places")

    @model_validator(mode="after")
    def _known_cause(self) -> "ClinicSpec":
        if self.cause != "none" and self.cause not in CAUSES:
            raise ValueError(f"cause = '{self.cause}' is no cause; there are none, {', '.join(CAUSES)}")
        return self
