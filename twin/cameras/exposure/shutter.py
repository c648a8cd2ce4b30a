"""The shutter: when each row of a frame collects light, and the time stamps of the camera.

A camera is triggered (a frame a pulse) or runs free at a rate of its own. All rows expose for the same length,
at once (global shutter) or each a row time after the one above it (rolling shutter). A strobe shorter than the
exposure is the only light that the targets get. True times are in seconds of the session clock. The times that the
camera states are in nanoseconds of its own clock.
"""

import math
from dataclasses import dataclass
from typing import Literal

from mosca.data.frames import StampEvent
from mosca.errors import InputError
from twin.cameras.exposure.lighting import ALWAYS
from twin.streams import key, rng


@dataclass(frozen=True)
class Timing:
    """When a camera exposes and how it stamps."""

    jitter_s: float = 20e-6
    """Rms of each exposure's start; not in the stamps."""
    delay_s: float = 0.0
    """Constant delay after the trigger; not in the stamps."""
    skew_s: float = 0.0
    """Known offset from the pulse; in the stamps."""
    rate_hz: float | None = None
    """Stated rate of a free-running camera (None: triggered). Frame n opens ``offset_s + n / rate`` after the
    session's start; jitter and delay come on top."""
    offset_s: float = 0.0
    drift_ppm: float = 0.0
    """Relative excess of a free-running camera's true rate over the stated one."""
    exposure_s: float | None = None
    """Exposure of a row (None: that of the capture)."""
    row_time_s: float = 0.0
    """Time from one row's opening to the next (0: global shutter)."""
    strobe_s: float | None = None
    """How long the strobe is on (None: always). It is no brighter for being short: a strobe of a quarter of the
    exposure gives a quarter of the light."""
    strobe_delay_s: float = 0.0
    """Delay of the strobe after the camera's own opening, or after the rig's trigger pulse."""
    strobe: Literal["own", "rig"] = "own"
    """The camera's own strobe, or one for the whole rig."""
    stamp_event: StampEvent = "exposure_start"
    """As in CameraInfo."""
    clock: Literal["device", "host", "session"] = "session"
    """As in CameraInfo."""
    clock_offset_s: float = 0.0
    """Reading of a device or host clock at the session's start."""
    clock_drift_ppm: float = 0.0
    """Relative rate error of that clock; above 0 it runs fast."""
    stamp_resolution_ns: int = 1
    """Stamps are whole multiples of this."""
    stamp_jitter_s: float = 0.0
    """Mean of a host stamp's exponentially distributed delay, and so also its rms about the mean."""


@dataclass(frozen=True)
class Exposure:
    """The true times of one frame [s], and what the camera states of them [ns].

    A camera that drives its own strobe states the window of the light as its exposure. Under the rig's strobe it
    states the window of its shutter.
    """

    number: int
    """Number of the frame, counted by the camera."""
    nominal_s: float
    """The first row's opening without delay and jitter."""
    start_s: float
    """The first row's true opening."""
    length_s: float
    """Exposure of each row."""
    row_time_s: float
    """Time from one row's opening to the next."""
    rows: int
    """Rows of the image."""
    light_s: tuple[float, float]
    """When the strobe is on: from, until."""
    stamp_ns: int
    """Stated time of the stamp event."""
    exposure_ns: int
    """Stated length."""
    row_time_ns: int
    """Stated time from row to row."""

    @property
    def end_s(self) -> float:
        """When the last row closes [s]."""
        return self.start_s + self.span_s

    @property
    def span_s(self) -> float:
        """From the first row's opening to the last row's closing [s]."""
        return self.length_s + (self.rows - 1) * self.row_time_s

    @property
    def middle_s(self) -> float:
        """The true mid-exposure [s]: the middle of the light that the central row gets."""
        return self.row_middle_s(0.5 * (self.rows - 1))

    def row_middle_s(self, row: float) -> float:
        """The middle of the light that a row gets [s]; where it gets none, the middle of the row's exposure."""
        opens = self.start_s + row * self.row_time_s
        closes = opens + self.length_s
        on, off = max(opens, self.light_s[0]), min(closes, self.light_s[1])
        return 0.5 * (on + off) if on < off else 0.5 * (opens + closes)


def pulse_time_s(pulse: int, frame_rate_hz: float) -> float:
    """Return when a trigger pulse is sent [s]: pulse 0 at the session's start."""
    return pulse / frame_rate_hz


def numbers_in(timing: Timing, pulse: int, frame_rate_hz: float) -> range:
    """Return the numbers of the frames that a camera opens from a pulse until the next.

    A frame of a triggered camera has the number of its pulse. Over the pulses of a session, each frame of a
    free-running camera is returned exactly once; frames before the session's start are never returned.
    """
    if timing.rate_hz is None:
        return range(pulse, pulse + 1)
    return range(
        _first_number(timing, pulse_time_s(pulse, frame_rate_hz)),
        _first_number(timing, pulse_time_s(pulse + 1, frame_rate_hz)),
    )


