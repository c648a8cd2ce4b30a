"""For how long a camera's reader has looked for frames in vain: the measure of silence.

A clock alone cannot tell who is silent: it goes on while this machine does not run the reader, and what came
meanwhile has not been looked at yet. So only looks count, each for no longer than it was meant to take.
"""

from dataclasses import dataclass

LOOK_S = 0.1
LONGEST_LOOK_S = 2 * LOOK_S
"""A look that took longer was held up, and is not evidence of more silence than this."""


@dataclass
class Looks:
    """One camera's looks in vain since its last buffer; ``over_s``: those begun after the last pulse."""

    vain_s: float = 0.0
    over_s: float = 0.0

    def found(self) -> None:
        """A look has brought a buffer."""
        self.vain_s = self.over_s = 0.0

    def in_vain(self, began_ns: int, ended_ns: int, over_ns: int | None) -> None:
        """A look has brought nothing; ``over_ns``: when the last pulse was over, None before."""
        took_s = min((ended_ns - began_ns) * 1e-9, LONGEST_LOOK_S)
        self.vain_s += took_s
        if over_ns is not None and began_ns >= over_ns:
            self.over_s += took_s
