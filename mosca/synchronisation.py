"""Assembly: frames of many cameras become frame sets, pulse by pulse; gaps are counted, never closed up.

A frame's pulse number comes from its mid-exposure time on the common pulse clock. The clock has the nominal frame
rate and the phase of the first frames, and tracks slow drift. Arrival order is not used, and the camera's counter
only as a check, since a camera that misses a trigger counts on without a gap. The source must provide all cameras'
times on one clock.

Each set waits for all cameras, at most until ``open_pulses`` newer pulses are open. So late, reordered, doubled and
lost frames, and cameras that fail, cost that set at most one camera; no other frame is shifted.
"""

import cmath
import math
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import field, replace
from itertools import islice

from pydantic import NonNegativeInt
from pydantic.dataclasses import dataclass

from mosca.data.files.toml import SETTINGS
from mosca.data.frames import CameraInfo, Frame, FrameSet, mid_exposure_ns
from mosca.errors import InputError

PHASE_GAIN = 0.05
"""Share of a set's time residual that moves the pulse clock's phase."""
PERIOD_GAIN = 0.0005
"""Share of the residual that moves the period: a rate that is 0.1 % off is learned within some 300 pulses."""
LARGEST_RATE_ERROR = 0.005
"""How far the period may move from the nominal one."""
REMEMBERED_SETS = 1000
"""Number of yielded sets for which a late frame can be distinguished from a duplicate."""


@dataclass(frozen=True, config=SETTINGS)
class AssemblySettings:
    """How long to wait for frames, and which time stamps are plausible."""

    open_pulses: NonNegativeInt = 5
    """A set is closed when this many newer pulses are open."""
    longest_gap_pulses: NonNegativeInt = 20_000
    """A frame farther ahead than this has a wrong stamp and is counted as stray."""
    start_frames: NonNegativeInt = 8
    """At least so many frames (and two a camera) fix the phase before the first set is yielded."""
    nominal_times: bool = False
    """Pulse k and its frames are stamped with k nominal periods: two takes of the same pulses have the same times."""


@dataclass
class CameraCount:
    """Counts of one camera's frames.

    ``delivered``, ``dropped``, ``corrupt`` and ``late`` add up to the number of yielded sets, unless a frame came
    before the first set.
    """

    delivered: int = 0
    """Usable and in time."""
    dropped: int = 0
    """No frame came."""
    corrupt: int = 0
    late: int = 0
    """Too late for its set."""
    doubled: int = 0
    """Second frames of a pulse, ignored."""
    reordered: int = 0
    """After a newer one, but in time."""
    unproven: int = 0
    """Of those delivered: frames whose pulse or time is not certain; their sets are not complete."""
    stray: int = 0
    """Implausible time stamp."""
    counter_jumps: int = 0
    """Counter and time disagree."""
    last_pulse: int = -1
    """Set of the last usable frame in time; -1: none."""


@dataclass
class Assembly:
    """Running counts of an assembly; mutable, may be read at any time."""

    frames: int = 0
    sets: int = 0
    complete_sets: int = 0
    """Sets with a usable frame of each camera, whose pulses and times are certain."""
    empty_sets: int = 0
    skipped_sets: int = 0
    """Whole sets that a live run skipped to bound its latency (``mosca.live``)."""
    cameras: dict[str, CameraCount] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    """First occurrence of each kind of fault, as text."""

    def note(self, kind: str, frame: Frame, text: str) -> None:
        """Keep the first note of its kind."""
        if kind not in self.notes:
            self.notes[kind] = f"{frame.camera}, frame {frame.index}: {text}"


def assemble(
    frames: Iterable[Frame],
    cameras: Sequence[CameraInfo],
    settings: AssemblySettings | None = None,
    assembly: Assembly | None = None,
) -> Iterator[FrameSet]:
    """Yield the frame sets of ``frames``, one a pulse without gaps; the first set is pulse 0.

    A pulse in which no camera delivered yields an empty set at its expected time. ``assembly`` is filled while the
    iteration runs. Raises InputError for cameras of different rates, for a frame of an unknown camera and when only
    frames with implausible times come.
    """
    settings = settings or AssemblySettings()
    counts = assembly if assembly is not None else Assembly()
    counts.cameras.update({info.name: CameraCount() for info in cameras})
    period_ns = 1e9 / _common_rate_hz(cameras)
    stream = iter(frames)
    first = list(islice(stream, max(settings.start_frames, 2 * len(cameras))))
    if not first:
        return
    clock = PulseClock(period_ns, [mid_exposure_ns(frame) for frame in first])
    window = _Window([info.name for info in cameras], clock, settings, counts)
    for frame_set in _through(window, first, stream):
        yield _nominal(frame_set, period_ns) if settings.nominal_times else frame_set