def open_shutter(
    timing: Timing, name: str, number: int, frame_rate_hz: float, exposure_s: float, seed: int, rows: int = 1
) -> Exposure:
    """Return the exposure of frame ``number`` of camera ``name``, an image of ``rows`` rows.

    ``frame_rate_hz`` of the pulses; ``exposure_s``: the capture's, for a camera without one of its own.
    """
    length = exposure_s if timing.exposure_s is None else timing.exposure_s
    nominal = _opens_s(timing, number, frame_rate_hz)
    jitter = rng(seed, f"camera/{name}/trigger", number).normal(0.0, timing.jitter_s)
    start = nominal + timing.delay_s + jitter
    light, stated_from, stated_length, stated_row_time = ALWAYS, nominal, length, timing.row_time_s
    if timing.strobe_s is not None and timing.strobe == "rig":
        on = pulse_time_s(number, frame_rate_hz) + timing.strobe_delay_s
        light = (on, on + timing.strobe_s)
    elif timing.strobe_s is not None:
        light = (start + timing.strobe_delay_s, start + timing.strobe_delay_s + timing.strobe_s)
        # every row gets all of this light at once, whatever the shutter (``check_timing``)
        stated_from, stated_length, stated_row_time = nominal + timing.strobe_delay_s, timing.strobe_s, 0.0
    readout = (rows - 1) * stated_row_time
    after = {
        "exposure_start": 0.0,
        "exposure_middle": 0.5 * (stated_length + readout),
        "readout": stated_length + readout,
    }
    return Exposure(
        number,
        nominal,
        start,
        length,
        timing.row_time_s,
        rows,
        light,
        _stamp_ns(timing, name, number, stated_from + after[timing.stamp_event], seed),
        round(stated_length * 1e9),
        round(stated_row_time * 1e9),
    )


def fastest_rate_hz(rows: int, row_time_s: float, overhead_s: float = 0.0) -> float:
    """Return the highest frame rate of a sensor that reads ``rows`` rows one after the other [1/s].

    A window of fewer rows is read out faster in proportion, except for the constant ``overhead_s`` of each frame.
    """
    return 1.0 / (rows * row_time_s + overhead_s)


def check_timing(
    timing: Timing, name: str, rows: int, frame_rate_hz: float, exposure_s: float, overhead_s: float = 0.0
) -> None:
    """Raise InputError if no camera can expose with this timing; ``exposure_s``: that of the capture."""
    rate = frame_rate_hz if timing.rate_hz is None else timing.rate_hz
    length = exposure_s if timing.exposure_s is None else timing.exposure_s
    where = f"camera '{name}', timing"
    if not rate > 0.0:
        raise InputError(
            f"{where}: rate_hz = {rate:g} given; a rate above 0 is wanted, or none for a triggered camera"
        )
    if not 0.0 < length <= 1.0 / rate:
        raise InputError(
            f"{where}: exposure_s = {length:g} given; above 0 and at most the frame's period, {1 / rate:g}, is wanted"
        )
    if timing.row_time_s < 0.0 or timing.stamp_resolution_ns < 1 or timing.stamp_jitter_s < 0.0:
        raise InputError(
            f"{where}: row_time_s = {timing.row_time_s:g}, stamp_resolution_ns = {timing.stamp_resolution_ns}, "
            f"stamp_jitter_s = {timing.stamp_jitter_s:g} given; from 0, from 1 and from 0 up are wanted"
        )
    if timing.row_time_s > 0.0 and rate > fastest_rate_hz(rows, timing.row_time_s, overhead_s) * (1 + 1e-9):
        raise InputError(
            f"{where}: {rate:g} frames/s asked for; {rows} rows of row_time_s = {timing.row_time_s:g} allow "
            f"{fastest_rate_hz(rows, timing.row_time_s, overhead_s):.6g}: read fewer rows or lower the rate"
        )
    if timing.strobe_s is not None:
        _check_strobe(timing, where, rows, length)


def _check_strobe(timing: Timing, where: str, rows: int, length_s: float) -> None:
    strobe_s = timing.strobe_s or 0.0
    if not strobe_s > 0.0:
        raise InputError(f"{where}: strobe_s = {strobe_s:g} given; a length above 0 is wanted, or none")
    if timing.strobe == "rig":
        if timing.rate_hz is not None:
            raise InputError(
                f"{where}: strobe = 'rig' with rate_hz = {timing.rate_hz:g}; the rig's strobe follows its trigger: "
                "leave rate_hz out or use strobe = 'own'"
            )
        return
    all_open = (rows - 1) * timing.row_time_s
    if timing.strobe_delay_s < all_open - 1e-12 or timing.strobe_delay_s + strobe_s > length_s + 1e-12:
        raise InputError(
            f"{where}: strobe_delay_s = {timing.strobe_delay_s:g}, strobe_s = {strobe_s:g} given; all rows are open "
            f"together from {all_open:g} s to {length_s:g} s: change strobe_delay_s, strobe_s or exposure_s"
        )


def _first_number(timing: Timing, from_s: float) -> int:
    """Return the number of the first frame that opens at ``from_s`` or later."""
    return max(0, math.ceil((from_s - timing.offset_s) * _true_rate_hz(timing)))


def _opens_s(timing: Timing, number: int, frame_rate_hz: float) -> float:
    if timing.rate_hz is None:
        return pulse_time_s(number, frame_rate_hz) + timing.skew_s
    return timing.offset_s + number / _true_rate_hz(timing)


def _true_rate_hz(timing: Timing) -> float:
    return (timing.rate_hz or 0.0) * (1.0 + 1e-6 * timing.drift_ppm)


def _stamp_ns(timing: Timing, name: str, number: int, event_s: float, seed: int) -> int:
    """Return what the camera's clock reads at an event, in whole ticks."""
    if timing.clock == "session":
        stamp = round(event_s * 1e9)
    else:
        if timing.clock == "host" and timing.stamp_jitter_s > 0.0:
            # an exponential number from a uniform one in (0, 1]
            uniform = (key(seed, f"camera/{name}/arrival", number) + 1) / 2.0**64
            event_s -= timing.stamp_jitter_s * math.log(uniform)
        # the epoch is added as an integer: a float of 1.8e9 s cannot resolve nanoseconds
        stamp = round(timing.clock_offset_s * 1e9) + round(event_s * (1.0 + 1e-6 * timing.clock_drift_ppm) * 1e9)
    return stamp // timing.stamp_resolution_ns * timing.stamp_resolution_ns
