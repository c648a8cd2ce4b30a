"""Errors of the pose of two rigid clusters on one bar, in the manner of ASTM E3064.

Not "per" ASTM E3064: the standard's text was not at hand. The test follows accounts of it by others (its abstract;
Bostelman et al. 2016, Coordinate Metrology Society Conference; NIST's announcement). A bar with a cluster of markers
at each end, 300 mm apart, is carried along two paths in three orientations. The measured distance and angle between
the two clusters are compared with the bar's certificate.
"""

from dataclasses import dataclass

import numpy as np

from mosca.accuracy.acceptance.artefact import AcceptanceFile, ClusterPath
from mosca.accuracy.acceptance.decision import Decided, Decision, decided, overall
from mosca.accuracy.acceptance.lengths import Premise
from mosca.accuracy.acceptance.series import frames_expected
from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.rotations import rotation_from_quaternion
from mosca.data.tracks import Tracks
from mosca.diagnostics.long_run_covariance import long_run_covariance
from mosca.rigid_bodies.tracker import body_poses

FEWEST_PATHS, FEWEST_ORIENTATIONS = 2, 3
APART_M, APART_WITHIN = 0.3, 0.05
"""Distance of the clusters' middles [m], and the share by which it may differ (our reading)."""
PERCENTILE, FEWEST_FOR_PERCENTILE = 0.997, 334
"""Percentile, and fewest samples for it: with fewer samples the 99.7th percentile is the largest value itself."""


@dataclass(frozen=True)
class ClusterFigure:
    """One statistic of one group of stretches; ``value`` None where there are too few samples."""

    group: str
    """"dynamic" or "static"; for a single stretch "PATH, ORIENTATION, MOTION"."""
    quantity: str
    """"distance" [m], "angle" [deg], "frames" [1]."""
    statistic: str
    """"rms", "p997", "max", "missing"."""
    value: float | None
    sigma: float | None
    """Standard uncertainty of ``value``, in the unit of ``quantity``."""
    samples: int
    limit: float | None
    decided: Decided | None


@dataclass(frozen=True)
class ClusterResult:
    """All statistics; the statistics of single stretches have no limits."""

    figures: tuple[ClusterFigure, ...]
    stretches: tuple[ClusterFigure, ...]
    premises: tuple[Premise, ...]
    decision: Decision

    @property
    def complete(self) -> bool:
        """Whether every figure with a limit could be computed."""
        return all(one.value is not None for one in self.figures if one.limit is not None)

    @property
    def samples(self) -> int:
        """Number of frames with both clusters, in all stretches together."""
        return sum(one.samples for one in self.stretches if one.quantity == "distance" and one.statistic == "max")

    @property
    def share(self) -> float:
        """Largest ratio of a figure to its limit; NaN where no figure has a limit."""
        shares = [one.value / one.limit for one in self.figures if one.limit is not None and one.value is not None]
        return max(shares, default=float("nan"))


