"""Keys of an acceptance file: the artefacts with their certificates, where and when they were shown, and the limits.

Standard uncertainties are those of the artefact's certificate with a coverage factor of 1: enter half of a
certificate's expanded uncertainty U (k = 2).
"""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from mosca.data.bodies import RigidBody
from mosca.data.files.toml import NotNegative, Positive, Table, Vector, check, described, read_toml
from mosca.errors import InputError
from mosca.rigid_bodies.ambiguity import check_bodies

Stretch = tuple[NotNegative, Positive]


class AcceptanceVolume(Table):
    """The measuring volume that is tested: a box."""

    center_m: Vector = Field((0.0, 0.0, 0.0), description="its centre, world frame [m]")
    size_m: tuple[Positive, Positive, Positive] = Field(description="its edges [m]")


class CertifiedLength(Table):
    """Two markers' distance as the artefact's certificate states it."""

    markers: tuple[str, str] = Field(description="labels of the two markers")
    length_m: Positive = Field(description="calibrated distance of their centres [m]")
    sigma_m: NotNegative = Field(description="standard uncertainty of it (k = 1) [m]")

    @model_validator(mode="after")
    def _two(self) -> "CertifiedLength":
        if self.markers[0] == self.markers[1]:
            raise ValueError(f"markers: '{self.markers[0]}' given twice; two different ones are wanted")
        return self


class BallBar(Table):
    """A bar with markers at calibrated distances."""

    name: str = Field(min_length=1, description="its name")
    used_in_calibration: bool = Field(
        False, description="whether it set the scale of the calibration: it can test nothing then"
    )
    length: tuple[CertifiedLength, ...] = Field(min_length=1, description="its test lengths; [[bar.length]]")


class MeasuringLine(Table):
    """A place and direction at which a bar was measured."""

    name: str = Field(min_length=1, description="its name on the page")
    bar: str = Field(description="name of the bar that lay there")
    time_s: Stretch | None = Field(
        None, description="from when to when, counted from the take's first sample [s]; default: all of the take"
    )
    at_rest: bool = Field(True, description="whether the bar stood still: then the scatter of its points is told too")

    @model_validator(mode="after")
    def _in_order(self) -> "MeasuringLine":
        _check_stretch(self.time_s)
        return self


class LengthErrorLimits(Table):
    """What is permitted of a length L: |error| <= A + K L, and never more than B."""

    A_m: NotNegative = Field(description="constant part [m]")
    K: NotNegative = Field(description="part that grows with the length [m per m]")
    B_m: Positive = Field(description="the most that is permitted at any length [m]")

    def permitted_m(self, length_m: float) -> float:
        """Return the largest permitted error of a length [m]."""
        return min(self.A_m + self.K * length_m, self.B_m)

    @model_validator(mode="after")
    def _permits(self) -> "LengthErrorLimits":
        if self.A_m + self.K == 0:
            raise ValueError("A_m = 0 and K = 0 given; no measurement is without error: one of them must be above 0")
        return self


class ArtefactBody(Table):
    """Markers whose calibrated places tell them from others where the tracks have no labels."""

    name: str = Field(min_length=1, description="its name")
    markers: tuple[str, ...] = Field(min_length=3, description="their labels")
    positions_m: tuple[Vector, ...] = Field(description="their calibrated places in the artefact's frame [m]")
    sigma_m: NotNegative = Field(0.0, description="standard uncertainty of each coordinate [m]")

    @model_validator(mode="after")
    def _is_a_body(self) -> "ArtefactBody":
        if len(self.positions_m) != len(self.markers):
            raise ValueError(
                f"positions_m has {len(self.positions_m)} places, markers {len(self.markers)} names; give as many"
            )
        self.rigid_body()
        return self

    def rigid_body(self) -> RigidBody:
        """Return the body as a ``RigidBody`` of the pipeline; ValueError for markers in a line."""
        return RigidBody(self.name, self.markers, np.array(self.positions_m), self.sigma_m)


class ClusterPath(Table):
    """One stretch in which the bar with two clusters was carried along a path, or stood still."""

    path: str = Field(min_length=1, description="name of the path: along the volume, across it")
    orientation: str = Field(min_length=1, description="how the bar was held: along x, y, z")
    motion: Literal["dynamic", "static"] = Field("dynamic", description="whether it was moved")
    time_s: Stretch | None = Field(
        None, description="from when to when, counted from the take's first sample [s]; default: all of the take"
    )

    @model_validator(mode="after")
    def _in_order(self) -> "ClusterPath":
        _check_stretch(self.time_s)
        return self


class ClusterLimits(Table):
    """Limits of the statistics; what is left out is reported and not judged."""

    distance_rms_m: Positive | None = Field(None, description="rms error of the distance [m]")
    distance_p997_m: Positive | None = Field(None, description="99.7th percentile of its absolute error [m]")
    distance_max_m: Positive | None = Field(None, description="largest absolute error of the distance [m]")
    angle_rms_deg: Positive | None = Field(None, description="rms error of the angle [deg]")
    angle_p997_deg: Positive | None = Field(None, description="99.7th percentile of the angle's error [deg]")
    angle_max_deg: Positive | None = Field(None, description="largest error of the angle [deg]")
    missing: Annotated[float, Field(gt=0, le=1)] | None = Field(
        None, description="share of frames without both clusters"
    )


