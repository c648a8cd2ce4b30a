"""Motion models of targets between two instants: constant velocity, or an acceleration with a correlation time.

``velocity``: white acceleration, constant over each step (Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2).
``acceleration``: Singer's model, an exponentially correlated acceleration (the same, section 8.2.3; Singer 1970). It
ranges from nearly constant acceleration (memory longer than the step) to nearly constant velocity (shorter).
"""

import math
from typing import NamedTuple

SHORT = 1e-2
"""Step over memory below which the closed form loses digits, and the white-jerk limit is used."""


class TransitionModel(NamedTuple):
    """One time step: transition and noise of one axis, the noise for unit variance of acceleration."""

    order: int
    """2 (position, velocity) or 3 (and acceleration)."""
    pv: float
    """Transition: position by velocity; the following likewise."""
    pa: float
    va: float
    aa: float
    qpp: float
    """Process noise: variance of position; the following are the other (co)variances."""
    qpv: float
    qpa: float
    qvv: float
    qva: float
    qaa: float


def motion(model: str, step_s: float, memory_s: float) -> TransitionModel:
    """Return the change over ``step_s`` >= 0 [s] of ``model``; ``memory_s``: how long an acceleration lasts."""
    t = step_s
    if model == "velocity":
        return TransitionModel(2, t, 0.0, 0.0, 0.0, t**4 / 4, t**3 / 2, 0.0, t * t, 0.0, 0.0)
    a = 1.0 / memory_s
    x = a * t
    e = math.exp(-x)
    if x < SHORT:
        density = 2.0 * a
        return TransitionModel(
            3, t, t * t / 2 * (1 - x / 3), t * (1 - x / 2), e,
            density * t**5 / 20, density * t**4 / 8, density * t**3 / 6,
            density * t**3 / 3, density * t * t / 2, density * t,
        )  # fmt: skip
    e2 = e * e
    return TransitionModel(
        3, t, (x - 1 + e) / a**2, (1 - e) / a, e,
        (1 - e2 + 2 * x + 2 * x**3 / 3 - 2 * x * x - 4 * x * e) / a**4,
        (e2 + 1 - 2 * e + 2 * x * e - 2 * x + x * x) / a**3,
        (1 - e2 - 2 * x * e) / a**2,
        (4 * e - 3 - e2 + 2 * x) / a**2,
        (e2 + 1 - 2 * e) / a,
        1 - e2,
    )  # fmt: skip
