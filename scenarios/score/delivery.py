"""Completeness of a run: complete frame sets of its pulses, or all frames of free-running cameras."""

from collections.abc import Iterable, Mapping
from typing import Any

from mosca.continuous.association.associate import Associated
from mosca.synchronisation import Assembly, CameraCount
from scenarios.build.cameras import deliveries
from scenarios.spec.limits import end_of
from scenarios.spec.scenario import Scenario
from scenarios.types import CameraFrames, Score
from twin.cameras.delivery import Delivery
from twin.cameras.exposure.shutter import Timing, numbers_in
from twin.cameras.virtual_camera import VirtualCamera

LOSS_SIGMAS = 4.0
"""Standard deviations by which random losses may exceed the expectation that a scenario states: exceeded once in
30,000 runs. At half one run in 44 would fail by chance; at double twice as large an excess over the stated losses
passes."""
LONGER = 1
"""Frames by which a take may be longer than its scenario before its own length counts: a free-running camera begins
and ends between pulses."""
CLOCK_ERROR = 1e-4
"""Largest error of a camera's oscillator (data sheets state 20 to 100 ppm). By this share, a take of a free-running
camera may have fewer frames than at its nominal rate, or appear longer than it was."""


def expected_sets(assembly: Assembly, pulses: int, account: Mapping[str, Any]) -> int:
    """Return the number of pulses for which a take must have frame sets: the scenario's, or its own if larger.

    Parameters
    ----------
    assembly
        Counts of the take; its number of sets is that of the pulses spanned by the frames' stamps.
    pulses
        Number in the scenario.
    account
        The source's own account; its ``pulses`` is the number triggered.
    """
    triggered = account.get("pulses")
    if triggered is None:
        triggered = assembly.sets if assembly.sets > pulses + LONGER else pulses
    return max(pulses, int(triggered))


def sets_complete(assembly: Assembly, expected: int) -> Score:
    """Return the share of the ``expected`` frame sets that were complete."""
    return Score(assembly.complete_sets / expected, expected)


def camera_frames(
    spec: Scenario,
    gathered: Associated,
    cameras: Iterable[VirtualCamera],
    nominal_clocks: bool,
    account: Mapping[str, Any],
) -> dict[str, CameraFrames]:
    """Return the frames that each camera of a continuous run should have delivered, and those that arrived.

    Parameters
    ----------
    spec, cameras
        The scenario, and its cameras.
    gathered
        The frames that were seen.
    nominal_clocks
        Whether they open exactly at the scenario's times, as in the twin; real free-running cameras begin at any
        time, at a rate that is nominal.
    account
        The source's own account; its ``frames`` are the numbers of each camera's frames that it states to hold.
    """
    capture, timing = spec.capture, {v.camera.name: v.timing for v in cameras}
    span_s = {one.info.name: float(one.frame_ns[-1] - one.frame_ns[0]) * 1e-9 for one in gathered.seen}
    slowest_s = max(one.period_s for one in gathered.seen)
    longest_s = max(span_s[one.info.name] + timing[one.info.name].offset_s + one.period_s for one in gathered.seen)
    pulses = capture.pulses
    if longest_s > (1.0 + CLOCK_ERROR) * capture.duration_s + (1 + LONGER) * slowest_s:
        pulses = round(longest_s * capture.frame_rate_hz)
    stated = account.get("frames", {})
    found = {}
    for name, delivery in deliveries(spec, timing).items():
        if name not in span_s:
            continue
        own, count = timing[name], gathered.count
        expected = max(frames_of(own, pulses, capture.frame_rate_hz), int(stated.get(name, 0)), 1)
        if "frames_complete" in spec.limits:
            least = end_of("frames_complete", spec.limits["frames_complete"])
        else:
            begin_s = own.offset_s if own.rate_hz is not None else 0.0
            least = expected_share({name: delivery}, expected, pulses / capture.frame_rate_hz, begin_s)
            if own.rate_hz is not None and not nominal_clocks:
                least = max(0.0, least - LONGER / expected - CLOCK_ERROR)
        usable = count.frames.get(name, 0) - count.unusable.get(name, 0)
        found[name] = CameraFrames(expected, usable, count.unusable.get(name, 0), span_s[name], least)
    return found


