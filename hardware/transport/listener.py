"""State of the reconstructing station: which stations are present, pulse alignment, and merged sets.

All input comes in order through ``take``; this module uses no threads and no network. Events of a station are passed
on and kept (``events``); a lost station costs only its cameras.
"""

import logging
from collections.abc import Callable, Mapping, Sequence

from hardware.transport.merger import Arrived, MergedSet, Merger
from hardware.transport.messages import (
    DetectionMessage,
    HealthMessage,
    MessageError,
    StationCamera,
    unpack_clock,
    unpack_detections,
    unpack_health,
)
from hardware.transport.pulse_alignment import StationPulses
from hardware.transport.station_state import Event, ReceiverSettings, StationState

log = logging.getLogger("mosca.hardware.stations")
COUNTDOWN_NS = 500_000_000
"""Time from when all stations are ready to the ordered start, since the order has to reach them all."""

MOST_QUIET_NS = 50_000_000
"""Largest silence that one check adds to a station: a longer interval means that this process was stalled, and it
cannot judge silence then."""

TWO_VOICES = "speaks with two voices: do two stations have this name?"


class Listener:
    """States of ``stations`` that show ``cameras`` (name -> width, height); used by one thread.

    ``start_ns``: when the stations are to start, by this machine's clock, once all are ready.
    ``rate_hz``: of the pulses; None takes the stations' rate. ``on_event`` is called with each event.
    """

    def __init__(
        self,
        stations: Sequence[str],
        cameras: Mapping[str, tuple[int, int]],
        rate_hz: float | None,
        settings: ReceiverSettings,
        opened_ns: int,
        on_event: Callable[[Event], None],
    ) -> None:
        self.settings = settings
        self.events: list[Event] = []
        self.rigs: dict[str, str] = {}
        self.rate_hz = rate_hz
        self.start_ns: int | None = None
        self.states = {station: StationState(station) for station in stations}
        self.merger = Merger(tuple(cameras), self._camera_away, settings.merge)
        self.pulses: StationPulses | None = None
        self._on_event, self._sizes = on_event, dict(cameras)
        self._owner: dict[str, str] = {}
        self._opened_ns = self._now_ns = self._checked_ns = opened_ns

    @property
    def all_ended(self) -> bool:
        """True where every station has sent its last message."""
        return all(state.ended for state in self.states.values())

    def timed(self, station: str) -> bool:
        """Return whether a station's cameras are known, and its clock well enough for the rate of the pulses."""
        return self.rate_hz is not None and self.states[station].timed(1e9 / self.rate_hz)

    def received_to_end(self, station: str, epoch: int) -> bool:
        """Return whether nothing more is expected of a station's start ``epoch``, or the station was not named."""
        state = self.states.get(station)
        return state is None or state.received_to_end(epoch)

    def rest(self, now_ns: int) -> list[MergedSet]:
        """Return the remaining sets when no more messages come, and close the counts."""
        sets = self.merger.rest(now_ns)
        for state in self.states.values():
            state.drop_pending()
            if state.ended:
                state.count_rest()
        return sets

    def take(self, kind: str, station: str, what: object, received_ns: int) -> None:
        """Take a "message", "health", "clock" (answer, asked, answered) or "rig"."""
        self._now_ns = received_ns
        state = self.states.get(station)
        if state is None:
            if kind == "message":
                self._note_once(station, "error", "is none of the stations that were named; it is not listened to")
            return
        try:
            match kind, what:
                case "message", bytes():
                    self._take_message(state, unpack_detections(what), received_ns)
                case "refused", str():
                    self._note_once(station, "error", what)
                case "health", bytes():
                    self._take_health(state, unpack_health(what), received_ns)
                case "clock", (bytes() as answer, int() as asked_ns, int() as answered_ns):
                    self._take_clock(state, answer, asked_ns, answered_ns)
                case "rig", bytes():
                    self.rigs[station] = what.decode()
        except (MessageError, UnicodeDecodeError) as error:
            state.statistics.spoilt += 1
            self._note_once(station, "error", f"sends what cannot be read: {error}")

    def _take_message(self, state: StationState, message: DetectionMessage, received_ns: int) -> None:
        if not self._of_this_start(state, message.epoch, received_ns):
            if message.epoch not in state.earlier:
                state.hold(message, received_ns)
            return
        state.count(message)
        if state.pending or not self._align(state, message, received_ns):
            state.add_pending(message, received_ns)

    def _of_this_start(self, state: StationState, epoch: int, received_ns: int, answer: bool = False) -> bool:
        """Note that the station sends; False for a message of an earlier start, or of one that is not confirmed.

        Only an ``answer`` to a query of its clock begins a start, since a message may be forged or sent again.
        """
        quiet = received_ns - state.confirmed_ns > self.settings.silence_s * 1e9
        if epoch in state.earlier and not (answer and quiet):
            state.statistics.stale += 1
            if received_ns - (state.heard_ns or 0) < self.settings.silence_s * 1e9:
                self._note_once(state.name, "error", TWO_VOICES)
            return False
        if not answer and epoch != state.epoch:
            return False
        if epoch != state.epoch:
            first = state.epoch is None
            state.begins(epoch)
            if self.pulses is not None:
                self.pulses.restarted(state.name)
            self.merger.restarted([name for name, owner in self._owner.items() if owner == state.name])
            self._note(state.name, "appeared" if first else "back", "is here" if first else "has started again")
        elif state.silent and received_ns > (state.heard_ns or 0):
            self._note(
                state.name, "back", f"is heard again after {(received_ns - (state.heard_ns or 0)) / 1e9:.2f} s"
            )
        state.silent, state.heard = False, True
        state.heard_ns = received_ns
        return True

    def _align(self, state: StationState, message: DetectionMessage, received_ns: int) -> bool:
        """Deliver a message under its pulse; False while that is not known."""
        pulses = self.pulses
        if pulses is None or not self.timed(state.name) or pulses.shift(state.name) is None:
            return False
        arrival_ns = state.clock.to_local(message.arrival_ns)
        pulses.take(state.name, message.epoch, message.pulse, arrival_ns - message.exposure_ns)
        self._note_alignment(pulses)
        shift = pulses.shift(state.name)
        if shift is None:  # it counts wrongly: it votes again
            return False
        ahead_ns = (pulses.start_ns or 0) + (message.pulse + shift) * pulses.period_ns - arrival_ns
        if ahead_ns > self.settings.merge.oldest_s * 1e9:  # sets of earlier pulses would not be waited for
            state.statistics.spoilt += 1
            self._note_once(state.name, "error", "sends pulses that are not due yet; they are left out")
            return True
        # what waited at the station itself follows in a burst
        buffered = arrival_ns < state.aligned_ns
        self._deliver(state, message, received_ns, (shift, pulses.period_ns), buffered)
        return True

    def _deliver(
        self,
        state: StationState,
        message: DetectionMessage,
        received_ns: int,
        alignment: tuple[int, float],
        buffered: bool,
    ) -> None:
        """Pass a message to the merger; ``alignment``: the station's shift, and the period of the pulses [ns]."""
        shift, period_ns = alignment
        if self._owner.get(message.detections.camera) != state.name:
            return  # noted when its station listed its cameras
        self.merger.take(
            Arrived(
                message.pulse + shift,
                message.time_ns + round(shift * period_ns),
                state.clock.to_local(message.arrival_ns),
                state.clock.to_local(message.sent_ns),
                received_ns,
                message.status,
                message.detections,
                buffered,
            )
        )

    def _release(self) -> None:
        """Deliver pending messages whose pulses are known by now, in order of pulses."""
        pulses = self.pulses
        if pulses is None:
            return
        for state in self.states.values():
            if not self.timed(state.name) or pulses.shift(state.name) is not None:
                continue
            for message, _ in list(state.pending)[state.voted :]:
                here = state.clock.to_local(message.arrival_ns) - message.exposure_ns
                pulses.take(state.name, message.epoch, message.pulse, here)
            state.voted = len(state.pending)
        self._note_alignment(pulses)
        free: list[tuple[StationState, DetectionMessage, int, int]] = []
        for state in self.states.values():
            shift = pulses.shift(state.name)
            if state.pending and shift is not None:
                free += [(state, message, received, shift) for message, received in state.pending]
                state.pending.clear()
                state.voted, state.aligned_ns = 0, self._now_ns
        for state, message, received_ns, shift in sorted(free, key=lambda one: one[2]):
            self._deliver(state, message, received_ns, (shift, pulses.period_ns), buffered=True)

    def _take_health(self, state: StationState, health: HealthMessage, received_ns: int) -> None:
        if not self._of_this_start(state, health.epoch, received_ns):
            return
        before, state.health = state.health, health
        state.statistics.refused, state.statistics.skipped = health.refused, health.skipped
        if before is None:
            self._take_cameras(state, health.cameras)
        known = () if before is None else before.notes
        for note in health.notes[_overlap(known, health.notes) :]:
            self._note(state.name, "note", note)
        if state.ended and (before is None or before.state != health.state):
            state.count_rest()
            self._note(state.name, "ended", "has failed" if health.state == "failed" else "has ended")

    def _take_cameras(self, state: StationState, cameras: Sequence[StationCamera]) -> None:
        """Note whose cameras these are; one that cannot be merged is noted and ignored."""
        for camera in cameras:
            self.rate_hz = camera.rate_hz if self.rate_hz is None else self.rate_hz
            wrong = self._wrong(state, camera, self.rate_hz)
            if wrong:
                self._note(state.name, "error", f"camera '{camera.name}' {wrong}; it is ignored")
            else:
                self._owner[camera.name] = state.name
        if self.pulses is None and self.rate_hz is not None:
            self.pulses = StationPulses(tuple(self.states), self.rate_hz, self.settings.start_wait_s)

    def _wrong(self, state: StationState, camera: StationCamera, rate_hz: float) -> str:
        """Return why a camera cannot be merged, "" where it can."""
        owner = self._owner.get(camera.name, state.name)
        if owner != state.name:
            return f"is station '{owner}''s"
        if camera.name not in self._sizes:
            return f"is not in the rig, which has {', '.join(self._sizes)}"
        size = (camera.width, camera.height)
        if self._sizes[camera.name] != size:
            wide, high = self._sizes[camera.name]
            return f"has images of {size[0]} x {size[1]}, the rig file says {wide} x {high}: calibrate at this size"
        if abs(camera.rate_hz / rate_hz - 1) > 1e-3:
            return f"states {camera.rate_hz:g} pulses/s, {rate_hz:g} are expected"
        return ""

    def _take_clock(self, state: StationState, answer: bytes, asked_ns: int, answered_ns: int) -> None:
        epoch, remote_ns = unpack_clock(answer)
        if not self._of_this_start(state, epoch, answered_ns, answer=True):
            return
        state.confirmed_ns = asked_ns
        held = len(state.held)
        for message, received_ns in state.take_held():
            self._take_message(state, message, received_ns)
            held -= 1
        if len(state.held) < held:
            self._note_once(state.name, "error", TWO_VOICES)
        state.clock.take(asked_ns, remote_ns, answered_ns)
        state.statistics.clock_error_ns, state.statistics.clock_skew = state.clock.error_ns, state.clock.skew

    def check(self, now_ns: int) -> None:
        """Note silent stations, allow the start, and release what is pending."""
        self._now_ns = now_ns
        passed_ns, self._checked_ns = now_ns - self._checked_ns, now_ns
        for state in self.states.values():
            if state.heard_ns is None or state.silent or state.ended:
                state.quiet_ns = 0
                continue
            # counts messages taken since the last check, not arrival times: this thread may be behind
            state.quiet_ns = 0 if state.heard else state.quiet_ns + min(passed_ns, MOST_QUIET_NS)
            state.heard = False
            if state.quiet_ns > self.settings.silence_s * 1e9:
                state.silent = True
                state.statistics.silent += 1
                why = "its program or its network ended; it is not waited for"
                self._note(state.name, "silent", f"is silent for {self.settings.silence_s:g} s: {why}")
        waited = now_ns - self._opened_ns > self.settings.start_wait_s * 1e9
        if self.start_ns is None and (waited or all(state.settled for state in self.states.values())):
            for state in self.states.values():
                if not state.settled:
                    self._note(state.name, "error", "is not ready; the session starts without it")
            self.start_ns = now_ns + COUNTDOWN_NS
        if any(state.pending for state in self.states.values()):
            if self.pulses is not None and not self.pulses.started:
                self.pulses.try_start(now_ns)
            self._release()

    def _note_alignment(self, pulses: StationPulses) -> None:
        for station, text in pulses.notes:
            self._note(station, "place", text)
        pulses.notes.clear()

    def _camera_away(self, camera: str) -> bool:
        owner = self._owner.get(camera)
        if owner is None or self.states[owner].away:
            return True
        return self.pulses is None or self.pulses.shift(owner) is None

    def _note_once(self, station: str, kind: str, text: str) -> None:
        if not any(event.station == station and event.text == text for event in self.events):
            self._note(station, kind, text)

    def _note(self, station: str, kind: str, text: str) -> None:
        event = Event(self._now_ns, station, kind, text)
        log.log(logging.INFO if kind in ("appeared", "ended") else logging.WARNING, "station %s: %s", station, text)
        self.events.append(event)
        self._on_event(event)


def _overlap(known: Sequence[str], notes: Sequence[str]) -> int:
    """Return how many of ``notes`` overlap with the end of ``known``: a sliding window."""
    for shared in range(min(len(known), len(notes)), 0, -1):
        if tuple(known[-shared:]) == tuple(notes[:shared]):
            return shared
    return 0
