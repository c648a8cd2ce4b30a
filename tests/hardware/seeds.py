"""Seeds of tests that draw their rigs: few by day, all at night."""

from typing import Any

import pytest


def seeds(by_day: int, at_night: int) -> list[Any]:
    """Return the seeds 1 to ``at_night``, of which those beyond ``by_day`` are left to the night."""
    return [pytest.param(seed, marks=[pytest.mark.slow] * (seed > by_day)) for seed in range(1, at_night + 1)]
