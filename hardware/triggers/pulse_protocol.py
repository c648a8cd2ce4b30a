"""Protocol of the serial pulse generator, and the fit of the host clock to its pulses. Needs no serial port.

The protocol is lines of ASCII, 115,200 baud; the generator answers each request at once:

| host | generator | meaning |
|---|---|---|
| ``V`` | ``V mosca-pulse 1`` | identification, and the protocol's version |
| ``F 100000`` | ``F 100000`` | pulses per 1,000 s (100 Hz), as set; only while stopped |
| ``W 100`` | ``W 100`` | width of a pulse [us] |
| ``S 1``, ``S 0`` | ``S 1``, ``S 0 1234`` | start with pulse 0 at once; stop, with the number of pulses made |
| ``P 7`` | ``P 7 1234 5678`` | ping 7: the last pulse's number, and microseconds since then |
| anything else | ``E text`` | not understood, or not now |
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

VERSION = "V"
PROTOCOL = "V mosca-pulse 1"
START, STOP = "S 1", "S 0"
PINGS_TO_FIT = 4
"""With fewer pings there is no fit."""


class Ping(NamedTuple):
    """One ping: how many pulses the generator had made at a host time."""

    host_ns: int
    """Host time half-way between question and answer [ns]."""
    pulses: float
    """Pulses made until then, with the fraction of a period since the last one."""
    round_trip_ns: int
    """Time from question to answer [ns]."""


@dataclass(frozen=True)
class PulseFit:
    """Host time of pulse k is ``first_ns`` + k ``period_ns``."""

    first_ns: int
    period_ns: float
    rms_ns: float
    """RMS residual of the pings [ns]."""
    pings: int
    """Number of pings used."""


def rate_command(rate_hz: float) -> str:
    """Return the line that sets the rate; the generator repeats it where it accepts the rate."""
    return f"F {round(rate_hz * 1000)}"


def pulses_made(answer: str) -> int | None:
    """Return the number of pulses in the answer to ``STOP``; None where it holds none."""
    words = answer.split()
    return int(words[2]) if len(words) == 3 and words[2].isdigit() else None


def pulses_at_ping(answer: str, number: int, rate_hz: float) -> float | None:
    """Return pulses made, with the fraction of a period, from the answer to ping ``number``, else None."""
    words = answer.split()
    if len(words) != 4 or words[:2] != ["P", str(number)]:
        return None
    if not all(re.fullmatch("[0-9]{1,18}", word) for word in words[2:]):
        return None  # a disturbed line: one ping less
    return int(words[2]) + int(words[3]) * 1e-6 * rate_hz


def fit_pulses(pings: Sequence[Ping]) -> PulseFit | None:
    """Return host time against pulse number over the quicker half of the pings; None with fewer than four."""
    if len(pings) < PINGS_TO_FIT:
        return None
    origin = pings[0].host_ns
    since, pulse, took = np.array([(host_ns - origin, k, trip_ns) for host_ns, k, trip_ns in pings]).T
    quick = took <= np.median(took)
    since, pulse = since[quick], pulse[quick]
    slope, start = np.polyfit(pulse, since, 1)
    rms = float(np.sqrt(np.mean((since - start - slope * pulse) ** 2)))
    return PulseFit(origin + round(start), float(slope), rms, len(pulse))
