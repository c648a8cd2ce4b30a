"""Keys of a scenario file: the drone is steered by the poses from the cameras as they arrive."""

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from mosca.data.files.toml import NotNegative, Positive, Table
from scenarios.spec.faults import WrongDelayFault
from scenarios.spec.scenes import DroneScene, SceneSpec

METRICS = (
    "flight_rms", "flight_max", "flight_sigma_ratio", "prediction_rms", "prediction_nees", "crashes",
    "pose_delay", "pose_delay_error", "pose_delay_mismatch",
)  # fmt: skip
"""Metrics that only a scenario with ``[flight]`` has."""


class FlightSpec(Table):
    """``[flight]``: the scene's drone flies on poses; what delays and loses them, and what steers.

    A pose arrives half the exposure, readout_s, transfer_s, pipeline_s and a random jitter after its mid-exposure.
    """

    readout_s: NotNegative = Field(0.004, le=0.5, description="from the end of the exposure to the image's end [s]")
    transfer_s: NotNegative = Field(0.002, le=0.5, description="network and drivers, there and back [s]")
    pipeline_s: NotNegative = Field(0.008, le=0.5, description="from the images to the pose [s]")
    jitter_s: NotNegative = Field(
        0.0, le=0.2, description="mean of a further random delay, exponentially distributed [s]"
    )
    dropout: Annotated[float, Field(ge=0, lt=1)] = Field(0.0, description="share of the poses lost at random")
    outage_s: tuple[NotNegative, Positive] | None = Field(None, description="no pose arrives from, until [s]")
    command_s: NotNegative = Field(0.004, le=0.2, description="from the controller to the drone; known to it [s]")
    inputs: Literal["commands", "imu"] = Field(
        "commands",
        description="acceleration that the predictor knows: of the commands through the attitude loop's lag, or "
        "measured on board",
    )
    compensate: bool = Field(True, description="false: the newest pose is taken for one of its arrival")
    unexplained_mps2: Positive = Field(
        0.1, description="rms acceleration that the predictor expects beside the known one, each axis [m/s^2]"
    )
    unexplained_s: Positive = Field(1.0, description="its correlation time [s]")
    imu_noise_mps2: NotNegative = Field(0.05, description="of the accelerations on board, each 5 ms [m/s^2]")
    imu_bias_mps2: NotNegative = Field(0.05, description="standard deviation of their constant error [m/s^2]")
    position_gain: Positive = Field(16.0, description="of the position controller [1/s^2]")
    velocity_gain: Positive = Field(7.2, description="of the position controller [1/s]")
    handover_s: Positive = Field(
        0.5, description="until then the drone is held by its true state, as on a stand; nothing is scored [s]"
    )
    settle_s: NotNegative = Field(1.0, description="after it, nothing is scored but crashes [s]")

    @model_validator(mode="after")
    def _outage(self) -> "FlightSpec":
        if self.outage_s is not None and not self.outage_s[0] < self.outage_s[1]:
            low, high = self.outage_s
            raise ValueError(f"outage_s = [{low:g}, {high:g}] given; the earlier instant first is wanted")
        return self

    def delay_s(self, exposure_s: float) -> float:
        """Return the mean time from mid-exposure to a pose's arrival [s]."""
        return 0.5 * exposure_s + self.readout_s + self.transfer_s + self.pipeline_s + self.jitter_s


def check_flight(
    given: FlightSpec | None, scene: SceneSpec, limits: Iterable[str], duration_s: float, fault: Any, more: bool
) -> None:
    """Raise ValueError where a scenario's keys and its ``[flight]`` cannot be combined.

    ``more``: whether it has sections that exclude ``[flight]``.
    """
    if given is None:
        for name in limits:
            if name in METRICS:
                raise ValueError(f"limits.{name} needs a flight in closed loop; add [flight], or take the limit away")
        if isinstance(fault, WrongDelayFault):
            raise ValueError("fault.kind = 'wrong_delay' is of a flight in closed loop; add [flight]")
        return
    if not isinstance(scene, DroneScene):
        raise ValueError(f"[flight] with scene.kind = '{scene.kind}': only a 'drone' flies; leave it out")
    if more:
        raise ValueError("[flight] with [continuous], [[zone]] or [lamps]: poses are of frame sets; leave one out")
    if given.handover_s + given.settle_s + 1.0 > duration_s:
        raise ValueError(
            f"flight.handover_s = {given.handover_s:g} and settle_s = {given.settle_s:g} leave less than 1 s of "
            f"capture.duration_s = {duration_s:g} to score; make the capture longer"
        )
