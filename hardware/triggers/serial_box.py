"""Pulse generator on a serial port, for instance an RP2040 or Arduino with the sketch in ``hardware/firmware``.

Its protocol: ``hardware.triggers.pulse_protocol``.
"""

import logging
import threading
import time
from collections import deque
from typing import Any

from hardware.driver import DeviceError
from hardware.trigger import External
from hardware.triggers.pulse_protocol import (
    PROTOCOL,
    START,
    STOP,
    VERSION,
    Ping,
    PulseFit,
    fit_pulses,
    pulses_at_ping,
    pulses_made,
    rate_command,
)

log = logging.getLogger("mosca.hardware.triggers")
PING_INTERVAL_S = 0.1
PINGS_KEPT = 600
ANSWER_S, POLL_S = 5.0, 0.1
"""Timeout of an answer, counted in polls: time in which this process did not run does not count."""
START_UNCERTAINTY, START_PINGS = 0.2, 50
"""Required uncertainty of the start, as a share of a period; most pings, of which the quickest determines it."""


def _open_port(where: str, port: str, baud: int) -> Any:
    import serial

    try:
        return serial.Serial(port, baud, timeout=POLL_S, write_timeout=ANSWER_S)
    except (serial.SerialException, ValueError) as error:
        raise DeviceError(
            f"{where}: cannot be opened ({error}); check [hardware.trigger] port and its rights"
        ) from None


class SerialTrigger(External):
    """The pulse generator at ``port``; a ``hardware.trigger.Trigger``.

    DeviceError where none answers, ImportError where pyserial is not installed.
    """

    def __init__(self, port: str, baud: int, rate_hz: float) -> None:
        self._where = f"pulse generator at {port}"
        self._rate_hz = rate_hz
        self._guard = threading.Lock()
        self._pings: deque[Ping] = deque(maxlen=PINGS_KEPT)
        self._count = 0
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._pulses: int | None = None
        self._port = _open_port(self._where, port, baud)
        try:
            answer = self._ask(VERSION)
            if answer != PROTOCOL:
                raise DeviceError(f"{self._where}: answers '{answer}', '{PROTOCOL}' is wanted; load its firmware")
            self._ask(STOP)
            wanted = rate_command(rate_hz)
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

        Where the answer was slow, the quickest of some pings is used: its number of pulses shows when they began.
        """
        self._pings.clear()
        self._pulses = None
        before = time.monotonic_ns()
        if self._ask(START) != START:
            raise DeviceError(f"{self._where}: does not start; unplug it and plug it in again")
        trip_ns = time.monotonic_ns() - before
        begun_ns = before + trip_ns // 2
        for _ in range(START_PINGS):
            if trip_ns <= START_UNCERTAINTY * 1e9 / self._rate_hz:
                break
            ping = self._ping()
            if ping is not None and ping.round_trip_ns < trip_ns:
                begun_ns, trip_ns = (ping.host_ns - round(ping.pulses * 1e9 / self._rate_hz), ping.round_trip_ns)
        log.info("%s: started, known to %.3f ms", self._where, trip_ns / 2e6)
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
        made = pulses_made(self._ask(STOP))
        if self._pulses is None and made is not None and self._pings:
            self._pulses = made

    @property
    def pings(self) -> tuple[Ping, ...]:
        """The latest pings since ``start``."""
        return tuple(self._pings)

    def fit(self) -> PulseFit | None:
        """Return host time against pulse number over the quicker half of the pings; None with fewer than four."""
        return fit_pulses(self.pings)

    def report(self) -> dict[str, object]:
        """Return the pulses made (after ``stop``) and the fit of this machine's clock to them."""
        fit = self.fit()
        report: dict[str, object] = {} if self._pulses is None else {"pulses": self._pulses}
        if fit is not None:
            report |= {"rate_hz": 1e9 / fit.period_ns, "ping_rms_us": fit.rms_ns / 1e3, "pings": fit.pings}
        return report

    def close(self) -> None:
        """Stop the pulses and free the port; may be called twice."""
        if self._port.is_open:
            try:
                self.stop()
            except DeviceError as error:  # it is gone, and freed all the same
                log.debug("%s", error)
            finally:
                self._port.close()

    def _run(self) -> None:
        while not self._end.wait(PING_INTERVAL_S):
            try:
                ping = self._ping()
            except DeviceError as error:  # the next command raises it again, in the caller's thread
                log.debug("%s", error)
                return
            if ping is not None:
                self._pings.append(ping)

    def _ping(self) -> Ping | None:
        """Return one ping; None for an answer to something else."""
        self._count += 1
        number = self._count % 1000
        before = time.monotonic_ns()
        answer = self._ask(f"P {number}")
        after = time.monotonic_ns()
        pulses = pulses_at_ping(answer, number, self._rate_hz)
        return None if pulses is None else Ping((before + after) // 2, pulses, after - before)

    def _ask(self, line: str) -> str:
        try:
            with self._guard:
                self._port.reset_input_buffer()
                self._port.write(line.encode("ascii") + b"\n")
                answer = b""
                for _ in range(round(ANSWER_S / POLL_S)):
                    answer += self._port.read_until(b"\n")
                    if answer.endswith(b"\n"):
                        break
        except _port_errors() as error:
            raise DeviceError(f"{self._where}: is gone ({error}); plug it in and start again") from None
        if not answer.endswith(b"\n"):
            raise DeviceError(f"{self._where}: no answer to '{line}' within {ANSWER_S:g} s; is its firmware loaded?")
        return answer.decode("ascii", errors="replace").strip()


def _port_errors() -> tuple[type[Exception], ...]:
    """Return what a serial port raises: SerialException is an OSError; termios, not on Windows, has its own."""
    try:
        from termios import error
    except ImportError:
        return (OSError,)
    return OSError, error