@dataclass(frozen=True, eq=False)
class _Errors:
    """Times (n,) [s], errors (n,) [m, deg] and stated standard deviations (n,) of the frames with both clusters."""

    time_s: Array
    distance_m: Array
    angle_deg: Array
    distance_sigma_m: Array
    angle_sigma_deg: Array

    def within(self, time_s: tuple[float, float] | None) -> "_Errors":
        rows = np.ones(len(self.time_s), bool)
        if time_s is not None:
            rows = (self.time_s >= time_s[0]) & (self.time_s <= time_s[1])
        return _Errors(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def cluster_result(tracks: Tracks, given: AcceptanceFile) -> ClusterResult:
    """Return the statistics of distance and angle between the clusters of ``given``; ``tracks`` labelled or not."""
    test = given.clusters
    assert test is not None
    bodies = given.body_of(test.left), given.body_of(test.right)
    errors = _errors(tracks, bodies)
    stretches: list[ClusterFigure] = []
    parts: dict[str, list[tuple[_Errors, int]]] = {"dynamic": [], "static": []}
    for path in test.path:
        mine = errors.within(path.time_s)
        expected = frames_expected(tracks, path.time_s)
        parts[path.motion].append((mine, expected))
        stretches += _figures(f"{path.path}, {path.orientation}, {path.motion}", [(mine, expected)], given, {})
    figures = []
    for motion, limits in (("dynamic", test.dynamic), ("static", test.static)):
        if parts[motion]:
            figures += _figures(motion, parts[motion], given, limits.model_dump())
    premises = _premises(test.path, parts, bodies)
    found = ["undecided" if one.decided is None else one.decided.decision for one in figures if one.limit is not None]
    decision = overall(found)
    if decision == "conforming" and not all(one.met for one in premises):
        decision = "undecided"
    return ClusterResult(tuple(figures), tuple(stretches), tuple(premises), decision)


def _errors(tracks: Tracks, bodies: tuple[RigidBody, RigidBody]) -> _Errors:
    poses = body_poses(tracks, bodies)
    left, right = (poses.of(body.name) for body in bodies)
    _, a, b = np.intersect1d(left.frame, right.frame, return_indices=True)
    left, right = left.select(a), right.select(b)
    middles = [body.positions.mean(axis=0) for body in bodies]
    true_m = _apart_m(bodies)
    n = len(left)
    distance, angle, sigma_d, sigma_a = (np.empty(n) for _ in range(4))
    turns = [[rotation_from_quaternion(q) for q in one.quaternion] for one in (left, right)]
    for k in range(n):
        arms = [turns[0][k] @ middles[0], turns[1][k] @ middles[1]]
        between = right.position[k] + arms[1] - left.position[k] - arms[0]
        distance[k] = np.linalg.norm(between) - true_m
        cosine = (np.trace(turns[0][k].T @ turns[1][k]) - 1) / 2
        angle[k] = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        sigma_d[k], sigma_a[k] = _sigmas(left, right, k, between, arms)
    if not np.isfinite(tracks.covariance).all():
        # without point covariances the poses' covariances are a default: the scatter is the better estimate
        sigma_d = np.full(n, distance.std() if n else np.nan)
        sigma_a = np.full(n, angle.std() if n else np.nan)
    start = tracks.time_ns.min() if len(tracks) else 0
    return _Errors((left.time_ns - start) * 1e-9, distance, angle, sigma_d, sigma_a)


def _sigmas(left: BodyPoses, right: BodyPoses, k: int, between: Array, arms: list[Array]) -> tuple[float, float]:
    """Return the stated standard deviations of distance [m] and angle [deg] (the largest about any axis)."""
    unit = between / np.linalg.norm(between)
    variance, turning = 0.0, np.zeros((3, 3))
    for pose, arm in ((left, arms[0]), (right, arms[1])):
        # a middle moves by dt + dr x arm: its part along the bar is unit . dt + (arm x unit) . dr
        along = np.concatenate([unit, np.cross(arm, unit)])
        variance += float(along @ pose.covariance[k] @ along)
        turning += pose.covariance[k, 3:, 3:]
    return float(np.sqrt(variance)), float(np.degrees(np.sqrt(np.linalg.eigvalsh(turning)[-1])))


def _figures(
    group: str, parts: list[tuple[_Errors, int]], given: AcceptanceFile, limits: dict[str, float | None]
) -> list[ClusterFigure]:
    test = given.clusters
    assert test is not None
    found = []
    quantities: list[tuple[str, str, float, Array, Array]] = []
    for quantity, unit, certificate in (
        ("distance", "m", test.distance_sigma_m), ("angle", "deg", test.angle_sigma_deg)
    ):  # fmt: skip
        values = np.concatenate([getattr(one, f"{quantity}_{unit}") for one, _ in parts])
        sigmas = np.concatenate([getattr(one, f"{quantity}_sigma_{unit}") for one, _ in parts])
        quantities.append((quantity, unit, certificate, values, sigmas))
    for quantity, unit, certificate, values, sigmas in quantities:
        for statistic in ("rms", "p997", "max"):
            value, sigma = _statistic(statistic, values, sigmas, certificate)
            limit = limits.get(f"{quantity}_{statistic}_{unit}")
            judged = None if limit is None or value is None or sigma is None else decided(value, limit, sigma)
            found.append(ClusterFigure(group, quantity, statistic, value, sigma, len(values), limit, judged))
    frames = sum(expected for _, expected in parts)
    missing = 1 - min(sum(len(one.time_s) for one, _ in parts), frames) / frames if frames else None
    limit = limits.get("missing")
    judged = None if limit is None or missing is None else decided(missing, limit, 0.0)
    found.append(ClusterFigure(group, "frames", "missing", missing, 0.0, frames, limit, judged))
    return found


def _statistic(name: str, errors: Array, sigmas: Array, certificate: float) -> tuple[float | None, float | None]:
    """Return a statistic of ``errors`` (n,) and its standard uncertainty; None where there are too few samples.

    The certificate's uncertainty is common to all samples. A percentile or a largest error is the error of one sample
    and also has its stated uncertainty. An rms also has that of a mean of squares that are correlated in time.
    """
    n = len(errors)
    if n == 0 or (name == "p997" and n < FEWEST_FOR_PERCENTILE):
        return None, None
    if name == "rms":
        squares = errors**2
        value = float(np.sqrt(squares.mean()))
        own = 0.0
        if n > 1 and value > 0:
            own = np.sqrt(long_run_covariance((squares - squares.mean())[:, None])[0, 0]) / n / (2 * value)
    else:
        order = np.argsort(np.abs(errors))
        at = order[-1] if name == "max" else order[int(np.ceil(PERCENTILE * n)) - 1]
        value, own = float(abs(errors[at])), float(sigmas[at])
    return value, float(np.hypot(certificate, own))


def _premises(
    paths: tuple[ClusterPath, ...], parts: dict[str, list[tuple[_Errors, int]]], bodies: tuple[RigidBody, RigidBody]
) -> list[Premise]:
    moved = [one for one in paths if one.motion == "dynamic"]
    names = {one.path for one in moved}
    ways = {name: {one.orientation for one in moved if one.path == name} for name in names}
    fewest = min(map(len, ways.values()), default=0)
    samples = sum(len(one.time_s) for one, _ in parts["dynamic"])
    apart_m = _apart_m(bodies)
    return [
        Premise(f"{len(names)} paths; {FEWEST_PATHS} are wanted", len(names) >= FEWEST_PATHS),
        Premise(
            f"{fewest} orientations or more of the bar on each path; {FEWEST_ORIENTATIONS} are wanted",
            fewest >= FEWEST_ORIENTATIONS,
        ),
        Premise(
            "the bar was shown moving and at rest" if parts["static"] else "the bar was not shown at rest",
            bool(moved and parts["static"]),
        ),
        Premise(
            f"{samples} samples in motion; {FEWEST_FOR_PERCENTILE} are wanted for a 99.7th percentile",
            samples >= FEWEST_FOR_PERCENTILE,
        ),
        Premise(
            f"the clusters' middles are {1e3 * apart_m:.4g} mm apart; {1e3 * APART_M:g} mm are wanted",
            abs(apart_m - APART_M) <= APART_WITHIN * APART_M,
        ),
    ]


def _apart_m(bodies: tuple[RigidBody, RigidBody]) -> float:
    """Return the certified distance of the clusters' middles [m]."""
    left, right = (body.positions.mean(axis=0) for body in bodies)
    return float(np.linalg.norm(right - left))
