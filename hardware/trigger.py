"""Interface of the triggers: pulses are stopped, cameras are armed, pulses begin, so all share the first pulse."""

from collections.abc import Sequence
from typing import Protocol

from hardware.driver import Grabbed
from hardware.pulse_grid import SentPulse
from hardware.pulse_numbers.clock_model import ExposureStart, StampPulse


class Trigger(Protocol):
    """Makes the pulses of a rig; ``hardware.source`` stops it, arms the cameras and starts it."""

    def stop(self) -> None:
        """Make no more pulses; returns when the last one is over."""
        ...

    def start(self) -> int | None:
        """Begin with pulse 0; return this machine's monotonic time of it [ns], None where that is not known."""
        ...

    def pulse_at(self, host_ns: int) -> int | None:
        """Return the last pulse before ``host_ns`` where each pulse waits for its frames, else None."""
        ...

    def pulse_of(self, camera: str, buffer: Grabbed, read: ExposureStart | None = None) -> StampPulse | None:
        """Return a frame's pulse and how far from it the exposure began, where each pulse waits for its frames.

        ``read``: when the exposure began by the camera's clock, where that is known.
        """
        ...

    def session_ns(self, host_ns: int) -> int | None:
        """Return a host time from pulse 0 on [ns], where each pulse waits for its frames, else None."""
        ...

    def new_pulses(self) -> Sequence[SentPulse]:
        """Return the pulses that this machine sent since the last call."""
        ...

    def skipped(self, before: int | None = None) -> int:
        """Return how many pulses, of those ``before`` a number, this machine skipped since it could not send them."""
        ...

    def notes(self, before: int | None = None) -> list[str]:
        """Return what went wrong with the pulses ``before`` a number, one line each."""
        ...

    def frame_arrived(self, camera: str, host_ns: int) -> None:
        """Called by the reading threads: a frame of ``camera`` arrived at ``host_ns``."""
        ...

    def poll_timed_out(self, camera: str, began_ns: int, ended_ns: int) -> None:
        """Called by the reading threads: a poll for a frame of ``camera`` timed out."""
        ...

    def camera_lost(self, camera: str) -> None:
        """Called by the reading threads: ``camera`` does not answer; no frame comes before it is opened again."""
        ...

    def report(self) -> dict[str, object]:
        """Return a report on the pulses so far, for the recording: ``pulses`` made, rate, fit."""
        ...

    def close(self) -> None:
        """Stop and free the device; may be called twice."""
        ...


class External:
    """Pulses from outside that do not wait for frames: they are never stopped, and nothing is known of them.

    Base class of those triggers controlled by this machine whose pulses do not wait either.
    """

    def stop(self) -> None:
        """Do nothing."""

    def start(self) -> int | None:
        """Return None: when the pulses began is not known."""
        return None

    def pulse_at(self, host_ns: int) -> int | None:
        """Return None: nothing is known of the pulses."""
        return None

    def pulse_of(self, camera: str, buffer: Grabbed, read: ExposureStart | None = None) -> StampPulse | None:
        """Return None: nothing is known of the pulses."""
        return None

    def session_ns(self, host_ns: int) -> int | None:
        """Return None: nothing is known of the pulses."""
        return None

    def new_pulses(self) -> Sequence[SentPulse]:
        """Return none: this machine sends none."""
        return ()

    def skipped(self, before: int | None = None) -> int:
        """Return 0: this machine sends none."""
        return 0

    def notes(self, before: int | None = None) -> list[str]:
        """Return none: nothing is known of the pulses."""
        return []

    def frame_arrived(self, camera: str, host_ns: int) -> None:
        """Do nothing."""

    def poll_timed_out(self, camera: str, began_ns: int, ended_ns: int) -> None:
        """Do nothing."""

    def camera_lost(self, camera: str) -> None:
        """Do nothing."""

    def report(self) -> dict[str, object]:
        """Return nothing: the pulses come from elsewhere."""
        return {}

    def close(self) -> None:
        """Do nothing."""
