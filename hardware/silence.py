"""Polling time without a frame, per camera; stalls of this process are excluded.

Wall-clock time alone does not show that a camera is silent: it also passes while this process does not run the
reading thread, and frames that arrived meanwhile have not been read yet. So only polls count, each for no longer than
its timeout allows.
"""

from dataclasses import dataclass

POLL_S = 0.1
"""Timeout of one poll for a frame."""
LONGEST_POLL_S = 2 * POLL_S
"""A poll that took longer was stalled; it counts for this time only."""


@dataclass
class PollingTime:
    """Time that one camera was polled without result since its last buffer."""

    idle_s: float = 0.0
    """All polls since the last buffer."""
    idle_after_end_s: float = 0.0
    """Those that began after the last pulse."""

    def frame_arrived(self) -> None:
        """Restart: a poll has returned a buffer."""
        self.idle_s = self.idle_after_end_s = 0.0

    def timed_out(self, began_ns: int, ended_ns: int, end_ns: int | None) -> None:
        """Add a poll that returned nothing; ``end_ns``: host time when the pulses ended, None before."""
        took_s = min((ended_ns - began_ns) * 1e-9, LONGEST_POLL_S)
        self.idle_s += took_s
        if end_ns is not None and began_ns >= end_ns:
            self.idle_after_end_s += took_s
