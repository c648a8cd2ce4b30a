"""Zones: volumes with cameras of their own, whose tracks become one set.

"When the area to be captured is very large, the space can be split up into multiple zones of capture. Each zone has a
number of dedicated cameras that only capture markers within that zone. This data can be stitched together to get the
complete information for the entire movement." (Roesler, A Guide to Optical Motion Capture.)

Zones share the pulses and the world frame; their volumes overlap. Tracks of two zones are one target where their
positions and velocities at common instants agree within their covariances, or where one continues the other. A
constant shift between two zones' frames is estimated from common targets, reported and corrected. Samples of one
target and instant in two zones are fused, weighted by their covariances.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from itertools import combinations

import numpy as np
from pydantic import PositiveInt
from pydantic.dataclasses import dataclass
from scipy.sparse.csgraph import connected_components

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.stitching.association import Group, bridged, pairs_of, placed_like, same_target
from mosca.stitching.fusion import merged, shifted


@dataclass(frozen=True, config=SETTINGS)
class ZoneSettings:
    """When tracks of two zones are of one target."""

    gate_sigma: Positive = 4.0
    """How many standard deviations samples of one target may be apart."""
    gate_m: Positive = 0.03
    """Never farther, the zones' shift included."""
    gate_mps: NotNegative = 0.05
    """How much their velocities may differ besides their uncertainty."""
    least_common: PositiveInt = 5
    """Instants that two tracks must share to be compared."""
    bridge_s: NotNegative = 0.2
    """Longest time between zones without a sample."""
    acceleration_mps2: NotNegative = 20.0
    """Its acceleration meanwhile."""
    reported_m: NotNegative = 0.001
    """Shifts up to this are the calibrations' own error: neither reported nor corrected."""


DEFAULTS = ZoneSettings()
NEARLY = 0.7
"""Share of the largest number of votes that a smaller shift needs to be preferred."""


@plain_dataclass(frozen=True, eq=False)
class ZoneShift:
    """Positions measured by zone ``two`` minus those by zone ``one`` of the same targets."""

    one: str
    two: str
    shift_m: Array
    """(3,)"""
    covariance_m2: Array
    """(3, 3)"""
    targets: int
    """Number of common targets."""
    real: bool
    """Whether it is larger than the errors of the calibrations."""


@plain_dataclass(frozen=True, eq=False)
class Stitched:
    """The tracks of all zones as one set."""

    tracks: Tracks
    shifts: tuple[ZoneShift, ...]
    """Between zones that share targets."""
    merged: int
    """Number of samples fused from two and more."""
    handed_over: int
    """Number of targets that occur in several zones."""
    notes: tuple[str, ...]
    """Warnings, a line each."""


def stitched(zones: Mapping[str, Tracks], settings: ZoneSettings = DEFAULTS) -> Stitched:
    """Return the tracks of all ``zones`` as one set, in the first zone's frame.

    Raises InputError where fewer than two zones are given, covariances are unknown, or frames of one number were
    taken at different times.
    """
    names = tuple(zones)
    _check(zones)
    shifts = []
    for one, two in combinations(names, 2):
        shift = _shift_between(zones[one], zones[two], one, two, settings)
        if shift is not None:
            shifts.append(shift)
    places = _places(names, shifts)
    moved = {name: shifted(zones[name], -places[name]) for name in names}
    groups = _linked(moved, settings)
    tracks, doubled, torn = merged(moved, groups, settings.gate_sigma)
    handed = sum(len({zone for zone, _ in group}) > 1 for group in groups)
    return Stitched(tracks, tuple(shifts), doubled, handed, _notes(names, shifts, places, torn))


def _check(zones: Mapping[str, Tracks]) -> None:
    if len(zones) < 2:
        raise InputError(f"zones: {len(zones)} given; two or more are to be stitched")
    for name, tracks in zones.items():
        if not np.isfinite(tracks.covariance).all():
            raise InputError(
                f"zone '{name}': its samples have no covariances, which stitching rests on; give .csv or .npz as the "
                "reconstruction wrote them"
            )
    times = [dict(zip(t.frame.tolist(), t.time_ns.tolist(), strict=True)) for t in zones.values()]
    for (one, first), (two, second) in combinations(zip(zones, times, strict=True), 2):
        both = sorted(first.keys() & second.keys())
        if len(both) < 2:
            continue
        period = (first[both[-1]] - first[both[0]]) / (both[-1] - both[0])
        worst = max(both, key=lambda frame: abs(first[frame] - second[frame]))
        away = abs(first[worst] - second[worst])
        if away > 0.5 * period:
            raise InputError(
                f"zones '{one}' and '{two}': frame {worst} was taken {1e-6 * away:.3g} ms apart; zones must share "
                "the trigger and count its pulses alike"
            )