def _through(window: "_Window", first: Iterable[Frame], stream: Iterable[Frame]) -> Iterator[FrameSet]:
    for frame in first:
        window.take(frame)
    yield from window.ready()
    for frame in stream:
        window.take(frame)
        yield from window.ready()
    yield from window.rest()


def _nominal(frame_set: FrameSet, period_ns: float) -> FrameSet:
    """Return the set with its frames exposed as if pulse k had come after k nominal periods exactly."""
    begin_ns = round(frame_set.pulse * period_ns)
    frames = {
        name: replace(frame, time_ns=begin_ns, stamp_event="exposure_start")
        for name, frame in frame_set.frames.items()
    }
    times = [mid_exposure_ns(frame) for frame in frames.values()]
    return FrameSet(frame_set.pulse, _median(times) if times else begin_ns, frames)


def _common_rate_hz(cameras: Sequence[CameraInfo]) -> float:
    if not cameras:
        raise InputError("assembly: no cameras; a source must name at least one")
    rate = cameras[0].frame_rate_hz
    for info in cameras:
        if not (info.frame_rate_hz > 0 and math.isclose(info.frame_rate_hz, rate, rel_tol=1e-3)):
            raise InputError(
                f"assembly: camera '{info.name}' states {info.frame_rate_hz:g} frames/s and "
                f"'{cameras[0].name}' {rate:g}; triggered cameras share one rate above 0"
            )
    return rate


