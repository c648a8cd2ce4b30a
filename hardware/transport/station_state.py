"""State of each other station at the reconstructing one: presence, clock model, and counts of its messages."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from hardware.transport.clock import RemoteClock
from hardware.transport.merger import MergeSettings, MergeStatistics
from hardware.transport.messages import DetectionMessage, HealthMessage

MOST_PENDING = 4000
"""Messages that may wait until their station's clock and pulse shift are known; older ones are dropped."""
CLOCK_SHARE = 0.1
"""Required uncertainty of a station's clock, in periods, before its frames get pulse numbers."""


@dataclass(frozen=True)
class ReceiverSettings:
    """Waiting times of the receiver."""

    merge: MergeSettings = field(default_factory=MergeSettings)
    silence_s: float = 0.5
    """A station that sends nothing for so long is noted and not waited for."""
    start_wait_s: float = 15.0
    """How long the start waits for stations."""
    clock_s: float = 0.2
    """Interval of clock queries."""
    queued: int = 50
    """Merged sets that may wait for the consumer; then the oldest is left out and counted."""


@dataclass(frozen=True)
class Event:
    """Something that happened to a station."""

    time_ns: int
    station: str
    kind: str
    """One of appeared, back, silent, ended, place, error, note."""
    text: str


@dataclass
class StationStatistics:
    """Counts of one station's messages, to be read at any time."""

    received: int = 0
    lost: int = 0
    """Sequence numbers that were not received."""
    unplaced: int = 0
    """Messages dropped before their pulse was known."""
    stale: int = 0
    """Messages of an earlier start."""
    unconfirmed: int = 0
    """Messages of a start that the station did not confirm: forged, or of a session that is over."""
    forged: int = 0
    """Messages in its name that were not signed, or sent again (``hardware.transport.signed``)."""
    spoilt: int = 0
    """Messages that could not be read."""
    refused: int = 0
    """Messages that its engine did not take, by its own count."""
    skipped: int = 0
    """Frames that it did not process, by its own count."""
    silent: int = 0
    """Number of its silences."""
    starts: int = 0
    clock_error_ns: float = float("nan")
    """Uncertainty of its clock against this one [ns]."""
    clock_skew: float = 0.0


@dataclass
class ReceiverStatistics:
    """Counts of all messages."""

    stations: Mapping[str, StationStatistics]
    merge: MergeStatistics
    left_out: int = 0
    """Sets that were not consumed in time."""
    strangers: int = 0
    """Refused messages under names that are no station's."""
    overrun: int = 0
    """Messages dropped at a full queue."""


@dataclass
class StationState:
    """One station as it is now; used by one thread."""

    name: str
    statistics: StationStatistics = field(default_factory=StationStatistics)
    clock: RemoteClock = field(default_factory=RemoteClock)
    health: HealthMessage | None = None
    epoch: int | None = None
    earlier: set[int] = field(default_factory=set)
    silent: bool = False
    heard: bool = False
    """Whether anything of its start was taken since the last check."""
    heard_ns: int | None = None
    confirmed_ns: int = 0
    """When its clock was last asked and answered under this epoch."""
    held: deque[tuple[DetectionMessage, int]] = field(default_factory=deque)
    """Messages under an epoch that its clock has not confirmed yet."""
    quiet_ns: int = 0
    aligned_ns: int = 0
    pending: deque[tuple[DetectionMessage, int]] = field(default_factory=deque)
    voted: int = 0
    expected: dict[str, int] = field(default_factory=dict)

    @property
    def away(self) -> bool:
        """True where nothing can be expected of it: it is silent, has ended or was never present."""
        return self.epoch is None or self.silent or self.ended

    @property
    def ended(self) -> bool:
        """True where it has sent its last message."""
        return self.health is not None and self.health.state in ("ended", "failed")

    @property
    def settled(self) -> bool:
        """True where it waits for the order to start or for frames, or is in a later state."""
        return self.health is not None and self.health.state != "starting"

    def timed(self, period_ns: float) -> bool:
        """Return whether its cameras are known, and its clock well enough for pulses that are ``period_ns`` apart."""
        return self.health is not None and self.clock.certain(CLOCK_SHARE * period_ns)

    def received_to_end(self, epoch: int) -> bool:
        """Return whether nothing more is expected of the start ``epoch``."""
        return epoch in self.earlier or (epoch == self.epoch and self.ended)

    def begins(self, epoch: int) -> None:
        """Forget what was known of an earlier start."""
        if self.epoch is not None:
            self.earlier.add(self.epoch)
        self.earlier.discard(epoch)
        self.epoch = epoch
        self.statistics.starts += 1
        self.clock = RemoteClock()
        self.health = None
        self.drop_pending()
        self.expected.clear()

    def count(self, message: DetectionMessage) -> None:
        """Count a message, and those that its number shows to be lost."""
        self.statistics.received += 1
        camera = message.detections.camera
        expected = self.expected.get(camera, 0)
        self.statistics.lost += max(message.sequence - expected, 0)
        self.expected[camera] = max(message.sequence + 1, expected)

    def count_rest(self) -> None:
        """Count messages that were sent, by the station's last message of health, but not received."""
        if self.health is None:
            return
        for camera in self.health.cameras:
            expected = self.expected.get(camera.name, 0)
            self.statistics.lost += max(camera.sent - expected, 0)
            self.expected[camera.name] = max(camera.sent, expected)

    def hold(self, message: DetectionMessage, received_ns: int) -> None:
        """Keep a message until an answer of the station's clock confirms its epoch."""
        self.held.append((message, received_ns))
        if len(self.held) > MOST_PENDING:
            self.held.popleft()
            self.statistics.unconfirmed += 1

    def take_held(self) -> list[tuple[DetectionMessage, int]]:
        """Return the held messages of the present epoch; drop others that came before its clock was asked.

        A station that answers after such a message came has not ended since, so the message has another sender.
        """
        mine = [item for item in self.held if item[0].epoch == self.epoch]
        waiting = [item for item in self.held if item[0].epoch != self.epoch and item[1] >= self.confirmed_ns]
        self.statistics.unconfirmed += len(self.held) - len(mine) - len(waiting)
        self.held = deque(waiting)
        return mine

    def add_pending(self, message: DetectionMessage, received_ns: int) -> None:
        """Keep a message until its pulse is known."""
        self.pending.append((message, received_ns))
        if len(self.pending) > MOST_PENDING:
            self.pending.popleft()
            self.voted = max(self.voted - 1, 0)
            self.statistics.unplaced += 1

    def drop_pending(self) -> None:
        """Drop messages that still wait."""
        self.statistics.unplaced += len(self.pending)
        self.pending.clear()
        self.voted = 0
