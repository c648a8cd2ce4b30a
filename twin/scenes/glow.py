"""How a target sends light to a camera: reflected back, printed, or its own."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Blink:
    """A lamp's code: ``bits`` shown one after the other for ``bit_s`` each, over and over, from ``start_s`` [s]."""

    bits: tuple[bool, ...]
    bit_s: float
    start_s: float = 0.0


@dataclass(frozen=True)
class Glow:
    """The light of one target, relative to the scenario's marker signal.

    ``kind``: "plain" equally bright from all sides and distances; "retro" retroreflective tape under the
    camera's ring light; "paper" printed and lit evenly (Lambert); "lamp" an LED. ``strength``: factor on the
    marker signal. ``half_deg``: angle off the normal at which a retro tape or an LED sends half of it.
    ``at_m``: distance at which a ring light's retro target is as bright as the marker signal says (it falls
    with the square of the distance); None: the same at all distances. ``limb``: share of its brightness that a
    ball's rim lacks. ``shade``: brightness gradient over a ball or disc, change from its middle to its rim,
    towards ``shade_world`` (3,). ``blink``: code of a lamp; None: always on.
    """

    kind: Literal["plain", "retro", "paper", "lamp"] = "plain"
    strength: float = 1.0
    half_deg: float = 45.0
    at_m: float | None = None
    limb: float = 0.0
    shade: float = 0.0
    shade_world: tuple[float, float, float] = (0.0, 0.0, 1.0)
    blink: Blink | None = None
