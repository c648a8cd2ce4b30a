"""GigE Vision action commands: one datagram triggers all cameras that hold its keys.

Cameras expose when it arrives, with the network's jitter between them. Cameras whose clocks agree by PTP receive the
time of exposure with the command (``lead_ms``): then they expose together. A pulse that this computer cannot send in
its period is skipped and counted (``hardware.pulse_grid``): cameras would ignore a burst of late ones.
"""

import logging
import socket
import struct
import threading
import time

from hardware.driver import DeviceError, Grabbed
from hardware.gvcp import GVCP_KEY, GVCP_PORT, HEADER, SCHEDULED, Command
from hardware.pulse_grid import LATEST_TIME, HostClock, PulseGrid, SentPulse
from hardware.pulse_numbers.clock_model import ExposureStart, StampPulse
from hardware.settings import TriggerTable
from hardware.trigger import External

log = logging.getLogger("mosca.hardware.triggers")


class ActionTrigger(External):
    """Broadcasts an action command ``rate_hz`` times a second; a ``hardware.trigger.Trigger``.

    ``clock`` is for tests.
    """

    def __init__(self, table: TriggerTable, rate_hz: float, clock: HostClock | None = None) -> None:
        self._table = table
        self._clock = clock or HostClock()
        self._grid = PulseGrid(rate_hz, self._clock)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._pulses = 0
        self.lost = 0
        self._read: set[str] = set()
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        except OSError as error:
            raise DeviceError(f"action commands: no socket ({error.strerror}); check the network's rights") from None

    def start(self) -> int | None:
        """Begin with pulse 0 now; return this machine's time of it [ns]."""
        self._stop.clear()
        self._pulses = 0
        begin_ns = self._grid.begin()
        self._thread = threading.Thread(target=self.run, name="action commands", daemon=True)
        self._thread.start()
        return begin_ns

    def stop(self) -> None:
        """Send no more commands."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def pulse_at(self, host_ns: int) -> int | None:
        """Return the last pulse that was sent or skipped; None before it, and where exposures are scheduled."""
        return None if self._table.lead_ms else self._grid.last_due

    def session_ns(self, host_ns: int) -> int | None:
        """Return a host time from pulse 0 on [ns]; None before it, and where exposures are scheduled."""
        return None if self.pulse_at(host_ns) is None else host_ns - self._grid.begin_ns

    def pulse_of(self, camera: str, buffer: Grabbed, read: ExposureStart | None = None) -> StampPulse | None:
        """Return the pulse in whose period the exposure began; None where its clock is not read.

        Network and processors delay commands, so that stamps do not lie on the line of the pulses, except for
        scheduled commands (``lead_ms``). A frame without a fitting reading gets the pulse of its arrival.
        """
        if self.pulse_at(buffer.host_ns) is None or (read is None and camera not in self._read):
            return None
        if read is None:
            arrived_ns = buffer.host_ns - buffer.exposure_ns - self._grid.begin_ns
            return StampPulse(max(int(arrived_ns // self._grid.period_ns), 0), 0.0, certain=False)
        self._read.add(camera)
        pulse = max(int((read.at_ns + read.error_ns - self._grid.begin_ns) // self._grid.period_ns), 0)
        residual_ns = read.at_ns - self._grid.begin_ns - pulse * self._grid.period_ns
        limit_ns = LATEST_TIME * self._grid.period_ns
        if residual_ns > limit_ns:  # the command, or the camera, was delayed
            return StampPulse(pulse, limit_ns, residual_ns - limit_ns + read.error_ns, certain=False)
        return StampPulse(pulse, residual_ns, read.error_ns)

    def new_pulses(self) -> list[SentPulse]:
        """Return the pulses sent since the last call."""
        return self._grid.new_pulses()

    def skipped(self, before: int | None = None) -> int:
        """Return how many pulses were skipped, of those ``before`` a number."""
        return self._grid.skipped(before)

    def notes(self, before: int | None = None) -> list[str]:
        """Return a line on skipped pulses and one on those that the network refused, where there are any."""
        notes = self._grid.skipped_note("action commands", before)
        if self.lost:
            notes.append(f"action commands: the network refused {self.lost} of them; check interface and cable")
        return notes

    def report(self) -> dict[str, object]:
        """Return the pulses made, those skipped, and those that the network refused."""
        return {"pulses": self._pulses, "skipped_pulses": self._grid.skipped(), "refused": self.lost}

    def close(self) -> None:
        """Stop and free the socket; may be called twice."""
        self.stop()
        self._socket.close()

    def run(self) -> None:
        """Make pulses until ``stop``; run by the thread that ``start`` starts."""
        while True:
            number = self._grid.await_next(self._stop)
            if number is None:
                return
            sent_ns = self._clock.now_ns()
            if self._send(number % 0xFFFF + 1):
                self._grid.sent(number, sent_ns, self._clock.now_ns())
            self._pulses += 1

    def _send(self, request: int) -> bool:
        keys = struct.pack(">III", self._table.device_key, self._table.group_key, self._table.group_mask)
        if self._table.lead_ms:
            keys += struct.pack(
                ">Q", time.time_ns() + round(self._table.lead_ms * 1e6 + self._table.ptp_ahead_s * 1e9)
            )
        flags = SCHEDULED if self._table.lead_ms else 0
        command = HEADER.pack(GVCP_KEY, flags, Command.ACTION, len(keys), request) + keys
        try:
            # else the socket would receive from all interfaces
            self._socket.connect((self._table.broadcast, GVCP_PORT))
            try:
                self._socket.send(command)
            except ConnectionRefusedError:  # the answer to the command before: a single address without a device
                self._socket.send(command)
        except OSError as error:  # the pulse is lost for all cameras; its frames are missing and counted
            log.debug("action command not sent (%s)", error)
            self.lost += 1
            return False
        return True
