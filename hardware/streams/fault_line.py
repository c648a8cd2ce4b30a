"""Execution of faults: on a frame's content, on the way of its messages, and on the server."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hardware.streams.faults import FaultAccount, StreamFaults, check_names
from hardware.streams.moved_camera import MovedCamera
from hardware.streams.stream_server import Outgoing, StreamServer
from hardware.streams.values import (
    MARKER,
    SEEN,
    TRACKED,
    UNLABELLED,
    StreamedBody,
    StreamedSet,
    StreamFrame,
    StreamModel,
)
from mosca.data.arrays import Array

GHOSTS = 60_000
"""First number of ghosts, markers that do not exist."""


class FaultLine:
    """The faults that a stream passes through; ``accounts``: a record of each fault.

    ``numbers``: the marker number of each label (``StreamContent.numbers``). InputError for a name that is unknown.
    """

    def __init__(self, faults: StreamFaults, model: StreamModel, numbers: Mapping[str, int]) -> None:
        bodies = [one.name for one in model if isinstance(one, StreamedBody)]
        check_names(faults.program, list(numbers), bodies)
        self.accounts = tuple(FaultAccount(fault) for fault in faults.program)
        self._random = [np.random.default_rng([faults.seed, k]) for k in range(len(self.accounts))]
        self._numbers = dict(numbers)
        self._bodies = {one.name: one.number for one in model if isinstance(one, StreamedBody)}
        self._members = {one.name: one.markers for one in model if isinstance(one, StreamedSet)}
        self._gained_ns: dict[int, int] = {}
        self._kept: dict[int, Array] = {}
        self._ghosts: dict[int, Array] = {}
        self._moved: dict[int, MovedCamera] = {}
        self._restarts: set[int] = set()
        self._base: int | None = 0
        self._down = False
        self._last_s = 0.0
        self._held: list[tuple[float, Outgoing]] = []

    def steer(self, server: StreamServer, at_s: float) -> None:
        """Set the server's clock and line, and stop or start it, as due ``at_s`` [s] after the first frame."""
        offset_ns, lost, down = 0, False, False
        for k, account in enumerate(self.accounts):
            fault = account.fault
            match fault.fault:
                case "clock-offset" if fault.active(at_s):
                    offset_ns += round(fault.amount * 1e9)
                    account.add(at_s)
                case "clock-drift" if at_s >= fault.at_s:
                    gained = (min(at_s, fault.until_s) - fault.at_s) * fault.amount * 1e3
                    offset_ns += round(gained)
                    if fault.active(at_s):
                        account.add(at_s)
                case "connection-lost" if fault.active(at_s):
                    lost = True
                    account.add(at_s)
                case "restart" if fault.active(at_s):
                    down = True
                    account.add(at_s)
                    if k not in self._restarts:
                        self._restarts.add(k)
                        server.shut()
        if self._down and not down:
            server.start()
            self._base = None
        self._down = down
        server.set_line(offset_ns, lost)

    def changed(self, frame: StreamFrame, at_s: float) -> StreamFrame:
        """Return the frame with its content as changed by faults."""
        if self._base is None:
            self._base = frame.number
        if self._base:
            frame = replace(frame, number=frame.number - self._base)
        for k, account in enumerate(self.accounts):
            fault = account.fault
            if not fault.active(at_s):
                self._kept.pop(k, None)
                continue
            match fault.fault:
                case "label-swap":
                    pair = fault.names or tuple(self._numbers)[:2]
                    frame = self._labels_swapped(frame, pair)
                case "ghosts":
                    frame = self._with_ghosts(frame, k, int(fault.amount))
                case "body-lost":
                    frame = self._without_body(frame, k, fault.names or tuple(self._bodies)[:1])
                case "body-swap":
                    frame = self._bodies_swapped(frame, fault.names or tuple(self._bodies)[:2])
                case "camera-moved":
                    if k not in self._moved:
                        self._moved[k] = MovedCamera(frame, fault.amount)
                    frame = self._moved[k].seen(frame)
                case _:
                    continue
            account.add(at_s)
        return frame

    def routed(self, outgoing: Outgoing, at_s: float, period_s: float) -> list[tuple[float, Outgoing]]:
        """Return the messages to deliver now, in order, each with its delay [s].

        ``period_s``: time between frames, for the number of frames that have passed since a fault began.
        """
        copies, delay, swaps = 1, 0.0, False
        for account, random in zip(self.accounts, self._random, strict=True):
            fault = account.fault
            if not fault.active(at_s):
                continue
            since = round((at_s - fault.at_s) / period_s)
            acts = True
            match fault.fault:
                case "latency":
                    delay += fault.amount
                case "jitter":
                    delay += float(random.uniform(0.0, fault.amount))
                case "burst-loss":
                    acts = (since % max(1, round(1.0 / period_s))) < fault.amount
                    copies = 0 if acts else copies
                case "half-rate":
                    acts = since % 2 == 1
                    copies = 0 if acts else copies
                case "duplicate":
                    acts = (since + 1) % int(fault.amount) == 0
                    copies = 2 if acts and copies else copies
                case "reorder":
                    acts = (since + 1) % int(fault.amount) == 0 and not self._held
                    swaps = swaps or acts
                case _:
                    continue
            if acts:
                account.add(at_s)
        now = [(delay, outgoing)] * copies
        if swaps:
            self._held = now
            return []
        held, self._held = self._held, []
        return now + held

    def rest(self) -> list[tuple[float, Outgoing]]:
        """Return what is still held back when the stream ends."""
        held, self._held = self._held, []
        return held

    def _labels_swapped(self, frame: StreamFrame, pair: Sequence[str]) -> StreamFrame:
        a, b = (self._numbers[name] for name in pair)
        markers = frame.markers.copy()
        is_a, is_b = markers["id"] == a, markers["id"] == b
        markers["id"][is_a], markers["id"][is_b] = b, a
        sets = []
        for name, xyz in frame.marker_sets:
            members = self._members[name]
            if all(one in members for one in pair):
                rows = [members.index(one) for one in pair]
                xyz = xyz.copy()
                xyz[rows] = xyz[rows[::-1]]
            sets.append((name, xyz))
        return replace(frame, markers=markers, marker_sets=tuple(sets))

    def _with_ghosts(self, frame: StreamFrame, k: int, count: int) -> StreamFrame:
        if k not in self._ghosts:
            there = frame.markers["position"] if len(frame.markers) else np.zeros((1, 3))
            made = np.zeros(count, MARKER)
            made["position"] = self._random[k].uniform(there.min(axis=0), there.max(axis=0), (count, 3))
            made["id"], made["params"] = GHOSTS + np.arange(count), SEEN | UNLABELLED
            self._ghosts[k] = made
        ghosts = self._ghosts[k]
        return replace(
            frame,
            markers=np.concatenate([frame.markers, ghosts]),
            other=np.concatenate([frame.other, ghosts["position"]]),
        )

    def _without_body(self, frame: StreamFrame, k: int, names: Sequence[str]) -> StreamFrame:
        bodies = frame.bodies.copy()
        mine = np.isin(bodies["id"], [self._bodies[name] for name in names])
        kept = self._kept.setdefault(k, bodies[mine].copy())
        bodies[mine] = kept
        bodies["params"][mine] &= ~np.uint16(TRACKED)
        return replace(frame, bodies=bodies)

    def _bodies_swapped(self, frame: StreamFrame, pair: Sequence[str]) -> StreamFrame:
        a, b = (self._bodies[name] for name in pair)
        bodies = frame.bodies.copy()
        rows = [int(np.flatnonzero(bodies["id"] == one)[0]) for one in (a, b)]
        bodies[rows] = bodies[rows[::-1]]
        bodies["id"][rows] = (a, b)
        return replace(frame, bodies=bodies)
