"""What options of the command line may hold."""

import math
from typing import Any

import click


class Number(click.FloatRange):
    """A finite number in a range: ``nan`` and ``inf`` are numbers to Python, and no lengths of time or rates."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number, or fail as click does."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number:g} is no finite number.", param, ctx)
        return number


POSITIVE = Number(min=0, min_open=True)