class ClusterTest(Table):
    """Two rigid clusters on one bar: distance of their middles, and angle between them, against the certificate."""

    left: str = Field(description="name of a [[body]]: the first cluster")
    right: str = Field(description="name of a [[body]]: the second cluster, in the same frame as the first")
    distance_sigma_m: NotNegative = Field(description="standard uncertainty of the clusters' distance (k = 1) [m]")
    angle_sigma_deg: NotNegative = Field(description="standard uncertainty of their angle (k = 1) [deg]")
    path: tuple[ClusterPath, ...] = Field(min_length=1, description="stretches of the take; [[clusters.path]]")
    dynamic: ClusterLimits = Field(ClusterLimits(), description="limits while the bar is moved")
    static: ClusterLimits = Field(ClusterLimits(), description="limits while the bar stands still")


class ProbingLimits(Table):
    """What is permitted of the scatter of a point at rest."""

    spread_m: Positive = Field(description="largest distance of a sample from its point's mean [m]")


class LatencyLimits(Table):
    """What is permitted of the time from mid-exposure until a result is available."""

    p99_s: Positive = Field(description="its 99th percentile [s]")


class AcceptanceFile(Table):
    """An acceptance test: artefacts, how they were shown, limits."""

    FILE_KIND: ClassVar[str] = "acceptance"

    title: str = Field(min_length=1, description="what is tested, in one line")
    description: str = Field("", description="artefact, certificate, conditions, where the limits come from")
    volume: AcceptanceVolume
    bar: tuple[BallBar, ...] = Field((), description="bars with test lengths; [[bar]]")
    line: tuple[MeasuringLine, ...] = Field((), description="measuring lines; [[line]]")
    length_error: LengthErrorLimits | None = None
    body: tuple[ArtefactBody, ...] = Field((), description="calibrated places of markers; [[body]]")
    clusters: ClusterTest | None = None
    probing: ProbingLimits | None = None
    latency: LatencyLimits | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "AcceptanceFile":
        bars = _unique("bar", [one.name for one in self.bar])
        _unique("line", [one.name for one in self.line])
        bodies = _unique("body", [one.name for one in self.body])
        used = [name for one in self.body for name in one.markers]
        for name in used:
            if used.count(name) > 1:
                raise ValueError(f"marker '{name}' stands in two [[body]]; each is of one body")
        if not self.line and self.clusters is None:
            raise ValueError("neither [[line]] nor [clusters] given; nothing would be tested: add one of them")
        if self.line and self.length_error is None:
            raise ValueError("[[line]] needs [length_error] with A_m, K and B_m: what is permitted; add it")
        for line in self.line:
            if line.bar not in bars:
                raise ValueError(f"line '{line.name}': bar = '{line.bar}' given; there are {_or_none(bars)}")
            if next(one for one in self.bar if one.name == line.bar).used_in_calibration:
                raise ValueError(
                    f"line '{line.name}': bar '{line.bar}' set the scale of the calibration and is no test length; "
                    "show another one"
                )
        if self.clusters is not None:
            for key in ("left", "right"):
                name = getattr(self.clusters, key)
                if name not in bodies:
                    raise ValueError(f"clusters.{key} = '{name}' given; there are {_or_none(bodies)}: add a [[body]]")
            if self.clusters.left == self.clusters.right:
                raise ValueError(f"clusters.left and right are both '{self.clusters.left}'; two clusters are wanted")
        return self

    def bar_of(self, line: MeasuringLine) -> BallBar:
        """Return the bar that was measured on a line."""
        return next(one for one in self.bar if one.name == line.bar)

    def body_of(self, name: str) -> RigidBody:
        """Return the body of that name."""
        return next(one for one in self.body if one.name == name).rigid_body()


def read_acceptance(path: Path) -> AcceptanceFile:
    """Read an acceptance file; InputError names file, key, value and what is allowed."""
    given = check(AcceptanceFile, read_toml(Path(path)), path)
    try:
        check_bodies([one.rigid_body() for one in given.body])
    except InputError as error:
        raise InputError(f"{path}: key 'body': {error}") from None
    return given


def acceptance_schema() -> dict[str, Any]:
    """Return the JSON schema of acceptance files."""
    return described(AcceptanceFile.model_json_schema())


def _check_stretch(time_s: Stretch | None) -> None:
    if time_s is not None and not time_s[0] < time_s[1]:
        raise ValueError(f"time_s = [{time_s[0]:g}, {time_s[1]:g}] given; the earlier time first is wanted")


def _unique(what: str, names: list[str]) -> list[str]:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"[[{what}]] '{name}' is given twice; names must differ")
    return names


def _or_none(names: list[str]) -> str:
    return ", ".join(f"'{name}'" for name in names) or "none"
