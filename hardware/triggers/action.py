"""GigE Vision action commands: one datagram triggers all cameras that hold its keys.

Cameras expose when it arrives, a network's jitter apart. Those whose clocks agree by PTP take the instant of exposure
with the command (``lead_ms``): then they expose together.
"""

import logging
import socket
import struct
import threading
import time

from hardware.driver import DeviceError
from hardware.settings import TriggerTable
from hardware.trigger import External

GVCP_PORT = 3956
ACTION_CMD = 0x0100
SCHEDULED = 0x80
log = logging.getLogger("mosca.hardware.triggers")


class ActionTrigger(External):
    """Broadcasts an action command ``rate_hz`` times a second; a ``hardware.trigger.Trigger``."""

    def __init__(self, table: TriggerTable, rate_hz: float) -> None:
        self._table = table
        self._period_s = 1 / rate_hz
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._pulses = 0
        self.lost = 0
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        except OSError as error:
            raise DeviceError(f"action commands: no socket ({error.strerror}); check the network's rights") from None

    def start(self) -> int | None:
        """Begin with pulse 0 now; return this machine's time of it [ns]."""
        self._stop.clear()
        self._pulses = 0
        begin = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(begin,), name="action commands", daemon=True)
        self._thread.start()
        return round(begin * 1e9)

    def stop(self) -> None:
        """Send no more."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def report(self) -> dict[str, object]:
        """Return the pulses made and those that the network refused."""
        return {"pulses": self._pulses, "refused": self.lost}

    def close(self) -> None:
        """Stop and free the socket; may be called twice."""
        self.stop()
        self._socket.close()

    def _run(self, begin: float) -> None:
        while True:
            wait = begin + self._pulses * self._period_s - time.monotonic()
            if self._stop.wait(wait) if wait > 0 else self._stop.is_set():
                return
            self._send(self._pulses % 0xFFFF + 1)
            self._pulses += 1

    def _send(self, request: int) -> None:
        keys = struct.pack(">III", self._table.device_key, self._table.group_key, self._table.group_mask)
        if self._table.lead_ms:
            keys += struct.pack(
                ">Q", time.time_ns() + round(self._table.lead_ms * 1e6 + self._table.ptp_ahead_s * 1e9)
            )
        flags = SCHEDULED if self._table.lead_ms else 0
        command = struct.pack(">BBHHH", 0x42, flags, ACTION_CMD, len(keys), request) + keys
        try:
            # else the socket would receive from all interfaces
            self._socket.connect((self._table.broadcast, GVCP_PORT))
            self._socket.send(command)
        except OSError as error:  # the pulse is lost for all cameras; its frames are missing and counted
            log.debug("action command not sent (%s)", error)
            self.lost += 1
