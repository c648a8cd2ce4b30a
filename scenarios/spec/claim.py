"""Keys of a claim file: a scenario, what varies from run to run, and what is claimed of all runs."""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError, model_validator

from mosca.data.files.toml import Positive, Table, check, described, in_words, read_toml
from reports.metrics import METRICS
from scenarios.spec.limits import UNITS, end_of, read_limits

Key = Annotated[str, Field(min_length=1, description="dotted key of the scenario, as --set has it: errors.body_px")]
By = Annotated[
    Literal["set", "add", "scale"],
    Field(
        description="the draw replaces the key's value, is added to it or multiplies it; of a list that is added to "
        "or multiplied each number has a draw of its own"
    ),
]


class UniformDraw(Table):
    """Any number from low to high."""

    kind: Literal["uniform"]
    key: Key
    by: By = "set"
    low: float = Field(description="smallest value")
    high: float = Field(description="largest value")

    @model_validator(mode="after")
    def _in_order(self) -> "UniformDraw":
        _check_order(self.key, self.low, self.high)
        return self


class NormalDraw(Table):
    """A normally distributed number."""

    kind: Literal["normal"]
    key: Key
    by: By = "set"
    mean: float = Field(0.0, description="expectation")
    sigma: Positive = Field(description="standard deviation")


class LognormalDraw(Table):
    """A positive number whose logarithm is normally distributed."""

    kind: Literal["lognormal"]
    key: Key
    by: By = "set"
    median: Positive = Field(1.0, description="half of the draws are below")
    factor: Annotated[float, Field(gt=1)] = Field(
        description="about two of three draws are within median / factor and median * factor"
    )


class WholeDraw(Table):
    """A whole number from low to high, all alike likely."""

    kind: Literal["whole"]
    key: Key
    by: By = "set"
    low: int = Field(description="smallest value")
    high: int = Field(description="largest value")

    @model_validator(mode="after")
    def _in_order(self) -> "WholeDraw":
        _check_order(self.key, self.low, self.high)
        return self


class ChoiceDraw(Table):
    """One of some values, all alike likely."""

    kind: Literal["choice"]
    key: Key
    values: tuple[bool | int | float | str | tuple[float, ...], ...] = Field(
        min_length=2, description="values of the key"
    )


Draw = Annotated[UniformDraw | NormalDraw | LognormalDraw | WholeDraw | ChoiceDraw, Field(discriminator="kind")]


class ClaimedStatistic(Table):
    """What is claimed of a metric over all runs."""

    metric: str = Field(description="metric of each run, as in a scenario's [limits]")
    limit: float | str = Field(description="a number in the metric's unit, or a text with a unit: '0.01 %'")
    statistic: Literal["mean", "rms", "quantile"] = Field(
        description="of the runs' values: their mean, their root mean square, or what a share of the runs keeps"
    )
    quantile: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.95, description="of 'quantile': so large a share of the runs keeps the limit, each by itself"
    )
    sense: Literal["at_most", "at_least"] | None = Field(
        None, description="which side of the limit is good; default: as the metric has it"
    )
    failed_share: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.0,
        description="of 'mean' and 'rms': share of the runs that may fail and have no value; of 'quantile' a run "
        "that fails does not keep the limit",
    )

    @model_validator(mode="after")
    def _means_something(self) -> "ClaimedStatistic":
        _ = self.limit_value
        if METRICS[self.metric].speed:
            raise ValueError(
                f"{self.metric} depends on the machine and on what else it does; claim it of one run, in a scenario"
            )
        given = self.model_fields_set
        if "quantile" in given and self.statistic != "quantile":
            raise ValueError(f"quantile belongs to statistic = 'quantile', not '{self.statistic}'; leave it out")
        if "failed_share" in given and self.statistic == "quantile":
            raise ValueError("failed_share: a run that fails counts in a quantile already; leave it out")
        return self

    @property
    def limit_value(self) -> float:
        """The limit in the metric's unit."""
        try:
            read = read_limits({self.metric: self.limit})
        except ValidationError as error:
            raise ValueError(in_words(error.errors()[0])) from None
        (name,) = read
        if name != self.metric:
            raise ValueError(f"metric '{self.metric}': give {name}, and the unit with the limit: '1 {_unit(name)}'")
        return end_of(name, read[name])

    @property
    def upper(self) -> bool:
        """Whether the limit is the largest value allowed."""
        return (self.sense or METRICS[self.metric].sense) == "at_most"


class ClaimFile(Table):
    """One claim: a scenario, what varies, and what is claimed of all runs."""

    FILE_KIND: ClassVar[str] = "claim"

    title: str = Field(description="what is claimed, in one line")
    description: str = Field("", description="why, and where limits and distributions come from")
    scenario: str = Field(description="name of a built-in scenario, or a scenario file beside this one")
    seed: int = Field(
        1, ge=0, description="seed of the draws; run k has the seed seed + k: noise, paths, calibration"
    )
    runs: int = Field(200, ge=3, le=100_000, description="runs at most")
    looks: tuple[int, ...] | None = Field(
        None,
        min_length=1,
        description="numbers of runs at which there may be a verdict, ascending, the last one = runs; default: from "
        "40 on, each about 1.5 times the one before",
    )
    error_rate: Annotated[float, Field(gt=0, le=0.5)] = Field(
        0.05,
        description="largest probability of a false verdict, over all claims and looks; intervals have 1 minus it",
    )
    set: dict[str, Any] = Field({}, description="keys of the scenario that are changed in all runs: 'a.b' = value")
    vary: tuple[Draw, ...] = Field((), description="what is drawn anew for each run; [[vary]]")
    claim: tuple[ClaimedStatistic, ...] = Field(
        min_length=1, description="what is claimed; several share the error rate; [[claim]]"
    )

    @model_validator(mode="after")
    def _consistent(self) -> "ClaimFile":
        looks = self.looks
        if looks is not None and (looks[-1] != self.runs or looks[0] < 3 or any(a >= b for a, b in pairwise(looks))):
            raise ValueError(
                f"looks = {list(looks)} with runs = {self.runs}; ascending numbers from 3 on are wanted, the last "
                f"one {self.runs}"
            )
        # a key that is added to or scaled may be set before
        replaced = {one.key for one in self.vary if getattr(one, "by", "set") == "set"}
        keys = [*(key for key in self.set if key in replaced or key == "seed"), *(one.key for one in self.vary)]
        for key in keys:
            if key == "seed":
                raise ValueError("key 'seed' is varied as it is: run k has seed + k; change the claim's own seed")
            if keys.count(key) > 1:
                raise ValueError(f"key '{key}' stands twice in [set] and [[vary]]; leave one of them out")
        return self


def _check_order(key: str, low: float, high: float) -> None:
    if not low < high:
        raise ValueError(f"low = {low} and high = {high} of '{key}' given; low must be below high")


def _unit(name: str) -> str:
    return next(iter(UNITS[METRICS[name].quantity]), "")


def load_claim(path: Path) -> ClaimFile:
    """Read a claim file; InputError names file, key, value and what is allowed."""
    return check(ClaimFile, read_toml(path), path)


def claim_schema() -> dict[str, Any]:
    """Return the JSON schema of claim files."""
    return described(ClaimFile.model_json_schema())
