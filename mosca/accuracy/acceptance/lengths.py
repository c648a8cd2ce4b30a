"""Length measurement errors on measuring lines, in the manner of VDI/VDE 2634 part 1.

Not "per" VDI/VDE 2634-1: the guideline's text was not at hand. The test follows accounts of it by others. It has at
least seven measuring lines with at least five test lengths each. The lines end in the corners of the volume, and the
longest test length is at least two thirds of the volume's space diagonal. The length measurement error is the
measured minus the calibrated length; each error must be within E = A + K L <= B.
"""

from dataclasses import dataclass

import numpy as np

from mosca.accuracy.acceptance.artefact import AcceptanceFile, CertifiedLength, MeasuringLine
from mosca.accuracy.acceptance.decision import Decided, Decision, decided, overall
from mosca.accuracy.acceptance.series import sigma_of_mean, stretch
from mosca.data.arrays import Array
from mosca.data.tracks import Tracks

FEWEST_LINES, FEWEST_LENGTHS, DIAGONAL_SHARE = 7, 5, 2 / 3
CORNER_SHARE = 0.25
"""An end is in a corner if it is within this share of each edge from the corner (our reading of "corner")."""
SAME_LINE = 0.05
"""Two lines whose ends are nearer to each other than this share of the space diagonal count as one."""
FEWEST_SAMPLES = 3


@dataclass(frozen=True)
class LengthError:
    """One test length on one line; fields are None where it was not measured."""

    line: str
    markers: tuple[str, str]
    calibrated_m: float
    permitted_m: float
    samples: int
    measured_m: float | None
    """Mean measured length over the samples."""
    error_m: float | None
    sigma_m: float | None
    """Standard uncertainty of the error, from the certificate's and that of the mean."""
    decided: Decided | None


@dataclass(frozen=True)
class Premise:
    """A condition of the test, and whether it is met."""

    text: str
    met: bool


@dataclass(frozen=True)
class PointSpread:
    """Scatter of points at rest about their means."""

    samples: int
    rms_m: float
    largest_m: float
    decided: Decided | None


@dataclass(frozen=True)
class LengthResult:
    """All test lengths."""

    errors: tuple[LengthError, ...]
    premises: tuple[Premise, ...]
    decision: Decision
    spread: PointSpread | None

    @property
    def complete(self) -> bool:
        """Whether every test length was measured."""
        return all(one.error_m is not None for one in self.errors)

    @property
    def samples(self) -> int:
        """Number of test lengths that were measured."""
        return sum(one.error_m is not None for one in self.errors)

    @property
    def share(self) -> float:
        """Largest ratio of an error to its permitted value; NaN where no length was measured."""
        shares = [abs(one.error_m) / one.permitted_m for one in self.errors if one.error_m is not None]
        return max(shares, default=float("nan"))


def length_result(tracks: Tracks, given: AcceptanceFile) -> LengthResult:
    """Return the errors of all test lengths on all lines of ``given`` in labelled ``tracks``.

    Where a length was not measured or a premise fails, the result is "not conforming" or "undecided".
    """
    errors, ends, apart = [], {}, []
    for line in given.line:
        there = stretch(tracks, line.time_s)
        for length in given.bar_of(line).length:
            errors.append(_error(there, line, length, given))
        ends[line.name] = _ends(there, given, line)
        if line.at_rest:
            apart += _apart(there, given, line)
    premises = _premises(errors, ends, given)
    found = [one.decided.decision if one.decided is not None else "undecided" for one in errors]
    spread = _spread(apart, given)
    if spread is not None and spread.decided is not None:
        found.append(spread.decided.decision)
    decision = overall(found)
    if decision == "conforming" and not all(one.met for one in premises):
        decision = "undecided"
    return LengthResult(tuple(errors), tuple(premises), decision, spread)


def _error(tracks: Tracks, line: MeasuringLine, length: CertifiedLength, given: AcceptanceFile) -> LengthError:
    assert given.length_error is not None
    permitted = given.length_error.permitted_m(length.length_m)
    distance, variance = _distances(tracks, length.markers)
    head = (line.name, length.markers, length.length_m, permitted, len(distance))
    if len(distance) < FEWEST_SAMPLES:
        return LengthError(*head, None, None, None, None)
    measured = float(distance.mean())
    error = measured - length.length_m
    sigma = float(np.hypot(length.sigma_m, sigma_of_mean(distance, variance)))
    return LengthError(*head, measured, error, sigma, decided(error, permitted, sigma))


