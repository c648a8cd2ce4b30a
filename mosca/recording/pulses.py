"""The pulses of a capture, from ``/clock`` of its recording: when each was sent and how its frames were numbered."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mosca.errors import InputError

SENT = ("number", "nominal_ns", "sent_ns", "acknowledged_ns")


@dataclass(frozen=True)
class RecordedPulse:
    """One pulse."""

    number: int
    nominal_ns: int
    """Its time by the nominal rate, on the frames' clock [ns]."""
    sent_ns: int | None
    """Monotonic time of the capturing machine before the command [ns]; None where it did not send the pulse."""
    acknowledged_ns: int | None
    """The same when the command had returned."""
    found: Mapping[str, str]
    """Camera -> how its frame's pulse was found (docs/capture.md), for the cameras that delivered one."""


def recorded_pulses(clock: Iterable[tuple[int, Any]], rate_hz: float, where: str) -> tuple[RecordedPulse, ...]:
    """Return the pulses, by number, in the messages of ``/clock``; none from a recording made before they were kept.

    Parameters
    ----------
    clock
        (time_ns, message) as ``McapRecording.channel("clock")`` yields.
    rate_hz
        Nominal rate of the pulses [1/s].
    where
        The recording, for errors.

    Raises
    ------
    InputError
        Where a message is not what a capture writes.
    """
    sent: dict[int, tuple[int, int, int]] = {}
    found: dict[int, dict[str, str]] = {}
    for time_ns, message in clock:
        try:
            table = message.get("pulses", {})
            for number, *times in zip(*(table.get(key, ()) for key in SENT), strict=True):
                sent[int(number)] = (int(times[0]), int(times[1]), int(times[2]))
            for camera, stamps in message["cameras"].items():
                for number, how in zip(stamps.get("pulse", ()), stamps.get("found", ()), strict=True):
                    found.setdefault(int(number), {})[camera] = str(how)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{where}: channel /clock, message at {time_ns} ns: is not what a capture writes ({error!r}); "
                "read the frames without its pulses, or capture again"
            ) from None
    pulses = []
    for number in sorted(sent.keys() | found.keys()):
        nominal_ns, *times = sent.get(number, (round(number * 1e9 / rate_hz), None, None))
        pulses.append(RecordedPulse(number, nominal_ns, times[0], times[1], found.get(number, {})))
    return tuple(pulses)
