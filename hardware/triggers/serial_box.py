"""Pulse generator on a serial port, for instance an RP2040 or Arduino with the sketch in ``hardware/firmware``.

The protocol is lines of ASCII, 115,200 baud; the host asks, the box answers at once:

| host | box | meaning |
|---|---|---|
| ``V`` | ``V mosca-pulse 1`` | who is there, and the protocol's version |
| ``F 100000`` | ``F 100000`` | pulses per 1,000 s (100 Hz), as set; only while stopped |
| ``W 100`` | ``W 100`` | width of a pulse [us] |
| ``S 1``, ``S 0`` | ``S 1``, ``S 0 1234`` | start with pulse 0 at once; stop, with the number of pulses made |
| ``P 7`` | ``P 7 1234 5678`` | ping 7: the last pulse's number, and microseconds since then |
| anything else | ``E text`` | not understood, or not now |
"""

import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
import serial

from hardware.driver import DeviceError
from hardware.trigger import External

PROTOCOL = "V mosca-pulse 1"
PING_S = 0.1
PINGS = 600
ANSWER_S, LOOK_S = 5.0, 0.1
"""An answer is waited for so long, in looks: time in which this machine did not run them says nothing."""
CERTAIN, TRIES = 0.2, 50
"""The start is known to this share of a period, by the first of so many pings that is quick enough."""


@dataclass(frozen=True)
class PulseFit:
    """Host time of pulse k is ``first_ns`` + k ``period_ns``; ``rms_ns``: the ``pings`` about it."""

    first_ns: int
    period_ns: float
    rms_ns: float
    pings: int


class SerialTrigger(External):
    """The pulse generator at ``port``; a ``hardware.trigger.Trigger``. DeviceError where none answers."""

    def __init__(self, port: str, baud: int, rate_hz: float) -> None:
        self._where = f"pulse generator at {port}"
        self._rate_hz = rate_hz
        self._guard = threading.Lock()
        self._pings: deque[tuple[int, float, int]] = deque(maxlen=PINGS)
        self._count = 0
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._pulses: int | None = None
        try:
            self._port = serial.Serial(port, baud, timeout=LOOK_S, write_timeout=ANSWER_S)
        except (serial.SerialException, ValueError) as error:
            raise DeviceError(
                f"{self._where}: cannot be opened ({error}); check [hardware.trigger] port and its rights"
            ) from None
        try:
            answer = self._ask("V")
            if answer != PROTOCOL:
                raise DeviceError(
                    f"{self._where}: answers '{answer}', '{PROTOCOL}' is wanted; load its firmware"
                )
            self._ask("S 0")
            wanted = f"F {round(rate_hz * 1000)}"
            taken = self._ask(wanted)
            if taken != wanted:
                raise DeviceError(
                    f"{self._where}: rate_hz = {rate_hz:g} given, it answers '{taken}' to '{wanted}'; choose another"
                )
        except BaseException:
            self._port.close()
            raise

    def start(self) -> int | None:
        """Begin with pulse 0; return this machine's time of it [ns], known to half a round trip.

        Where the answer was slow, the quickest of some pings tells: how far the pulses are, and so when they began.
        """
        self._pings.clear()
        self._pulses = None
        before = time.monotonic_ns()
        if self._ask("S 1") != "S 1":
            raise DeviceError(f"{self._where}: does not start; unplug it and plug it in again")
        trip_ns = time.monotonic_ns() - before
        begun_ns = before + trip_ns // 2
        for _ in range(TRIES):
            if trip_ns <= CERTAIN * 1e9 / self._rate_hz:
                break
            ping = self._ping()
            if ping is not None and ping[2] < trip_ns:
                begun_ns, trip_ns = ping[0] - round(ping[1] * 1e9 / self._rate_hz), ping[2]
        self._end.clear()
        self._thread = threading.Thread(target=self._run, name="pulse generator", daemon=True)
        self._thread.start()
        return begun_ns

    def stop(self) -> None:
        """Make no more pulses; their number is in ``report``."""
        self._end.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        words = self._ask("S 0").split()
        if self._pulses is None and len(words) == 3 and words[2].isdigit() and self._pings:
            self._pulses = int(words[2])

    def fit(self) -> PulseFit | None:
        """Return host time against pulse number over the quicker half of the pings; None with fewer than four."""
        pings = list(self._pings)
        if len(pings) < 4:
            return None
        origin = pings[0][0]
        since, pulse, took = np.array([(host_ns - origin, k, trip_ns) for host_ns, k, trip_ns in pings]).T
        quick = took <= np.median(took)
        since, pulse = since[quick], pulse[quick]
        slope, start = np.polyfit(pulse, since, 1)
        rms = float(np.sqrt(np.mean((since - start - slope * pulse) ** 2)))
        return PulseFit(origin + round(start), float(slope), rms, len(pulse))

    def report(self) -> dict[str, object]:
        """Return the pulses made (after ``stop``) and the fit of this machine's clock to them."""
        fit = self.fit()
        told: dict[str, object] = {} if self._pulses is None else {"pulses": self._pulses}
        if fit is not None:
            told |= {"rate_hz": 1e9 / fit.period_ns, "ping_rms_us": fit.rms_ns / 1e3, "pings": fit.pings}
        return told

    def close(self) -> None:
        """Stop the pulses and free the port; may be called twice."""
        if self._port.is_open:
            try:
                self.stop()
            finally:
                self._port.close()

    def _run(self) -> None:
        while not self._end.wait(PING_S):
            try:
                ping = self._ping()
            except DeviceError:
                return  # the next command to the box tells
            if ping is not None:
                self._pings.append(ping)

    def _ping(self) -> tuple[int, float, int] | None:
        """Return this machine's time [ns], pulses and parts of one until then, and what the answer took [ns].

        None for an answer to something else.
        """
        self._count += 1
        before = time.monotonic_ns()
        words = self._ask(f"P {self._count % 1000}").split()
        after = time.monotonic_ns()
        if len(words) != 4 or words[:2] != ["P", str(self._count % 1000)]:
            return None
        return (before + after) // 2, int(words[2]) + int(words[3]) * 1e-6 * self._rate_hz, after - before

    def _ask(self, line: str) -> str:
        try:
            with self._guard:
                self._port.reset_input_buffer()
                self._port.write(line.encode("ascii") + b"\n")
                answer = b""
                for _ in range(round(ANSWER_S / LOOK_S)):
                    answer += self._port.read_until(b"\n")
                    if answer.endswith(b"\n"):
                        break
        except (serial.SerialException, OSError) as error:
            raise DeviceError(f"{self._where}: is gone ({error}); plug it in and start again") from None
        if not answer.endswith(b"\n"):
            raise DeviceError(
                f"{self._where}: no answer to '{line}' within {ANSWER_S:g} s; is its firmware loaded?"
            )
        return answer.decode("ascii", errors="replace").strip()
