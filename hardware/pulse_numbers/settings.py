"""Constants of the pulse numbering, in frames of the rig's rate."""

from typing import NamedTuple, Self

VOTE_S, START_S = 0.3, 0.5
"""Duration of a vote, later and at the start: one camera's reading thread may lag behind the others' on a busy
machine, but not in all of its frames."""
FEWEST_VOTES, MOST_VOTES = 2, 100
READING_WAIT_S = 1.0
"""Longest wait of a frame for a reading of its device clock; then its stamp is used, unless frames come too early."""


class NumberingSettings(NamedTuple):
    """Settings shared by the phases of the numbering."""

    period_ns: float
    """Nominal period of the pulses [ns]."""
    votes: int
    """Frames that vote after a clock jumped."""
    start_votes: int
    """Frames of each camera that vote at the start."""
    reading_wait: int
    """Frames that wait for a reading of their device clock."""
    start_ns: int | None
    """Host time when the pulses began [ns], None where that is not known."""
    start_wait_ns: float
    """Wait for silent cameras after the first arrival [ns]."""

    @classmethod
    def at_rate(cls, rate_hz: float, start_ns: int | None, start_wait_s: float) -> Self:
        """Return the settings at a pulse rate."""
        votes, start_votes = (min(max(round(s * rate_hz), FEWEST_VOTES), MOST_VOTES) for s in (VOTE_S, START_S))
        reading_wait = max(round(READING_WAIT_S * rate_hz), FEWEST_VOTES)
        return cls(1e9 / rate_hz, votes, start_votes, reading_wait, start_ns, start_wait_s * 1e9)
