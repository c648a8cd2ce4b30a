"""Keys of a scenario file: cameras that are not synchronised, how their clocks are related, what is estimated."""

from typing import Literal

from pydantic import Field, model_validator

from mosca.data.files.toml import Positive, Table


class ContinuousSpec(Table):
    """Frames go through ``mosca.continuous``: each at its own instant, trajectories as functions of time.

    Scored at the pulses' instants, on the first camera's clock, which should be the session's.
    """

    clocks: Literal["auto", "common", "own"] = Field(
        "auto",
        description="'own': each camera has a clock of its own and was started at an unknown time; 'common': "
        "all stamps "
        "are of one clock; 'auto': 'own' where a camera's clock is 'device'",
    )
    search_s: Positive = Field(10.0, description="by how much cameras may have been started apart [s]")
    estimate: Literal["known", "offset", "drift", "rolling"] = Field(
        "drift", description="what is estimated of the clocks besides the trajectories"
    )
    moving: bool = Field(
        False,
        description="worn cameras: those on other bodies film too; their poses, functions of time, come from the "
        "lamps that the cameras see of each other (lamp_number), and are estimated with the markers",
    )
    limbs: bool = Field(True, description="whether constant distances are found from the data and used")
    knot_s: Positive | None = Field(
        None, description="distance of the trajectories' knots [s]; without it as far apart as all cameras' exposures"
    )
    compare: tuple[Literal["linear", "cubic", "neural"], ...] = Field(
        (),
        description="other trajectory models that get the same image points, scored as rms_linear, rms_cubic and "
        "rms_neural; 'neural' costs the cube of the exposures: seconds of recording, not minutes",
    )
    worn_on: str | None = Field(
        None,
        description="body on which the cameras ride that film it: their places on it are known, the room's "
        "cameras are "
        "not there, and markers are told in that body's own frame",
    )
    reach_m: Positive = Field(1.3, description="worn cameras: how far from the body's origin markers can be [m]")

    @model_validator(mode="after")
    def _worn_where_moving(self) -> "ContinuousSpec":
        if not self.moving:
            return self
        if self.compare:
            raise ValueError("compare and moving = true: the models compared take cameras that stand; leave one out")
        if self.worn_on is None:
            raise ValueError("moving = true wants worn_on: the body on which two cameras and more ride")
        if self.clocks == "own" or self.estimate != "known":
            raise ValueError(
                f"moving = true with clocks = '{self.clocks}', estimate = '{self.estimate}': worn cameras that "
                "move are taken to be of one clock; say clocks = 'common' and estimate = 'known'"
            )
        return self
