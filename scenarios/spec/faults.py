"""Keys of a scenario file: ``[fault]``, what is wrong with the rig, the labels or the clock that are believed in."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mosca.data.files.toml import Positive, Table, Vector


class SwapFault(Table):
    """The calibrations of two cameras are swapped."""

    kind: Literal["swap_cameras"]
    cameras: tuple[str, str] = Field(description="names of the two cameras")


class LensFault(Table):
    """The pipeline believes in lenses without distortion."""

    kind: Literal["no_distortion"]


class ClockFault(Table):
    """Some cameras expose late, without effect on their time stamps."""

    kind: Literal["clock_shift"]
    cameras: tuple[str, ...] = Field(min_length=1, description="names of the cameras that are late")
    delay_s: float = Field(description="how much later they expose [s]")


class TurnFault(Table):
    """One camera was rotated since it was calibrated."""

    kind: Literal["turned_camera"]
    camera: str = Field(description="name of the camera")
    turn_px: float = Field(description="how far its image moves [px]")


class ScaleFault(Table):
    """The rig was calibrated with a length that is wrong: everything is larger by a factor, rays still meet."""

    kind: Literal["wrong_scale"]
    factor: Positive = Field(description="measured over true lengths")


class MovedFault(Table):
    """Some cameras were calibrated in a frame that is shifted against the others': those of a zone, for example."""

    kind: Literal["moved_cameras"]
    cameras: tuple[str, ...] = Field(min_length=1, description="names of the cameras")
    shift_m: Vector = Field(description="where they are believed to stand minus where they do, world frame [m]")


class MirroredFault(Table):
    """One camera has the mirrored pose of a plane in the working space's middle."""

    kind: Literal["mirrored_pose"]
    camera: str = Field(description="name of the camera")
    normal: Vector = Field(description="the plane's normal, world frame")
    middle_m: Vector = Field((0.0, 0.0, 0.0), description="the plane's middle [m]")


class ResolutionFault(Table):
    """The lenses were calibrated at another resolution, crop or zoom."""

    kind: Literal["other_resolution"]
    factor: Positive = Field(description="on the principal distance in pixels")
    told: bool = Field(False, description="the rig file also states images larger by this factor")


class LittleDepthFault(Table):
    """Principal and object distances are wrong by one factor, as of a target that was shown at one distance alone."""

    kind: Literal["little_depth"]
    factor: Positive = Field(description="believed over true distances")
    middle_m: Vector = Field((0.0, 0.0, 0.0), description="where the target was shown [m]")


class LabelFault(Table):
    """Labels are swapped, pair by pair, in the take; those that the skeleton was fitted to are right."""

    kind: Literal["swapped_labels"]
    pairs: tuple[tuple[str, str], ...] = Field(min_length=1, description="of markers; no marker twice")

    @model_validator(mode="after")
    def _names_each_once(self) -> "LabelFault":
        names = [name for pair in self.pairs for name in pair]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"pairs name '{twice}' twice; give each marker once")
        return self


class RateFault(Table):
    """The frame rate that the analysis of vibration is told is wrong; frames and stamps are right."""

    kind: Literal["wrong_rate"]
    factor: Positive = Field(description="told over true frame rate")


class LateCommandsFault(Table):
    """The commands' clock is ahead of the frames': the motion is seen later than it was."""

    kind: Literal["late_commands"]
    delay_s: float = Field(description="how much earlier than they were the commands are believed to be [s]")


class WrongDelayFault(Table):
    """The pilot of a flight believes in a wrong delay of its poses."""

    kind: Literal["wrong_delay"]
    offset_s: float = Field(description="believed minus true mean delay [s]")


class UnpredictedFault(Table):
    """Virtual objects are shown where their bodies were measured last: as if the display were not late."""

    kind: Literal["no_prediction"]


FaultSpec = Annotated[
    SwapFault
    | LensFault
    | ClockFault
    | TurnFault
    | ScaleFault
    | MovedFault
    | MirroredFault
    | ResolutionFault
    | LittleDepthFault
    | LabelFault
    | RateFault
    | LateCommandsFault
    | WrongDelayFault
    | UnpredictedFault,
    Field(discriminator="kind"),
]