def _distances(tracks: Tracks, markers: tuple[str, str]) -> tuple[Array, Array]:
    """Return the distance (n,) [m] of two markers in the frames with both, and its stated variance (n,) [m^2]."""
    rows = [np.flatnonzero(tracks.label == name) for name in markers]
    _, a, b = np.intersect1d(tracks.frame[rows[0]], tracks.frame[rows[1]], return_indices=True)
    first, second = rows[0][a], rows[1][b]
    between = tracks.xyz[second] - tracks.xyz[first]
    distance = np.linalg.norm(between, axis=1)
    unit = between / distance[:, None]
    covariance = tracks.covariance[first] + tracks.covariance[second]
    return distance, np.einsum("ni,nij,nj->n", unit, covariance, unit)


def _ends(tracks: Tracks, given: AcceptanceFile, line: MeasuringLine) -> Array | None:
    """Return the mean positions (2, 3) [m] of the ends of a line's longest test length; None where not seen."""
    longest = max(given.bar_of(line).length, key=lambda one: one.length_m)
    places = [tracks.xyz[tracks.label == name] for name in longest.markers]
    return None if not all(map(len, places)) else np.array([one.mean(axis=0) for one in places])


def _apart(tracks: Tracks, given: AcceptanceFile, line: MeasuringLine) -> list[Array]:
    """Return the distances [m] of each marker's samples from their mean."""
    found = []
    for name in dict.fromkeys(marker for one in given.bar_of(line).length for marker in one.markers):
        xyz = tracks.xyz[tracks.label == name]
        if len(xyz) >= FEWEST_SAMPLES:
            found.append(np.linalg.norm(xyz - xyz.mean(axis=0), axis=1))
    return found


def _spread(apart: list[Array], given: AcceptanceFile) -> PointSpread | None:
    if not apart:
        return None
    every = np.concatenate(apart)
    rms, largest = float(np.sqrt(np.mean(every**2))), float(every.max())
    n = min(map(len, apart))
    # the mean from which distances are measured is itself uncertain
    sigma = rms / np.sqrt(n)
    limit = None if given.probing is None else decided(largest, given.probing.spread_m, float(sigma))
    return PointSpread(len(every), rms, largest, limit)


def _premises(errors: list[LengthError], ends: dict[str, Array | None], given: AcceptanceFile) -> list[Premise]:
    measured = [one for one in errors if one.error_m is not None]
    per_line = {line.name: sum(one.line == line.name for one in measured) for line in given.line}
    full = [name for name, count in per_line.items() if count >= FEWEST_LENGTHS]
    size = np.array(given.volume.size_m)
    diagonal = float(np.linalg.norm(size))
    longest = max((one.calibrated_m for one in measured), default=0.0)
    apart = _different([ends[name] for name in full], SAME_LINE * diagonal)
    cornered = [name for name in full if (at := ends[name]) is not None and _in_corner(at, given)]
    missing = len(errors) - len(measured)
    return [
        Premise(
            f"{apart} different measuring lines with {FEWEST_LENGTHS} test lengths and more; {FEWEST_LINES} wanted",
            apart >= FEWEST_LINES,
        ),
        Premise(
            f"the longest test length is {longest:.4g} m, {100 * longest / diagonal:.1f} % of the space diagonal of "
            f"{diagonal:.4g} m; two thirds are wanted",
            longest >= DIAGONAL_SHARE * diagonal,
        ),
        Premise(
            f"{len(cornered)} lines have an end in a corner of the volume; {FEWEST_LINES} are wanted",
            len(cornered) >= FEWEST_LINES,
        ),
        Premise(f"{missing} of {len(errors)} test lengths were not measured; none may be missing", missing == 0),
    ]


def _different(ends: list[Array | None], near_m: float) -> int:
    """Return the number of different lines among those with known ends (2, 3); near ones count once."""
    kept: list[Array] = []
    for one in ends:
        if one is None:
            continue
        same = (min(np.abs(one - k).max(), np.abs(one[::-1] - k).max()) < near_m for k in kept)
        if not any(same):
            kept.append(one)
    return len(kept)


def _in_corner(ends: Array, given: AcceptanceFile) -> bool:
    half = np.array(given.volume.size_m) / 2
    share = np.abs(ends - np.array(given.volume.center_m)) / half
    return bool((share >= 1 - 2 * CORNER_SHARE).all(axis=1).any())
