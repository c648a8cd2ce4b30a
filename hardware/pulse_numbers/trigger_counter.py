"""A camera's own count of trigger pulses against its device clock: why a pulse has no frame.

The device clock gives the pulse of a frame (``hardware.pulse_numbers.numbering``). The counter of pulses on the
trigger line cannot: it misses a pulse that never arrived, and counts bounces of a switch as pulses. Together they
show what became of the pulses between two frames:

    pulses by the clock - pulses by the counter = pulses that did not reach the camera (cable, pulse generator)
    pulses by the counter - frames by their numbers = pulses that came while it could not expose (exposure, rate)
    pulses by the counter beyond those by the clock = edges that were no pulses (bounces, noise on the line)
"""

from dataclasses import dataclass

from hardware.driver import Grabbed


@dataclass
class TriggerCounter:
    """Sums of the differences between counter and clock, from the first frame with a count on."""

    frames: int = 0
    """Frames with a count."""
    unreached: int = 0
    """Pulses that did not reach the camera."""
    ignored: int = 0
    """Pulses that arrived while it could not expose."""
    surplus: int = 0
    """Edges that were no pulses."""
    _last: tuple[int, int, int | None] | None = None

    def take(self, pulse: int, buffer: Grabbed) -> None:
        """Take a numbered frame; one without a count changes nothing."""
        if buffer.triggers is None:
            return
        steps = self._steps(pulse, buffer)
        if steps is not None:
            pulses, triggers, blocks = steps
            self.unreached += max(pulses - triggers, 0)
            self.surplus += max(triggers - pulses, 0)
            if blocks is not None:
                self.ignored += max(min(triggers, pulses) - blocks, 0)
        self.frames += 1
        self._last = (pulse, buffer.triggers, buffer.block_id)

    def confirms(self, pulse: int, buffer: Grabbed) -> bool:
        """Return whether counter and clock agree on the number of pulses since the last frame."""
        steps = self._steps(pulse, buffer)
        return steps is not None and steps[0] == steps[1]

    def notes(self, name: str) -> list[str]:
        """Return one line for each reason why pulses have no frame."""
        reasons = (
            (self.unreached, "did not reach it; check its trigger cable and the pulse generator"),
            (self.ignored, "came while it could not expose; use a shorter exposure or a lower rate"),
            (self.surplus, "more than there were; something bounces, or disturbs its trigger line"),
        )
        return [f"camera '{name}': by its trigger counter {n} pulses {what}" for n, what in reasons if n]

    def _steps(self, pulse: int, buffer: Grabbed) -> tuple[int, int, int | None] | None:
        """Return pulses, counts and frames since the last frame; None where the camera restarted or sent none."""
        if self._last is None or buffer.triggers is None:
            return None
        last_pulse, last_count, last_block = self._last
        pulses, triggers, blocks = pulse - last_pulse, buffer.triggers - last_count, None
        if buffer.block_id is not None and last_block is not None:
            blocks = buffer.block_id - last_block
        if pulses <= 0 or triggers <= 0 or (blocks is not None and blocks <= 0):
            return None
        return pulses, triggers, blocks
