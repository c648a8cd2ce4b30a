"""Emission of targets towards a camera: retroreflection, print, or a lamp of their own."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from mosca.data.arrays import Array

GlowKind = Literal["plain", "retro", "paper", "lamp"]
ALL_SIDES_DEG = 180.0
"""``Glow.half_deg`` of a lamp that shines equally to all sides."""


@dataclass(frozen=True)
class Blink:
    """A lamp's code: ``bits``, shown one after the other for ``bit_s`` each, repeated from ``start_s`` on [s].

    Before ``start_s`` the lamp is dark.
    """

    bits: tuple[bool, ...]
    bit_s: float
    start_s: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "bits", tuple(bool(bit) for bit in self.bits))
        if not self.bits:
            raise ValueError("bits: at least one is wanted")
        _within("bit_s", self.bit_s, 0.0, math.inf, open_below=True)
        _within("start_s", self.start_s, -math.inf, math.inf)


@dataclass(frozen=True)
class Glow:
    """The light of one target, relative to the scenario's marker signal."""

    kind: GlowKind = "plain"
    """"plain": equally bright from all sides and distances; "retro": retroreflective tape under the camera's ring
    light; "paper": printed and lit evenly (Lambert); "lamp": an LED."""
    strength: float = 1.0
    """Factor on the marker signal."""
    half_deg: float = 45.0
    """Angle off the normal at which a retro tape or an LED sends half of its light; 180: an LED in a diffusing ball,
    alike to all sides."""
    at_m: float | None = None
    """Distance at which a ring light's retro target has the brightness of the marker signal (it falls with the
    square of the distance); None: the same at all distances."""
    even_deg: float | None = None
    """Angle off the normal up to which a retro tape sends all of its light. It sends half at ``half_deg`` and nothing
    as far beyond that. None: a power of the cosine."""
    ring_m: float = 0.0
    """Mean radius of the ring light: the tape is observed at the angle ``ring_m`` over the distance off the direction
    in which it sends most. Needs ``at_m``."""
    lobe_deg: float = 1.0
    """Observation angle at which a retro tape sends 1/e of what it sends straight back."""
    lamp_half_deg: float | None = None
    """Angle off the camera's axis at which its ring light sends half of its light (Lambert: 60); None: alike to all
    sides."""
    limb: float = 0.0
    """Share of brightness that a ball's rim lacks."""
    shade: float = 0.0
    """Brightness gradient over a ball or disc: change from its middle to its rim."""
    shade_world: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """(3,): direction of the gradient."""
    blink: Blink | None = None
    """Code of a lamp; None: always on."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(GlowKind):
            raise ValueError(f"kind = '{self.kind}' given; allowed: {', '.join(get_args(GlowKind))}")
        _within("strength", self.strength, 0.0, math.inf)
        if not 0 < self.half_deg < 90 and (self.kind, self.half_deg) != ("lamp", ALL_SIDES_DEG):
            raise ValueError(
                f"half_deg = {self.half_deg:g} given; above 0 and below 90 is allowed, of a lamp 180 (to all sides)"
            )
        if self.at_m is not None:
            _within("at_m", self.at_m, 0.0, math.inf, open_below=True)
        if self.even_deg is not None:
            _within("even_deg", self.even_deg, 0.0, self.half_deg)
        if self.lamp_half_deg is not None and not 0 < self.lamp_half_deg < 90:
            raise ValueError(f"lamp_half_deg = {self.lamp_half_deg:g} given; above 0 and below 90 is allowed")
        _within("lobe_deg", self.lobe_deg, 0.0, 90.0, open_below=True)
        _within("ring_m", self.ring_m, 0.0, math.inf)
        if self.ring_m > 0 and self.at_m is None:
            raise ValueError(
                f"ring_m = {self.ring_m:g} without at_m given: say at what distance it is as bright as meant"
            )
        if self.kind != "retro":
            for name in ("even_deg", "ring_m", "lamp_half_deg"):
                if getattr(self, name):
                    raise ValueError(f"kind = '{self.kind}' with {name} given; only retro tape has it")
        _within("limb", self.limb, 0.0, 1.0)
        _within("shade", self.shade, -1.0, 1.0)  # beyond, one side would send less than nothing
        length = math.hypot(*self.shade_world)
        if len(self.shade_world) != 3 or not 0 < length < math.inf:
            raise ValueError(f"shade_world = {self.shade_world} given; a direction of 3 numbers is wanted")
        if self.blink is not None and self.kind != "lamp":
            raise ValueError(f"kind = '{self.kind}' with blink given; only a lamp blinks")


def lit(blink: Blink, t0: float, t1: float) -> Array:
    """Return when a lamp is lit between ``t0`` <= ``t1`` [s]: intervals (k, 2) [s], rising and apart.

    An edge is start_s + k * bit_s, rounded once for each k, so that adjoining windows share their edges to the last
    bit. Successive lit bits make one interval.
    """
    if not -math.inf < t0 <= t1 < math.inf:
        raise ValueError(f"t0 = {t0:g}, t1 = {t1:g} given; finite and t0 <= t1 is wanted")
    found: list[tuple[float, float]] = []
    # one bit more on both sides: the division may round across an edge, so that the edges themselves must decide
    first = max(0, math.floor((t0 - blink.start_s) / blink.bit_s) - 1)
    last = math.floor((t1 - blink.start_s) / blink.bit_s) + 1
    for k in range(first, last + 1):
        if not blink.bits[k % len(blink.bits)]:
            continue
        begin = max(blink.start_s + k * blink.bit_s, t0)
        end = min(blink.start_s + (k + 1) * blink.bit_s, t1)
        if begin >= end:
            continue
        if found and found[-1][1] == begin:
            found[-1] = (found[-1][0], end)
        else:
            found.append((begin, end))
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def _within(name: str, value: float, low: float, high: float, *, open_below: bool = False) -> None:
    if not (math.isfinite(value) and low <= value <= high) or (open_below and value == low):
        below = "above" if open_below else "from"
        raise ValueError(f"{name} = {value:g} given; a finite number {below} {low:g} to {high:g} is wanted")