def _shift_between(one: Tracks, two: Tracks, name: str, other: str, settings: ZoneSettings) -> ZoneShift | None:
    """Return what most pairs of tracks agree on; None where the zones share no target."""
    found = pairs_of(one, two, settings.gate_m, settings.least_common)
    if not found:
        return None
    means = np.array([np.median(pair.apart, axis=0) for pair in found])
    spreads = np.array([pair.covariance.mean(axis=0) for pair in found])
    sigma = np.sqrt(np.trace(spreads, axis1=1, axis2=2) / 3)
    reach = settings.gate_sigma * np.hypot(sigma[:, None], sigma)
    near = np.linalg.norm(means[:, None] - means, axis=2) < reach
    # pairs of one target agree with each other, pairs of neighbouring targets do not
    votes = (near * np.array([len(pair.apart) for pair in found], float)).sum(axis=1)
    # pairs of different targets agree too where their spacing is regular: of the shifts with nearly as many votes
    # (NEARLY) the smallest is taken
    likely = np.where(votes >= NEARLY * votes.max(), np.linalg.norm(means, axis=1), np.inf)
    kept = near[int(likely.argmin())]
    weights = np.linalg.inv(spreads[kept])
    covariance = np.linalg.inv(weights.sum(axis=0))
    shift = covariance @ (weights @ means[kept][:, :, None]).sum(axis=0)[:, 0]
    # plus the pairs' own scatter: calibration errors vary with position
    k = int(kept.sum())
    away = means[kept] - shift
    covariance = covariance + away.T @ away / (k * max(k - 1, 1))
    sure = float(shift @ np.linalg.solve(covariance, shift)) > settings.gate_sigma**2
    return ZoneShift(name, other, shift, covariance, k, sure and float(np.linalg.norm(shift)) > settings.reported_m)


def _places(names: Sequence[str], shifts: Sequence[ZoneShift]) -> dict[str, Array]:
    """Return the shift (3,) [m] of each zone's frame from the first's, by least squares from real shifts."""
    at = {name: k for k, name in enumerate(names)}
    n = len(names)
    normal, right = np.zeros((n, n)), np.zeros((n, 3))
    for shift in shifts:
        i, j = at[shift.one], at[shift.two]
        weight = 3.0 / float(np.trace(shift.covariance_m2))
        value = shift.shift_m if shift.real else np.zeros(3)
        normal[[i, j], [i, j]] += weight
        normal[[i, j], [j, i]] -= weight
        right[j] += weight * value
        right[i] -= weight * value
    # the first zone of each connected set keeps its frame
    component = connected_components(normal != 0, directed=False)[1]
    for first in np.unique(component, return_index=True)[1]:
        normal[first, first] += max(float(np.trace(normal)), 1.0)
    solved = np.linalg.solve(normal, right)
    return {name: solved[at[name]] for name in names}


def _linked(zones: Mapping[str, Tracks], settings: ZoneSettings) -> list[Group]:
    """Return the tracks (zone, number) of each target, in the order in which targets were first seen."""
    links = []
    for one, two in combinations(zones, 2):
        for pair in pairs_of(zones[one], zones[two], settings.gate_m, settings.least_common):
            worth = same_target(pair, settings.gate_sigma, settings.gate_m, settings.gate_mps)
            if worth > 0.0:
                links.append((worth, (one, pair.one), (two, pair.two)))
    groups = placed_like(zones, links)
    if settings.bridge_s > 0.0:
        groups = bridged(zones, groups, settings.bridge_s, settings.acceleration_mps2, settings.gate_m)
    return groups


def _notes(
    names: Sequence[str], shifts: Sequence[ZoneShift], places: Mapping[str, Array], torn: int
) -> tuple[str, ...]:
    notes = []
    for shift in shifts:
        if shift.real:
            x, y, z = 1e3 * shift.shift_m
            sigma = 1e3 * float(np.sqrt(np.trace(shift.covariance_m2)))
            notes.append(
                f"zones '{shift.one}' and '{shift.two}': frames differ by ({x:.2f}, {y:.2f}, {z:.2f}) mm, known to "
                f"{sigma:.2f} mm from {shift.targets} targets; taken out in favour of '{names[0]}': calibrate both "
                "in one frame"
            )
    linked = {name for shift in shifts for name in (shift.one, shift.two)}
    for name in names:
        if name not in linked:
            notes.append(
                f"zone '{name}': shares no target with another zone; whether its frame is theirs is not known"
            )
    if torn:
        notes.append(
            f"{torn} samples of one target differ between zones by more than their covariances allow; the surer was "
            "kept"
        )
    return tuple(notes)
