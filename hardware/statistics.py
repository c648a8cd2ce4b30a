"""Counts and notes of a take with a rig; both may be read at any time, from any thread."""

import logging
from dataclasses import dataclass, field

log = logging.getLogger("mosca.hardware")


@dataclass
class BufferCounts:
    """Counts of one camera: ``whole`` + ``failed`` buffers were received."""

    whole: int = 0
    """Buffers with a complete image."""
    failed: int = 0
    """Buffers without one."""
    overrun: int = 0
    """Images that were dropped because the queue was full."""
    reopened: int = 0
    """How often the device was lost and opened again."""
    relocked: int = 0
    """How often its device clock jumped and was aligned again."""
    unproven: int = 0
    """Frames whose pulses follow from arrival times alone, uncertainly (``hardware.pulse_numbers.counting``)."""
    untimed: int = 0
    """Frames whose times are known less well than ``time_error_ms`` of the rig file allows."""
    unreached: int = 0
    """Pulses that did not reach the camera, by its trigger counter (``hardware.pulse_numbers.trigger_counter``)."""
    ignored: int = 0
    """Pulses that arrived while it could not expose, by its trigger counter."""
    driver: dict[str, int] = field(default_factory=dict)
    """The driver's own counts, by its names."""


@dataclass
class RigStatistics:
    """Counts of all cameras, and what happened."""

    cameras: dict[str, BufferCounts] = field(default_factory=dict)
    skipped_pulses: int = 0
    """Pulses that this machine could not send in their periods (``hardware.pulse_grid``)."""
    notes: list[str] = field(default_factory=list)
    """Events, one line each, in the order in which they happened."""

    def note(self, text: str) -> None:
        """Add a line to ``notes``, and log it as a warning."""
        self.notes.append(text)
        log.warning("%s", text)

    def log_summary(self) -> None:
        """Log one line for each camera."""
        for name, one in self.cameras.items():
            log.info(
                "camera '%s': %d frames, %d failed, %d overrun, %d reopened, %d relocked",
                name, one.whole, one.failed, one.overrun, one.reopened, one.relocked,
            )  # fmt: skip
