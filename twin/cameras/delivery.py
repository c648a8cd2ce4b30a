"""Delivery: what becomes of a frame between the sensor and the reader.

Frames get lost, one by one or in bursts, come late, twice, after their successor or damaged, and a camera may die
and come back. What happens to a frame follows from (seed, camera, frame number) alone, so that the bytes do not
depend on the workers, nor one fault on another.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from mosca.data.frames import Frame
from mosca.errors import InputError
from twin.streams import key

Fate = Literal["good", "dead", "dropped", "corrupt", "late", "reordered", "doubled"]
SHARES = ("dropped_share", "burst_share", "corrupt_share", "late_share", "reordered_share", "doubled_share")


@dataclass(frozen=True)
class Delivery:
    """Shares of a camera's frames that have a fault of delivery, 0 to 1.

    Of several faults, the first in this order counts: dead, dropped, corrupt, late, reordered, doubled.
    """

    dropped_share: float = 0.0
    """Lost at random."""
    burst_share: float = 0.0
    """Lost in bursts."""
    burst_frames: int = 10
    """Length of a burst."""
    corrupt_share: float = 0.0
    """Arrive without a usable image."""
    late_share: float = 0.0
    """Come after ``late_frames`` more frames of the rig."""
    late_frames: int = 50
    """How late."""
    reordered_share: float = 0.0
    """Come after the camera's next frame, which is then not reordered itself: up to half of all."""
    doubled_share: float = 0.0
    """Come twice."""
    dies_s: float | None = None
    """Frames that open from then on are lost, session clock (None: never)."""
    returns_s: float | None = None
    """End of that loss, session clock (None: it does not end)."""

    def __post_init__(self) -> None:
        for name in SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"delivery: {name} = {getattr(self, name)} given; a share from 0 to 1 is wanted")
        if self.reordered_share > 0.5:
            raise InputError(
                f"delivery: reordered_share = {self.reordered_share} given; 0.5 at most is possible, since the frame "
                "that overtakes another comes in time"
            )
        for name in ("burst_frames", "late_frames"):
            if getattr(self, name) < 1:
                raise InputError(f"delivery: {name} = {getattr(self, name)} given; 1 or more is wanted")


FAULTLESS = Delivery()


@dataclass(frozen=True, eq=False)
class Taken:
    """A frame of the sensor, with the instants when its first row opened and was due to open, session clock [s]."""

    frame: Frame
    opened_s: float
    due_s: float


def fate_of(delivery: Delivery, seed: int, name: str, number: int, opened_s: float) -> Fate:
    """Return what becomes of frame ``number`` of camera ``name``, which opened at ``opened_s`` [s]."""
    if delivery == FAULTLESS:
        return "good"
    returns_s = math.inf if delivery.returns_s is None else delivery.returns_s
    if delivery.dies_s is not None and delivery.dies_s <= opened_s < returns_s:
        return "dead"
    if _meets(delivery.dropped_share, seed, name, "dropped", number):
        return "dropped"
    if delivery.burst_share > 0.0:
        # a frame is lost if any of the bursts that would reach it has begun
        begins = 1.0 - (1.0 - delivery.burst_share) ** (1.0 / delivery.burst_frames)
        for first in range(max(0, number - delivery.burst_frames + 1), number + 1):
            if _meets(begins, seed, name, "burst", first):
                return "dropped"
    if _meets(delivery.corrupt_share, seed, name, "corrupt", number):
        return "corrupt"
    if _meets(delivery.late_share, seed, name, "late", number):
        return "late"
    if _is_reordered(delivery.reordered_share, seed, name, number):
        return "reordered"
    return "doubled" if _meets(delivery.doubled_share, seed, name, "doubled", number) else "good"


def deliver(taken: Iterable[Taken], deliveries: Mapping[str, Delivery], seed: int) -> Iterator[Frame]:
    """Yield the frames in order of arrival.

    ``taken``: the rig's frames in the order in which they were made. ``deliveries``: by camera; a camera that is not
    named delivers everything. Frames that still wait at the end are delivered then, in the order of their making.
    """
    late: list[tuple[int, Frame]] = []
    held: dict[str, list[Frame]] = {}
    for made, shot in enumerate(taken, start=1):
        frame, name = shot.frame, shot.frame.camera
        fate = fate_of(deliveries.get(name, FAULTLESS), seed, name, frame.index, shot.opened_s)
        if fate == "late":
            late.append((made + deliveries[name].late_frames, frame))
        elif fate == "reordered":
            held.setdefault(name, []).append(frame)
        elif fate == "corrupt":
            yield _damaged(frame)
        elif fate in ("good", "doubled"):
            yield frame
            if fate == "doubled":
                yield frame
        if fate not in ("late", "reordered"):
            yield from held.pop(name, ())
        while late and late[0][0] <= made:
            yield late.pop(0)[1]
        late.sort(key=lambda waiting: waiting[0])
    for frames in held.values():
        yield from frames
    for _due, frame in late:
        yield frame


def _is_reordered(share: float, seed: int, name: str, number: int) -> bool:
    """Return whether a frame comes after the camera's next one: in a run of drawn frames, every second one does."""
    drawn, run = share / (1.0 - share), 0
    while number >= run and _meets(drawn, seed, name, "reordered", number - run):
        run += 1
    return run % 2 == 1


def _meets(share: float, seed: int, name: str, trouble: str, number: int) -> bool:
    return share > 0.0 and key(seed, f"camera/{name}/delivery/{trouble}", number) < share * 2.0**64


def _damaged(frame: Frame) -> Frame:
    return replace(frame, image=None, status="corrupt", note="damaged on its way from the camera")