def frames_of(timing: Timing, pulses: int, frame_rate_hz: float) -> int:
    """Return the number of frames of a camera from the first of ``pulses`` pulses until one period after the last."""
    first, end = (numbers_in(timing, pulse, frame_rate_hz).start for pulse in (0, pulses))
    return end - first


def weakest(frames: Mapping[str, CameraFrames]) -> CameraFrames:
    """Return the camera with the least share; where cameras delivered less than they should, one of these."""
    return min(frames.values(), key=lambda one: (one.share >= one.least, one.share))


def frames_complete(frames: Mapping[str, CameraFrames]) -> Score:
    """Return the share of the weakest camera's frames that arrived and are usable."""
    return Score(weakest(frames).share, sum(one.expected for one in frames.values()))


def expected_share(deliveries: Mapping[str, Delivery], pulses: int, duration_s: float, begin_s: float = 0.0) -> float:
    """Return the least share of complete sets for the losses that a scenario states; 1 where it states none.

    Parameters
    ----------
    deliveries
        Delivery of each camera of the rig.
    pulses, duration_s
        Length of the take.
    begin_s
        Opening of the first frame: a free-running camera begins later than the take.
    """
    share, burst = 1.0, 1
    for one in deliveries.values():
        lost = [one.dropped_share, one.burst_share, one.corrupt_share, one.late_share]
        if one.burst_share > 0:
            burst = max(burst, one.burst_frames)
        for part in lost:
            share *= 1.0 - part
    # random losses: binomial; where there are bursts, of bursts instead of frames
    spread = (share * (1.0 - share) * burst / pulses) ** 0.5
    alive = 1.0
    for one in deliveries.values():
        if one.dies_s is not None and one.dies_s < duration_s:
            since = max(one.dies_s, begin_s)
            until = duration_s if one.returns_s is None else min(one.returns_s, duration_s)
            alive *= 1.0 - max(0.0, until - since) / (duration_s - begin_s)
    if share == alive == 1.0:
        return 1.0
    # rounding decides whether one set at each end of an interval is lost
    ends = 2.0 / pulses if alive < 1.0 else 0.0
    return max(0.0, float(alive * share - LOSS_SIGMAS * spread - ends))


def losses(assembly: Assembly, pulses: int, rate_hz: float) -> str:
    """Return a description of the missing frames: of all cameras, then of each that lacks frames."""
    lines = [f"{assembly.complete_sets} of {pulses} pulses gave a complete set"]
    if assembly.sets < pulses:
        lines.append(f"frames ended after {assembly.sets} pulses")
    for name, count in assembly.cameras.items():
        missing = pulses - count.delivered
        if missing > 0:
            last = f"the last at {count.last_pulse / rate_hz:.2f} s" if count.delivered else "none came"
            lines.append(f"camera {name}: {missing} frames missing{_kinds(count)}, {last}")
        if count.unproven:
            lines.append(f"camera {name}: {count.unproven} frames whose pulses or times are not certain")
    return "; ".join(lines)


def frame_losses(frames: Mapping[str, CameraFrames]) -> str:
    """Return a description of the missing frames of free-running cameras that delivered less than they should."""
    return "; ".join(
        f"camera {name}: {one.expected - one.arrived} of {one.expected} frames missing"
        + (f" ({one.unusable} corrupt)" if one.unusable else "")
        + f", the last {one.span_s:.2f} s after the first"
        for name, one in frames.items()
        if one.share < one.least
    )


def _kinds(count: CameraCount) -> str:
    """Return the kinds of losses that a camera has, in brackets."""
    kinds = [f"{n} {kind}" for kind in ("corrupt", "late", "stray") if (n := getattr(count, kind))]
    return f" ({', '.join(kinds)})" if kinds else ""
