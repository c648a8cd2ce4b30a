"""A marker model: the markers of a subject, their distances from each other, and how much these change.

It is learned from a labelled stretch of tracks. Within a limb distances hardly change; across limbs they have a wide
range, which still separates a head from a foot. The mirror image of a subject has the same distances, so the sides
are decided by sets of four markers whose volume keeps its sign.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.data.tracks import Tracks
from mosca.errors import InputError

SOFT_M = 0.004
"""Movement of a marker on its limb by skin and clothes [m], in addition to that seen while learning."""
ACROSS_M, ACROSS_SHARE = 0.05, 0.25
"""Least change of a distance across limbs: a length [m] and a share of the distance. A T-pose shows no motion."""
RIGID_M = 0.01
"""Distances that change by less [m] are within a limb."""
BEYOND, BEYOND_SHARE = 2.0, 0.1
"""Other motions reach farther than the learned ones, by this factor and this share of the distance."""
FLAT = 0.03
"""Sets of four markers are not used for sides if their volume is less than this share of the box of their longest
edges."""
STEADY = 4.0
"""A volume farther from zero than this many standard deviations is taken to keep its sign."""
NEIGHBOURS = 6


@dataclass(frozen=True, eq=False)
class MarkerModel:
    """Markers of one subject."""

    names: tuple[str, ...]
    """(m)"""
    mean_m: Array
    """(m, m) mean distances [m], NaN where two markers were never seen together."""
    sigma_m: Array
    """(m, m) their standard deviations [m]."""
    quads: Array
    """(q, 4) sets of four markers a, b, c, d."""
    volume_m3: Array
    """(q,) their volume ``(b - a) x (c - a) . (d - a)`` [m^3]."""
    limbs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Limb -> its markers; empty where none were given."""

    @property
    def rigid(self) -> Array:
        """Which pairs (m, m) are within a limb."""
        return np.asarray((self.sigma_m < np.hypot(RIGID_M, SOFT_M)) & ~np.eye(len(self.names), dtype=bool))

    def __post_init__(self) -> None:
        m, q = len(self.names), len(np.asarray(self.quads))
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "mean_m", read_only(self.mean_m, (m, m), "mean_m"))
        object.__setattr__(self, "sigma_m", read_only(self.sigma_m, (m, m), "sigma_m"))
        object.__setattr__(self, "quads", read_only(self.quads, (q, 4), "quads", np.int64))
        object.__setattr__(self, "volume_m3", read_only(self.volume_m3, (q,), "volume_m3"))
        if m < 3 or len(set(self.names)) < m:
            raise ValueError(f"marker model: {m} names given ({len(set(self.names))} distinct); 3 or more are wanted")


def learn_model(tracks: Tracks, limbs: Mapping[str, Sequence[str]] | None = None) -> MarkerModel:
    """Return the marker model of the labelled, measured samples of ``tracks``.

    ``limbs``: limb -> labels of the markers on it; a marker may be on two limbs (at a joint), and one on no limb is a
    limb of its own. A T-pose is enough then. None: the stretch must show the subject's motions, for distances that do
    not change in it are assumed rigid. Raises InputError where a limb has an unknown label, or for fewer than 3
    labels.
    """
    names, xyz = by_label(tracks)
    if len(names) < 3:
        raise InputError(f"marker model: {len(names)} labels in the stretch; label three or more of its tracks")
    groups = {limb: tuple(members) for limb, members in (limbs or {}).items()}
    for limb, members in groups.items():
        for member in members:
            if member not in names:
                raise InputError(f"limb '{limb}': marker '{member}' is not in the stretch; it has {', '.join(names)}")
    distances = np.linalg.norm(xyz[:, :, None] - xyz[:, None], axis=3)
    mean, sigma = _moments(distances)
    if groups:
        same = np.eye(len(names), dtype=bool)
        for members in groups.values():
            rows = [names.index(member) for member in members]
            same[np.ix_(rows, rows)] = True
        sigma = np.where(same, sigma, np.maximum(sigma, ACROSS_M + ACROSS_SHARE * mean))
    else:
        same = sigma < RIGID_M
        sigma = np.where(same, sigma, BEYOND * sigma + BEYOND_SHARE * mean)
    sigma = np.hypot(sigma, SOFT_M)
    quads, volumes = _sides(xyz, mean, sigma, same)
    return MarkerModel(names, mean, sigma, quads, volumes, groups)


def by_label(tracks: Tracks) -> tuple[tuple[str, ...], Array]:
    """Return the labels (m) and their measured samples (t, m, 3) [m] by frame, NaN where there is none."""
    rows = (tracks.status == "measured") & (tracks.label != "")
    frames, at = np.unique(tracks.frame[rows], return_inverse=True)
    names, column = np.unique(tracks.label[rows], return_inverse=True)
    xyz = np.full((len(frames), len(names), 3), np.nan)
    xyz[at, column] = tracks.xyz[rows]
    return tuple(names.tolist()), xyz


def volumes_of(xyz: Array, quads: Array) -> Array:
    """Return the signed volumes (..., q) [m^3] of ``quads`` (q, 4) of points ``xyz`` (..., m, 3)."""
    a, b, c, d = (xyz[..., quads[:, k], :] for k in range(4))
    return np.asarray(np.sum(np.cross(b - a, c - a) * (d - a), axis=-1))


def _moments(values: Array) -> tuple[Array, Array]:
    """Return mean and standard deviation over the first axis, NaN where there is no value."""
    there = np.isfinite(values)
    count = np.where(there.any(axis=0), there.sum(axis=0), np.nan)
    mean = np.where(there, values, 0.0).sum(axis=0) / count
    spread = np.where(there, (values - mean) ** 2, 0.0).sum(axis=0) / count
    return mean, np.sqrt(spread)


def _sides(xyz: Array, mean: Array, sigma: Array, same: Array) -> tuple[Array, Array]:
    """Return sets of four (q, 4) whose volume (q,) keeps its sign: each marker with near ones of its limb."""
    tight = np.where(same & np.isfinite(sigma), sigma / np.maximum(mean, 1e-6), np.inf)
    np.fill_diagonal(tight, np.inf)
    sets = set()
    for k, row in enumerate(tight):
        near = [int(j) for j in np.argsort(row, kind="stable")[:NEIGHBOURS] if np.isfinite(row[j])]
        for three in combinations(near, 3):
            if all(same[i, j] for i, j in combinations(three, 2)):
                sets.add(tuple(sorted((k, *three))))
    quads = np.array(sorted(sets), dtype=np.int64).reshape(-1, 4)
    volume, spread = _moments(volumes_of(xyz, quads))
    edges = np.array([[mean[a, b], mean[a, c], mean[a, d]] for a, b, c, d in quads.tolist()]).reshape(-1, 3)
    kept = np.isfinite(volume) & (np.abs(volume) > STEADY * spread)
    kept &= np.abs(volume) > FLAT * edges.prod(axis=1)
    return quads[kept], volume[kept]
