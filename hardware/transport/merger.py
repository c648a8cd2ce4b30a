"""Merges detections of many stations to sets, pulse by pulse; pure: times are arguments.

A set waits for its cameras, at most ``deadline_s`` from its first message, but not for a camera whose message cannot
come any more: a later pulse of it was received (each camera's messages come in order), or its station is away.
Messages after their set was closed, or older than ``oldest_s``, are counted and dropped.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from hardware.transport.messages import DetectionStatus
from mosca.data.detections import Detections


@dataclass(frozen=True)
class MergeSettings:
    """Waiting times of the merger."""

    deadline_s: float = 0.03
    """Longest time that a set waits for its cameras."""
    oldest_s: float = 0.25
    """Age at which a message is dropped."""


@dataclass(frozen=True, eq=False)
class Arrived:
    """A message in the session's terms; times are host times of this machine [ns] unless noted."""

    pulse: int
    """The session's pulse."""
    time_ns: int
    """Mid-exposure on the session's clock [ns]."""
    arrival_ns: int
    """When the frame arrived at its station."""
    sent_ns: int
    """When the message left its station."""
    received_ns: int
    status: DetectionStatus
    detections: Detections
    buffered: bool = False
    """Whether it waited, here or at its station, until the start was known; it may be old then."""


@dataclass(frozen=True, eq=False)
class MergedSet:
    """All stations' detections of one pulse."""

    pulse: int
    time_ns: int
    """Median mid-exposure of the detections that were received [ns]."""
    detections: Mapping[str, Detections]
    """Camera -> detections, in the rig's order."""
    missing: Mapping[str, str]
    """Each other camera -> why it is missing."""
    merged_ns: int
    """Host time when the set was complete [ns]."""
    arrived_ns: Mapping[str, int]
    """Camera -> when its frame arrived at the station [ns]."""
    sent_ns: Mapping[str, int]
    """Camera -> when its message left the station [ns]."""

    def __post_init__(self) -> None:
        for name in ("detections", "missing", "arrived_ns", "sent_ns"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))


@dataclass
class CameraMerge:
    """One camera's part in the sets: ``merged`` + ``no_frame`` + ``away`` + ``lost`` are all sets."""

    merged: int = 0
    """Sets with its detections."""
    no_frame: int = 0
    """Its station had no frame, or could not use it."""
    away: int = 0
    """Its station was absent."""
    lost: int = 0
    """Its message did not come in time."""
    late: int = 0
    """Messages that came after their set."""
    aged: int = 0
    """Messages that were too old."""
    doubled: int = 0
    """Messages that came twice."""


@dataclass
class MergeStatistics:
    """Counts so far."""

    sets: int = 0
    complete: int = 0
    unseen: int = 0
    """Pulses between sets for which no message came at all."""
    cameras: dict[str, CameraMerge] = field(default_factory=dict)


class Merger:
    """Takes messages and gives sets of ``cameras``; ``away(camera)``: whether its station is not waited for."""

    def __init__(
        self, cameras: Sequence[str], away: Callable[[str], bool], settings: MergeSettings | None = None
    ) -> None:
        self.settings = settings or MergeSettings()
        self.statistics = MergeStatistics(cameras={name: CameraMerge() for name in cameras})
        self._cameras = tuple(cameras)
        self._away = away
        self._open: dict[int, dict[str, Arrived]] = {}
        self._since_ns: dict[int, int] = {}
        self._newest = dict.fromkeys(cameras, -1)
        self._next: int | None = None

    def take(self, item: Arrived) -> None:
        """Put a message of one of the cameras into its set, or count the reason why that is not possible."""
        name = item.detections.camera
        count = self.statistics.cameras[name]
        self._newest[name] = max(self._newest[name], item.pulse)
        if not item.buffered and item.received_ns - item.arrival_ns > self.settings.oldest_s * 1e9:
            count.aged += 1
            return
        if self._next is not None and item.pulse < self._next:
            count.late += 1
            return
        here = self._open.setdefault(item.pulse, {})
        if name in here:
            count.doubled += 1
            return
        here[name] = item
        self._since_ns.setdefault(item.pulse, item.received_ns)

    def restarted(self, cameras: Sequence[str]) -> None:
        """Forget how far the messages of ``cameras`` had come: their station began anew."""
        for name in cameras:
            self._newest[name] = -1

    def ready(self, now_ns: int) -> list[MergedSet]:
        """Return, in order, the sets that are complete or have waited long enough."""
        sets = []
        while self._open:
            pulse = min(self._open)
            if self._waits(pulse) and now_ns - self._since_ns[pulse] < self.settings.deadline_s * 1e9:
                break
            sets.append(self._close(pulse, now_ns))
        return sets

    def rest(self, now_ns: int) -> list[MergedSet]:
        """Return the remaining sets when no more messages come."""
        return [self._close(pulse, now_ns) for pulse in sorted(self._open)]

    def next_deadline_ns(self) -> int | None:
        """Return when a set has waited long enough; None where none waits."""
        if not self._open:
            return None
        return self._since_ns[min(self._open)] + round(self.settings.deadline_s * 1e9)

    def _waits(self, pulse: int) -> bool:
        here = self._open[pulse]
        return any(
            name not in here and self._newest[name] <= pulse and not self._away(name) for name in self._cameras
        )

    def _close(self, pulse: int, now_ns: int) -> MergedSet:
        here = self._open.pop(pulse)
        del self._since_ns[pulse]
        if self._next is not None:
            self.statistics.unseen += pulse - self._next
        self._next = pulse + 1
        whole: dict[str, Arrived] = {}
        missing: dict[str, str] = {}
        for name in self._cameras:
            count, item = self.statistics.cameras[name], here.get(name)
            if item is not None and item.status == "detected":
                count.merged += 1
                whole[name] = item
            elif item is not None:
                count.no_frame += 1
                missing[name] = item.status
            elif self._away(name):
                count.away += 1
                missing[name] = "station away"
            else:
                count.lost += 1
                missing[name] = "not in time"
        self.statistics.sets += 1
        self.statistics.complete += not missing
        times = sorted(item.time_ns for item in (whole or here).values())
        return MergedSet(
            pulse,
            (times[(len(times) - 1) // 2] + times[len(times) // 2]) // 2,
            {name: item.detections for name, item in whole.items()},
            missing,
            now_ns,
            {name: item.arrival_ns for name, item in whole.items()},
            {name: item.sent_ns for name, item in whole.items()},
        )
