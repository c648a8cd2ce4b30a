"""A camera's own count of trigger pulses, as a witness of what its clock says: why a pulse has no frame.

The clock of a camera tells of which pulse a frame is (``hardware.pulse_numbers.numbering``). Its counter of pulses
on the line cannot: it does not see a pulse that never arrived, and counts bounces of a switch as pulses. Held
beside each other they say what became of the pulses between two frames:

    pulses by the clock - pulses by the counter = pulses that did not reach the camera (cable, pulse generator)
    pulses by the counter - frames by their numbers = pulses that came while it could not expose (exposure, rate)
    pulses by the counter beyond those by the clock = edges that were no pulses (bounces, noise on the line)
"""

from dataclasses import dataclass

from hardware.driver import Grabbed


@dataclass
class TriggerWitness:
    """What a camera's counter says beside its clock, summed from its first frame with a count on."""

    frames: int = 0
    unreached: int = 0
    ignored: int = 0
    surplus: int = 0
    _last: tuple[int, int, int | None] | None = None

    def take(self, pulse: int, buffer: Grabbed) -> None:
        """Take a frame that was numbered; one without a count says nothing."""
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
        """Return whether the counter went on by as many as the pulses that the clock sees since the last frame."""
        steps = self._steps(pulse, buffer)
        return steps is not None and steps[0] == steps[1]

    def lines(self, name: str) -> list[str]:
        """Return in words what became of pulses that have no frame."""
        told = (
            (self.unreached, "did not reach it; check its trigger cable and the pulse generator"),
            (self.ignored, "came while it could not expose; use a shorter exposure or a lower rate"),
            (self.surplus, "more than there were; something bounces, or disturbs its trigger line"),
        )
        return [f"camera '{name}': by its trigger counter {n} pulses {what}" for n, what in told if n]

    def _steps(self, pulse: int, buffer: Grabbed) -> tuple[int, int, int | None] | None:
        """Return pulses, counts and frames since the last frame; None where the camera began anew or told none."""
        if self._last is None or buffer.triggers is None:
            return None
        last_pulse, last_count, last_block = self._last
        pulses, triggers, blocks = pulse - last_pulse, buffer.triggers - last_count, None
        if buffer.block_id is not None and last_block is not None:
            blocks = buffer.block_id - last_block
        if pulses <= 0 or triggers <= 0 or (blocks is not None and blocks <= 0):
            return None
        return pulses, triggers, blocks