class PulseClock:
    """Time of each pulse: a line whose phase and period follow the sets by an alpha-beta filter.

    (Bar-Shalom, Li & Kirubarajan 2001, section 6.5; small gains, since pulses come from one oscillator.)
    The starting phase is the circular mean of the first frames' times modulo the period, so that one
    jittered frame cannot spoil it. Times are integers from the first frame on; floats hold differences.
    """

    def __init__(self, period_ns: float, first_ns: Sequence[int]) -> None:
        self._origin_ns = sorted(first_ns)[len(first_ns) // 2]
        self._nominal_ns = period_ns
        self._period_ns = period_ns
        turns = [math.fmod(t - self._origin_ns, period_ns) / period_ns for t in first_ns]
        phase = cmath.phase(sum(cmath.exp(2j * math.pi * turn) for turn in turns)) / (2 * math.pi)
        self._pulse = 0
        self._time_ns = phase * period_ns

    def pulse_of(self, time_ns: int) -> int:
        """Return the number of the pulse nearest to ``time_ns``; 0 is near the middle of the first frames."""
        return self._pulse + round((time_ns - self._origin_ns - self._time_ns) / self._period_ns)

    def expected_ns(self, pulse: int) -> int:
        """Return when ``pulse`` is expected [ns]."""
        return self._origin_ns + round(self._time_ns + (pulse - self._pulse) * self._period_ns)

    def follow(self, pulse: int, time_ns: int) -> None:
        """Correct the clock with the measured time of a ``pulse`` later than those before."""
        steps = max(pulse - self._pulse, 1)
        predicted = self._time_ns + (pulse - self._pulse) * self._period_ns
        residual = time_ns - self._origin_ns - predicted
        self._pulse, self._time_ns = pulse, predicted + PHASE_GAIN * residual
        period = self._period_ns + PERIOD_GAIN * residual / steps
        reach = LARGEST_RATE_ERROR * self._nominal_ns
        self._period_ns = min(max(period, self._nominal_ns - reach), self._nominal_ns + reach)


class _Window:
    """The pulses that are open, in clock numbers (which may start below 0)."""

    def __init__(self, names: Sequence[str], clock: PulseClock, settings: AssemblySettings, counts: Assembly) -> None:
        self._names = tuple(names)
        self._clock = clock
        self._settings = settings
        self._counts = counts
        self._open: dict[int, dict[str, tuple[int, Frame]]] = {}
        self._closed: OrderedDict[int, set[str]] = OrderedDict()
        self._first: int | None = None
        self._next: int | None = None
        self._newest = 0
        self._last: dict[str, tuple[int, int]] = {}
        self._strays_in_a_row = 0

    def take(self, frame: Frame) -> None:
        """Put ``frame`` into the set of its pulse, or count why not."""
        count = self._counts.cameras.get(frame.camera)
        if count is None:
            raise InputError(
                f"assembly: frame {frame.index} of unknown camera '{frame.camera}'; "
                f"the source named {', '.join(self._names)}"
            )
        self._counts.frames += 1
        time_ns = mid_exposure_ns(frame)
        pulse = self._clock.pulse_of(time_ns)
        if self._is_stray(pulse, frame, count):
            return
        if self._next is not None and pulse < self._next:
            self._take_late(pulse, frame, count)
            return
        answers = self._open.setdefault(pulse, {})
        if frame.camera in answers:
            count.doubled += 1
            self._counts.note("doubled", frame, "a second frame of its pulse, ignored")
            return
        answers[frame.camera] = (time_ns, frame)
        self._newest = max(self._newest, pulse)
        self._check_order(pulse, frame, count)

    def ready(self) -> Iterator[FrameSet]:
        """Yield, in order, the sets that are complete or have waited long enough."""
        while self._open:
            oldest = min(self._open)
            complete = len(self._open[oldest]) == len(self._names) and self._next in (None, oldest)
            if not complete and len(self._open) <= self._settings.open_pulses:
                return
            yield from self._close_until(oldest)

    def rest(self) -> Iterator[FrameSet]:
        """Yield what is left when no more frames come."""
        for pulse in sorted(self._open):
            yield from self._close_until(pulse)

    def _close_until(self, pulse: int) -> Iterator[FrameSet]:
        if self._first is None or self._next is None:
            self._first = self._next = pulse
        for number in range(self._next, pulse + 1):
            yield self._close(number, number - self._first)

    def _close(self, pulse: int, number: int) -> FrameSet:
        answers = self._open.pop(pulse, {})
        usable: dict[str, Frame] = {}
        times = []
        for name in self._names:
            count = self._counts.cameras[name]
            time_ns, frame = answers.get(name, (0, None))
            if frame is None or frame.status == "dropped":
                count.dropped += 1
                if frame is not None:
                    self._counts.note("dropped", frame, frame.note or "dropped")
            elif frame.status == "corrupt":
                count.corrupt += 1
                self._counts.note("corrupt", frame, frame.note or "corrupt")
            else:
                count.delivered += 1
                count.unproven += bool(frame.doubt)
                count.last_pulse = number
                usable[name] = frame
                times.append(time_ns)
        self._counts.sets += 1
        self._counts.complete_sets += len(usable) == len(self._names) and not any(f.doubt for f in usable.values())
        self._counts.empty_sets += not usable
        self._closed[pulse] = set(answers)
        if len(self._closed) > REMEMBERED_SETS:
            self._closed.popitem(last=False)
        self._next = pulse + 1
        if not times:
            return FrameSet(number, self._clock.expected_ns(pulse), usable)
        middle_ns = _median(times)
        self._clock.follow(pulse, middle_ns)
        return FrameSet(number, middle_ns, usable)

    def _take_late(self, pulse: int, frame: Frame, count: CameraCount) -> None:
        answered = self._closed.get(pulse)
        if answered is not None and frame.camera in answered:
            count.doubled += 1
            self._counts.note("doubled", frame, "a second frame of its pulse, ignored")
            return
        if frame.status == "dropped":
            return  # its set has counted it already
        count.late += 1
        if answered is not None:
            answered.add(frame.camera)
            count.dropped -= 1
        self._counts.note("late", frame, "its set had been closed")

    def _is_stray(self, pulse: int, frame: Frame, count: CameraCount) -> bool:
        reach = self._settings.longest_gap_pulses
        if abs(pulse - self._newest) <= reach:
            self._strays_in_a_row = 0
            return False
        count.stray += 1
        self._strays_in_a_row += 1
        self._counts.note("stray", frame, f"stamped {pulse - self._newest} pulses from the newest frame")
        if self._strays_in_a_row >= 10 * len(self._names):
            raise InputError(
                f"assembly: the last {self._strays_in_a_row} frames are all more than {reach} pulses from "
                f"those before (camera '{frame.camera}', frame {frame.index}, {frame.time_ns} ns); "
                "the clock was set or the recording paused: split it there"
            )
        return True

    def _check_order(self, pulse: int, frame: Frame, count: CameraCount) -> None:
        last = self._last.get(frame.camera)
        if last is not None and pulse < last[0]:
            count.reordered += 1
            self._counts.note("reordered", frame, "came after a newer frame")
            return
        if last is not None and frame.index - last[1] != pulse - last[0]:
            count.counter_jumps += 1
            self._counts.note(
                "counter_jumps",
                frame,
                f"its counter went on by {frame.index - last[1]}, its time by {pulse - last[0]} pulses",
            )
        self._last[frame.camera] = (pulse, frame.index)


def _median(times: list[int]) -> int:
    times.sort()
    half = len(times) // 2
    return times[half] if len(times) % 2 else (times[half - 1] + times[half]) // 2
