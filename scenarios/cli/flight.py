"""The verbs for flights in closed loop: flight map."""

from typing import Any

import click

from scenarios.cli.options import OUT_FILE, SCENARIO, Number, echo_lines
from scenarios.cli.progress import Progress


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.2 on
    """Numbers in a range: ``A,B,...`` or ``FROM:UNTIL:STEP``, both ends included."""

    name = "A,B,... or FROM:UNTIL:STEP"

    def __init__(self, least: float, below: float) -> None:
        """Set the range: ``least`` is allowed, ``below`` is not."""
        self._least, self._below = least, below

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the numbers (n,), or fail as click does."""
        if isinstance(value, tuple):
            return value
        try:
            parts = [float(part) for part in value.split(":" if ":" in value else ",")]
            if ":" in value:
                first, last, step = parts
                parts = [first + k * step for k in range(int((last - first) / step + 1.0 + 1e-9))]
        except (ValueError, ZeroDivisionError, OverflowError):
            self.fail(f"'{value}' given; numbers as 20,40,60 or 20:60:20 are wanted", param, ctx)
        if not 0 < len(parts) <= 100 or not all(self._least <= part < self._below for part in parts):
            self.fail(
                f"'{value}' given; 1 to 100 numbers from {self._least:g} to below {self._below:g} are wanted",
                param,
                ctx,
            )
        return tuple(sorted(set(parts)))


@click.group()
def flight() -> None:
    """Flights in closed loop: a drone steered by the poses that the cameras give."""


@flight.command("map")
@click.argument("scenario", type=SCENARIO)
@click.option(
    "--latency", type=Numbers(1, 1000), default="20:100:20", show_default=True, help="mean delays of the poses [ms]"
)
@click.option(
    "--dropout",
    type=Numbers(0, 1),
    default="0,0.2,0.4,0.6",
    show_default=True,
    help="shares of the poses that are lost",
)
@click.option("--runs", type=click.IntRange(2, 1000), default=10, show_default=True, help="flights of each setting")
@click.option(
    "--seconds", type=Number(1, 600), default=5.0, show_default=True, help="scored length of each flight [s]"
)
@click.option("--workers", type=click.IntRange(1, 64), default=2, show_default=True, help="processes")
@click.option("--out", type=OUT_FILE, help="the map as a table: .csv")
@click.option("--plot", type=OUT_FILE, help="the map as a picture: .svg")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help="change a key of the scenario")
def map_(latency: tuple[float, ...], **options: Any) -> None:
    """Map crashes and position error of SCENARIO's flight over latency and dropout, with 95 % intervals.

    Poses are drawn from the covariance that the rig predicts. A few frame sets are rendered to measure the noise of
    the images.

    Without prediction (flight.compensate=false) the command also prints the latency above which the linear loop is
    unstable.

    \b
    Example:  mosca flight map flight/hover --latency 20:100:20 --dropout 0,0.2,0.4,0.6 --runs 10 --plot map.svg
    """
    from scenarios.commands.flight_map import MapOptions

    with Progress("flights") as shown:
        lines = MapOptions(latency=tuple(1e-3 * one for one in latency), **options).run(shown)
    echo_lines(lines)
