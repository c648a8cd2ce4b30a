"""The shutter: when each camera's exposure window opens and closes."""

from dataclasses import dataclass

from twin.streams import rng


@dataclass(frozen=True)
class Timing:
    """When a camera exposes. ``jitter_s`` rms of each exposure's start about its pulse; ``delay_s`` a constant
    delay that the stamps know nothing of.
    """

    jitter_s: float = 20e-6
    delay_s: float = 0.0


@dataclass(frozen=True)
class Exposure:
    """The true window of one exposure, session clock [s], and the stamp of its start that the camera gives [ns]."""

    start_s: float
    end_s: float
    stamp_ns: int

    @property
    def middle_s(self) -> float:
        """The true mid-exposure [s]."""
        return 0.5 * (self.start_s + self.end_s)


def pulse_time_s(pulse: int, frame_rate_hz: float) -> float:
    """Return when a trigger pulse is sent [s]: pulse 0 at the session's start."""
    return pulse / frame_rate_hz


def open_shutter(
    timing: Timing, name: str, pulse: int, frame_rate_hz: float, exposure_s: float, seed: int
) -> Exposure:
    """Return the exposure that camera ``name`` makes at ``pulse``: delayed, jittered; its stamp knows neither."""
    sent = pulse_time_s(pulse, frame_rate_hz)
    jitter = rng(seed, f"camera/{name}/trigger", pulse).normal(0.0, timing.jitter_s)
    start = sent + timing.delay_s + jitter
    return Exposure(start, start + exposure_s, round(sent * 1e9))
