"""A detecting station's end: sends detections and health, answers for clock and rig file, waits for the start."""

import random
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Self

from hardware.transport.messages import (
    YES,
    DetectionMessage,
    DetectionStatus,
    HealthMessage,
    State,
    StationCamera,
    pack_clock,
    pack_detections,
    pack_health,
    pack_heard,
    unpack_clock,
)
from hardware.transport.transport import HEARD, Transport, check_station, key_of
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo
from mosca.errors import InputError

HEALTH_S = 0.2
NOTES = 20
LEAVE_S, ASK_S, ASK_AGAIN_S = 5.0, 0.5, 0.02
"""Longest wait of a leaving station until its last message was received; time-out of a query for that; pause then."""


class Sender:
    """One station. ``start_ns``: when the session starts by the station's clock, once that is ordered.

    ``rig``: the text of its rig file. ``clock``: its monotonic clock [ns], for tests another one.

    Ends the transport when it is closed.
    """

    def __init__(
        self,
        transport: Transport,
        station: str,
        cameras: Sequence[CameraInfo],
        rig: str = "",
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.station = check_station(station)
        for info in cameras:
            if set(info.name) & set("/*$?#"):
                raise InputError(f"camera name '{info.name}' cannot be sent; letters, digits, _ . and - are wanted")
        # not from a seed: two starts of a station must not be taken for one
        self.epoch = random.SystemRandom().getrandbits(63)
        self.now_ns = clock
        self.refused = 0
        self.skipped = 0
        self._transport = transport
        self._cameras = {
            c.name: StationCamera(c.name, c.width, c.height, c.bit_depth, c.frame_rate_hz) for c in cameras
        }
        self._sent = dict.fromkeys(self._cameras, 0)
        self._keys = {name: key_of(station, name, "detections") for name in self._cameras}
        self._state: State = "starting"
        self._notes: deque[str] = deque(maxlen=NOTES)
        self._ordered = threading.Event()
        self.start_ns: int | None = None
        self._end = threading.Event()
        transport.declare_queryable(key_of(station, "clock"), lambda _: pack_clock(self.epoch, self.now_ns()))
        transport.declare_queryable(key_of(station, "health"), lambda _: pack_health(self.health()))
        transport.declare_queryable(key_of(station, "rig"), lambda _: rig.encode())
        transport.declare_queryable(key_of(station, "start"), self._start)
        self._beat = threading.Thread(target=self._run, name=f"station {station}", daemon=True)
        self._beat.start()

    def set_state(self, state: State, note: str = "") -> None:
        """Change the station's state, and publish it."""
        self._state = state
        if note:
            self._notes.append(note)
        self._transport.publish(key_of(self.station, "health"), pack_health(self.health()))

    def note(self, text: str) -> None:
        """Add a note to the next health message."""
        self._notes.append(text)

    def ordered(self, timeout_s: float) -> bool:
        """Wait for the order to begin; False when it did not come within ``timeout_s``."""
        return self._ordered.wait(timeout_s)

    def send(
        self,
        camera: str,
        pulse: int,
        time_ns: int,
        exposure_ns: int,
        arrival_ns: int,
        found: Detections | None,
        status: DetectionStatus = "detected",
    ) -> None:
        """Send what one camera saw at ``pulse``, or (``found`` None) why it saw nothing."""
        message = DetectionMessage(
            self.station,
            self.epoch,
            self._sent[camera],
            pulse,
            time_ns,
            exposure_ns,
            arrival_ns,
            self.now_ns(),
            status,
            Detections.none(camera) if found is None else found,
        )
        self._sent[camera] += 1
        if not self._transport.publish(self._keys[camera], pack_detections(message)):
            self.refused += 1

    def health(self) -> HealthMessage:
        """Return the state and counts of this station."""
        cameras = tuple(replace(camera, sent=self._sent[name]) for name, camera in self._cameras.items())
        return HealthMessage(
            self.station, self.epoch, self.now_ns(), self._state, cameras, self.refused, self.skipped,
            tuple(self._notes),
        )  # fmt: skip

    def close(self) -> None:
        """Announce the end and disconnect; may be called twice."""
        if self._end.is_set():
            return
        self._end.set()
        self._beat.join()
        self.set_state("ended" if self._state != "failed" else "failed")
        self._wait_until_heard()
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _wait_until_heard(self) -> None:
        """Wait until the last message was received, or no receiver is left: a silent station counts as lost."""
        until = time.monotonic() + LEAVE_S
        while time.monotonic() < until:
            answer = self._transport.query(HEARD, pack_heard(self.station, self.epoch), ASK_S)
            if answer is None or answer == YES:
                return
            time.sleep(ASK_AGAIN_S)

    def _start(self, order: bytes) -> bytes:
        epoch, start_ns = unpack_clock(order)
        if epoch == self.epoch:
            self.start_ns = start_ns
            self._ordered.set()
        return pack_clock(self.epoch, self.now_ns())

    def _run(self) -> None:
        while not self._end.wait(HEALTH_S):
            self._transport.publish(key_of(self.station, "health"), pack_health(self.health()))
