"""Whether a run measured what it claims: complete frame sets among the pulses that the scenario has."""

from collections.abc import Mapping

from mosca.synchronisation import Assembly, CameraCount
from scenarios.types import Score
from twin.cameras.delivery import Delivery

LOSS_SIGMAS = 4.0
"""Random losses that a scenario states may exceed their expectation by so many standard deviations: once in 30,000
runs. At half one run in 44 would fail by chance; at double twice as large an excess over the stated losses passes."""


def sets_complete(assembly: Assembly, pulses: int) -> Score:
    """Return the share of the ``pulses`` that the scenario has whose frame set was complete."""
    return Score(assembly.complete_sets / pulses, pulses)


def expected_share(deliveries: Mapping[str, Delivery], pulses: int, duration_s: float) -> float:
    """Return the least share of complete sets that the losses which a scenario states leave; 1 where it states none.

    Parameters
    ----------
    deliveries
        Of each camera of the rig.
    pulses, duration_s
        Length of the take.
    """
    share, burst = 1.0, 1
    for one in deliveries.values():
        lost = [one.dropped_share, one.burst_share, one.corrupt_share, one.late_share]
        if one.burst_share > 0:
            burst = max(burst, one.burst_frames)
        for part in lost:
            share *= 1.0 - part
    # random losses: binomial, of bursts instead of frames where there are some
    spread = (share * (1.0 - share) * burst / pulses) ** 0.5
    alive = 1.0
    for one in deliveries.values():
        if one.dies_s is not None and one.dies_s < duration_s:
            until = duration_s if one.returns_s is None else min(one.returns_s, duration_s)
            alive *= 1.0 - max(0.0, until - one.dies_s) / duration_s
    if share == alive == 1.0:
        return 1.0
    # at the ends of an interval one set each is lost or not, by rounding
    ends = 2.0 / pulses if alive < 1.0 else 0.0
    return max(0.0, float(alive * share - LOSS_SIGMAS * spread - ends))


def losses(assembly: Assembly, pulses: int, rate_hz: float) -> str:
    """Return in words what is missing: of all cameras, then of each that lacks frames."""
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


def _kinds(count: CameraCount) -> str:
    """Return the kinds of losses that a camera has, in brackets."""
    kinds = [f"{n} {kind}" for kind in ("corrupt", "late", "stray") if (n := getattr(count, kind))]
    return f" ({', '.join(kinds)})" if kinds else ""
