"""The reconstructing station's end: receives from all stations, aligns their pulse numbers, and merges.

One thread merges; one per station queries its clock, health and rig file. Callbacks of the engine only queue.
Events of a station are passed to ``on_event`` and kept (``events``); a lost station costs only its cameras.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Self

from hardware.transport.listener import Listener
from hardware.transport.merger import MergedSet
from hardware.transport.messages import NOT_YET, YES, MessageError, pack_clock, unpack_clock, unpack_heard
from hardware.transport.signed import SignedTransport
from hardware.transport.station_state import Event, ReceiverSettings, ReceiverStatistics
from hardware.transport.transport import (
    EVERYTHING,
    HEARD,
    Transport,
    check_station,
    check_stations,
    key_of,
    station_of,
    word_of,
)

BURST, BURST_S = 10, 0.02
ASK_S = 0.5
LOOK_NS = 20_000_000
LINGER_S = 0.2
"""Longest time for which last messages may be under way after the last station has ended."""
INBOX = 20_000


class Receiver:
    """Merged sets of ``cameras`` (name -> width, height) as ``stations`` see them; iterate once.

    ``rig``: text of this station's rig file, the answer to queries for it; ``name``: this station's. ``rate_hz``: of
    the pulses; None: as the stations state it. Ends the transport when it is closed.
    """

    def __init__(
        self,
        transport: Transport,
        stations: Sequence[str],
        cameras: Mapping[str, tuple[int, int]],
        rate_hz: float | None = None,
        settings: ReceiverSettings | None = None,
        rig: str = "",
        name: str = "reconstruct",
        on_event: Callable[[Event], None] = lambda event: None,
    ) -> None:
        check_stations(stations)
        self.settings = settings or ReceiverSettings()
        self._transport = transport
        self._listener = Listener(stations, cameras, rate_hz, self.settings, time.monotonic_ns(), on_event)
        self.statistics = ReceiverStatistics(
            MappingProxyType({name: state.statistics for name, state in self._listener.states.items()}),
            self._listener.merger.statistics,
        )
        self._inbox: queue.SimpleQueue[tuple[str, str, object, int]] = queue.SimpleQueue()
        self._out: deque[MergedSet] = deque()
        self._changed = threading.Condition()
        self._over = False
        self._failed: Exception | None = None
        self._stop, self._closed = threading.Event(), False
        if isinstance(transport, SignedTransport):
            transport.on_refused = lambda station, why: self._post("refused", station, why)
        transport.declare_queryable(key_of(check_station(name), "rig"), lambda _: rig.encode())
        transport.declare_queryable(HEARD, self._received_to_end)
        transport.subscribe(EVERYTHING, self._published)
        self._threads = [threading.Thread(target=self._merge, name="merge", daemon=True)]
        self._threads += [
            threading.Thread(target=self._attend, args=(n,), name=f"clock of {n}", daemon=True) for n in stations
        ]
        for thread in self._threads:
            thread.start()

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened to the stations so far."""
        return tuple(self._listener.events)

    @property
    def rate_hz(self) -> float | None:
        """Rate of the pulses, None while no station has sent it."""
        return self._listener.rate_hz

    @property
    def start_ns(self) -> int | None:
        """Time of the session's pulse 0 by this machine's clock [ns], late by the transport time of its frames."""
        return None if self._listener.pulses is None else self._listener.pulses.start_ns

    def rigs(self, timeout_s: float) -> dict[str, str]:
        """Wait for the rig files (text) of all stations; return those received."""
        until = time.monotonic() + timeout_s
        while len(self._listener.rigs) < len(self._listener.states) and time.monotonic() < until:
            time.sleep(0.02)
        return dict(self._listener.rigs)

    def __iter__(self) -> Iterator[MergedSet]:
        """Yield merged sets in order until all stations have ended, or ``stop``; raise what ended the merging."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._out or self._over)
                if not self._out:
                    break
                merged = self._out.popleft()
            yield merged
        if self._failed is not None:
            raise self._failed

    def to_local(self, station: str, remote_ns: int) -> int:
        """Return this machine's time [ns] when a station's clock showed ``remote_ns``."""
        return self._listener.states[station].clock.to_local(remote_ns)

    def stop(self) -> None:
        """End the iteration after the sets received so far; may be called from another thread."""
        self._stop.set()
        self._post("stop", "", None)

    def close(self) -> None:
        """Stop and leave; may be called twice."""
        if self._closed:
            return
        self._closed = True
        self.stop()
        for thread in self._threads:
            thread.join()
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _published(self, key: str, data: bytes) -> None:
        kind = {"detections": "message", "health": "health"}.get(word_of(key))
        if kind is not None:
            self._post(kind, station_of(key), data)

    def _post(self, kind: str, station: str, what: object) -> None:
        if self._inbox.qsize() > INBOX and kind == "message":
            self.statistics.overrun += 1
            return
        self._inbox.put((kind, station, what, time.monotonic_ns()))

    def _received_to_end(self, question: bytes) -> bytes:
        if self._over or self._stop.is_set():  # the consumer has ended
            return YES
        try:
            heard = self._listener.received_to_end(*unpack_heard(question))
        except MessageError:  # not a query of a station
            return YES
        return YES if heard else NOT_YET

    def _attend(self, station: str) -> None:
        """Query one station's clock repeatedly, its rig and health once for each start, and order its start."""
        key, asked = key_of(station, "clock"), 0
        epoch: int | None = None
        now_epoch: int | None
        ordered: int | None = None
        while not self._stop.is_set():
            before = time.monotonic_ns()
            answer = self._transport.query(key, b"", ASK_S)
            after = time.monotonic_ns()
            if answer is not None:
                self._post("clock", station, (answer, before, after))
                try:
                    now_epoch = unpack_clock(answer)[0]
                except MessageError:  # noted by the thread that merges
                    now_epoch = epoch
                if now_epoch != epoch:
                    rig = self._transport.query(key_of(station, "rig"), b"", ASK_S)
                    health = self._transport.query(key_of(station, "health"), b"", ASK_S)
                    if rig is not None and health is not None:
                        self._post("rig", station, rig)
                        self._post("health", station, health)
                        epoch, asked = now_epoch, 0
                start_ns, state = self._listener.start_ns, self._listener.states[station]
                timed = self._listener.timed(station)
                if ordered != epoch and epoch is not None and start_ns is not None and timed:
                    order = pack_clock(epoch, state.clock.to_remote(start_ns))
                    ordered = epoch if self._transport.query(key_of(station, "start"), order, ASK_S) else None
                asked += 1
                burst = asked < BURST or not timed
            else:
                burst = False
            self._stop.wait(BURST_S if burst else self.settings.clock_s)

    def _merge(self) -> None:
        """Merge to the end; an error is raised where the sets are consumed."""
        try:
            self._work()
        except Exception as error:
            self._failed = error
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _work(self) -> None:
        """Take input in order; no other thread uses the listener."""
        listener = self._listener
        ended_ns: int | None = None
        looked_ns = 0
        while not self._stop.is_set():
            due_ns = listener.merger.next_deadline_ns()
            wait_s = 0.05 if due_ns is None else min(max((due_ns - time.monotonic_ns()) * 1e-9, 1e-4), 0.05)
            try:
                kind, station, what, received_ns = self._inbox.get(timeout=wait_s)
            except queue.Empty:
                pass
            else:
                if kind != "stop":
                    listener.take(kind, station, what, received_ns)
            now_ns = time.monotonic_ns()
            self._hand_out(listener.merger.ready(now_ns))
            if now_ns - looked_ns < LOOK_NS:
                continue
            looked_ns = now_ns
            listener.check(now_ns)
            self._count_refused()
            if not listener.all_ended:
                ended_ns = None
            elif ended_ns is None:
                ended_ns = now_ns
            elif now_ns - ended_ns > LINGER_S * 1e9:
                break
        while not self._inbox.empty():
            kind, station, what, received_ns = self._inbox.get()
            if kind != "stop":
                listener.take(kind, station, what, received_ns)
        self._hand_out(listener.rest(time.monotonic_ns()))
        self._count_refused()

    def _count_refused(self) -> None:
        if isinstance(self._transport, SignedTransport):
            for station, statistics in self.statistics.stations.items():
                statistics.forged = self._transport.refused[station]
            named = sum(statistics.forged for statistics in self.statistics.stations.values())
            self.statistics.strangers = self._transport.refused.total() - named

    def _hand_out(self, sets: Sequence[MergedSet]) -> None:
        if not sets:
            return
        with self._changed:
            self._out.extend(sets)
            while len(self._out) > self.settings.queued:
                self._out.popleft()
                self.statistics.left_out += 1
            self._changed.notify()
