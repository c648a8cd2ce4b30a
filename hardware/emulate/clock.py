"""A device's own clock: it starts when the device boots, drifts, may jump, and PTP may bring it to the common time.

Every function takes this machine's monotonic time [ns]; nothing here waits or looks at a clock itself.
"""

import time
from dataclasses import dataclass
from typing import Literal

PtpStatus = Literal["Disabled", "Listening", "Uncalibrated", "Slave"]
LISTENING_NS = 200_000_000
LOCKING_NS = 500_000_000
"""How long after PTP was switched on a device hears its master, and is locked to it."""

_COMMON_MINUS_MONOTONIC = time.time_ns() - time.monotonic_ns()


def common_ns(mono_ns: int) -> int:
    """Return the time of the PTP master (this machine's time of day, without its later steps) at ``mono_ns``."""
    return mono_ns + _COMMON_MINUS_MONOTONIC


@dataclass(frozen=True)
class Jump:
    """The clock is ``by_ns`` further from the monotonic time ``mono_ns`` on."""

    mono_ns: int
    by_ns: int


@dataclass(frozen=True)
class DeviceClock:
    """A clock that was ``offset_ns`` when the device booted (monotonic ``booted_ns``) and gains ``drift_ppm``.

    ``ptp_ns``: when PTP was switched on, None while it is off. Once locked it shows the master's time exactly: there
    are no synchronisation messages, only their effect.
    """

    booted_ns: int
    offset_ns: int = 0
    drift_ppm: float = 0.0
    jumps: tuple[Jump, ...] = ()
    ptp_ns: int | None = None

    def at(self, mono_ns: int) -> int:
        """Return what the clock shows at ``mono_ns`` [ns], never below 0."""
        if self.ptp_status(mono_ns) == "Slave":
            return common_ns(mono_ns)
        return max(self._free(mono_ns), 0)

    def when(self, device_ns: int) -> int:
        """Return the monotonic time at which the clock shows ``device_ns``, in its present state."""
        now = time.monotonic_ns()
        if self.ptp_status(now) == "Slave":
            return device_ns - _COMMON_MINUS_MONOTONIC
        ahead = device_ns - self._free(now)
        return now + round(ahead / (1.0 + self.drift_ppm * 1e-6))

    def ptp_status(self, mono_ns: int) -> PtpStatus:
        """Return the state of PTP at ``mono_ns``."""
        if self.ptp_ns is None:
            return "Disabled"
        since = mono_ns - self.ptp_ns
        if since < LISTENING_NS:
            return "Listening"
        return "Uncalibrated" if since < LOCKING_NS else "Slave"

    def offset_from_master(self, mono_ns: int) -> int:
        """Return what the clock shows less the master's time [ns]."""
        return self.at(mono_ns) - common_ns(mono_ns)

    def _free(self, mono_ns: int) -> int:
        elapsed = mono_ns - self.booted_ns
        jumped = sum(jump.by_ns for jump in self.jumps if jump.mono_ns <= mono_ns)
        return self.offset_ns + jumped + elapsed + round(elapsed * self.drift_ppm * 1e-6)
