"""Keys of a scenario file: objects of a second scene that tracked bodies move."""

from collections.abc import Iterable

from pydantic import Field

from mosca.data.files.toml import NotNegative, Positive, Table
from scenarios.spec.faults import UnpredictedFault

METRICS = ("object_position_rms", "object_angle_rms", "object_nees", "object_age_p99", "objects_current")
"""Metrics that only a scenario with ``[virtual]`` has."""


class VirtualSpec(Table):
    """``[virtual]``: objects follow tracked bodies, predicted to each display; scored as object_*.

    Displays are simulated: the poses of an exposure are known ``latency_s`` after its middle. What a machine really
    needs, 'mosca live --virtual' measures.
    """

    scene: str | None = Field(
        None, description="MJCF file of the second scene, shown with --rrd; its physics goes on"
    )
    bind: tuple[str, ...] = Field(min_length=1, description="BODY=OBJECT: tracked body, and the mocap body it moves")
    display_hz: Positive = Field(60.0, le=1000, description="rate of the display [Hz]")
    latency_s: NotNegative = Field(
        0.015, le=1.0, description="from the middle of an exposure until its poses are known [s]"
    )
    horizon_s: NotNegative = Field(0.1, le=1.0, description="farthest that a pose is predicted [s]")


def check_virtual_spec(
    given: VirtualSpec | None, limits: Iterable[str], bodies: bool, continuous: bool, fault: Table | None
) -> None:
    """Raise ValueError where a scenario's keys and its ``[virtual]`` cannot be combined."""
    if given is None:
        for name in limits:
            if name in METRICS:
                raise ValueError(f"limits.{name} needs virtual objects; add [virtual], or take the limit away")
        if isinstance(fault, UnpredictedFault):
            raise ValueError("fault.kind = 'no_prediction' is of virtual objects; add [virtual]")
        return
    if not bodies:
        raise ValueError("[virtual] needs tracked bodies; set pipeline.bodies = true")
    if continuous:
        raise ValueError("[virtual] with [continuous]: objects follow bodies of frame sets; leave one of them out")
