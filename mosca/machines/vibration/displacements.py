"""Displacements of targets from tracks, each about its own mean place, on a regular grid of frames."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.tracks import Tracks
from mosca.errors import InputError

LEAST_MEASURED = 0.9
"""Share of the frames in which a target must be measured to be used."""
FEWEST_FRAMES = 256
_TURNS = 3  # passes that find the mean places of targets on a moving carrier


@dataclass(frozen=True, eq=False)
class Displacements:
    """Displacements of c channels (targets, or their three axes in turn) at t instants of a regular grid."""

    names: tuple[str, ...]
    """(m) names of the targets."""
    place: Array
    """(m, 3) mean places of the targets [m]."""
    direction: Array
    """(d, 3) unit vectors: the normal alone, or x, y and z."""
    values: Array
    """(t, m * d) [m], NaN where not measured."""
    variance: Array
    """(m * d,) stated variance of one sample, mean over the frames [m^2]; NaN where the tracks state none."""
    rate_hz: float
    rigid: Array
    """(m * d, r) orthonormal patterns of the rigid motions that were removed; r = 0 for none."""
    left_out: tuple[str, ...]
    """Targets that are measured in too few frames."""

    def __post_init__(self) -> None:
        m, d = len(self.names), len(self.direction)
        set_read_only(self, place=(m, 3), direction=(d, 3), values=(None, m * d), variance=(m * d,))
        set_read_only(self, rigid=(m * d, None))

    @property
    def measured(self) -> Array:
        """Whether a sample was measured (t, m * d)."""
        return np.isfinite(self.values)

    @property
    def length_s(self) -> float:
        """Length of the record [s]."""
        return len(self.values) / self.rate_hz


def displacements(
    tracks: Tracks,
    rate_hz: float,
    *,
    axes: Literal["normal", "xyz"] = "normal",
    direction: Array | None = None,
    rigid_by: tuple[str, ...] | Literal["all"] | None = None,
) -> Displacements:
    """Return displacements of the targets in ``tracks``; only measured samples are used.

    Targets are the labels, or the tracks where there are no labels. Tracks without labels at nearly one place are one
    target that was lost and found again.

    Parameters
    ----------
    tracks, rate_hz
        Samples, and frames a second [Hz].
    axes
        "normal": along the direction; "xyz": all three.
    direction
        Direction of the displacements (3,); default: normal of the plane through the targets, on its upper side.
    rigid_by
        Targets whose rigid motion (rotation and translation, frame by frame) is removed: "all", which also removes
        the rigid part of the modes, or targets on the carrier, which are then left out. None: nothing is removed.

    Raises InputError where there are too few frames or targets.
    """
    names, xyz, stated, left_out = _seen(tracks.select(tracks.status == "measured"))
    kept = np.ones(len(names), dtype=bool)
    if rigid_by is not None:
        fixed = kept if rigid_by == "all" else _named(rigid_by, names, left_out)
        if fixed.sum() < 3:
            raise InputError(f"rigid motion needs 3 targets off a line; {fixed.sum()} given")
        xyz = _without_rigid(xyz, fixed)
        kept = kept if rigid_by == "all" else ~fixed
        if not kept.any():
            raise InputError("all targets are on the carrier; leave those that vibrate out of them")
    place = np.nanmean(xyz[:, kept], axis=0)
    along = np.eye(3) if axes == "xyz" else _normal(place, direction)[None]
    moved = (xyz[:, kept] - place) @ along.T
    variance = np.einsum("di,mij,dj->md", along, stated[kept], along).reshape(-1)
    patterns = _rigid_patterns(place, along) if rigid_by == "all" else np.empty((moved.shape[1] * len(along), 0))
    chosen = tuple(name for name, one in zip(names, kept, strict=True) if one)
    return Displacements(chosen, place, along, moved.reshape(len(xyz), -1), variance, rate_hz, patterns, left_out)


def _seen(tracks: Tracks) -> tuple[tuple[str, ...], Array, Array, tuple[str, ...]]:
    """Return targets measured in most frames, places (t, m, 3), covariances (m, 3, 3), and the other targets."""
    frames = np.unique(tracks.frame)
    if len(frames) < FEWEST_FRAMES:
        raise InputError(
            f"{len(frames)} frames with measured samples; {FEWEST_FRAMES} and more are wanted: record longer"
        )
    t = int(frames[-1] - frames[0]) + 1
    names, target = _targets(tracks)
    share = np.bincount(target, minlength=len(names)) / t
    kept = share >= LEAST_MEASURED
    if not kept.any():
        raise InputError(
            f"no target is measured in {LEAST_MEASURED:.0%} of frames {frames[0]} to {frames[-1]} (the best in "
            f"{share.max():.3g} of them); give --frames in which they are seen"
        )
    rows = np.flatnonzero(kept[target])
    own = (np.cumsum(kept) - 1)[target[rows]]
    xyz = np.full((t, int(kept.sum()), 3), np.nan)
    xyz[tracks.frame[rows] - frames[0], own] = tracks.xyz[rows]
    stated = _stated(tracks.covariance[rows], own, xyz.shape[1])
    inside, outside = (tuple(n for n, one in zip(names, kept, strict=True) if one == k) for k in (True, False))
    return inside, xyz, stated, outside


def channels_of(shapes: Array, direction: Array) -> Array:
    """Return the shapes (m * d, k) of the channels along ``direction`` (d, 3), for shapes (m, 3, k) in space."""
    return np.asarray(np.einsum("di,mik->mdk", direction, shapes).reshape(-1, shapes.shape[2]))


def _targets(tracks: Tracks) -> tuple[tuple[str, ...], Array]:
    """Return the targets' names, and the target of each sample (n,)."""
    if (tracks.label != "").any():
        if (tracks.label == "").any():
            raise InputError("some tracks have labels and some have none; label all, or leave the others out")
        names, target = np.unique(tracks.label, return_inverse=True)
        return tuple(names.tolist()), target
    numbers, part = np.unique(tracks.track, return_inverse=True)
    count = np.bincount(part)
    mean = np.stack([np.bincount(part, weights=tracks.xyz[:, k]) / count for k in range(3)], axis=1)
    # the longest tracks are targets; a track nearer to one than a quarter of their spacing is the same target
    order = np.argsort(-count, kind="stable")
    long = order[count[order] >= 0.5 * count.max()]
    apart = np.linalg.norm(mean[long, None] - mean[None, long], axis=-1) + np.diag(np.full(len(long), np.inf))
    reach = 0.25 * float(np.median(apart.min(axis=1))) if len(long) > 1 else np.inf
    owner = np.full(len(numbers), -1)
    heads: list[int] = []
    for k in order:
        away = np.linalg.norm(mean[heads] - mean[k], axis=-1) if heads else np.empty(0)
        if len(away) and away.min() < reach:
            owner[k] = int(np.argmin(away))
        else:
            owner[k] = len(heads)
            heads.append(int(k))
    return tuple(str(numbers[k]) for k in heads), owner[part]


def _stated(covariance: Array, target: Array, m: int) -> Array:
    """Return each target's mean (m, 3, 3) of its samples' covariances (n, 3, 3), NaN where there are none."""
    flat = covariance.reshape(-1, 9)
    known = np.isfinite(flat).all(axis=1)
    count = np.bincount(target[known], minlength=m)
    sums = np.stack([np.bincount(target[known], weights=flat[known, k], minlength=m) for k in range(9)], axis=1)
    return np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], np.nan).reshape(m, 3, 3)


def _named(wanted: tuple[str, ...], names: tuple[str, ...], left_out: tuple[str, ...]) -> Array:
    for name in wanted:
        if name in left_out:
            raise InputError(f"target '{name}' is measured in too few frames to tell a rigid motion; name another")
        if name not in names:
            raise InputError(f"no target '{name}'; there are {', '.join(names[:20])}")
    return np.isin(names, wanted)


def _without_rigid(xyz: Array, fixed: Array) -> Array:
    """Return places (t, m, 3) in axes that move with the targets ``fixed`` (m,); NaN where fewer than 3 are seen."""
    seen = np.isfinite(xyz[:, fixed, 0])
    reference = np.nanmedian(xyz[:, fixed], axis=0)
    result = xyz
    for _ in range(_TURNS):
        weight = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        points = np.where(seen[..., None], xyz[:, fixed], 0.0)
        middle = np.einsum("tm,tmi->ti", weight, points)
        home = weight @ reference
        spread = np.einsum("tm,tmi,tmj->tij", weight, reference - home[:, None], points - middle[:, None])
        u, _, vt = np.linalg.svd(spread)
        vt[:, 2] *= np.linalg.det(u @ vt)[:, None]
        result = np.einsum("tij,tmj->tmi", u @ vt, xyz - middle[:, None]) + home[:, None]
        result[seen.sum(axis=1) < 3] = np.nan
        reference = np.nanmean(result[:, fixed], axis=0)
    return result


def _normal(place: Array, direction: Array | None) -> Array:
    if direction is not None:
        length = float(np.linalg.norm(direction))
        if not length > 0:
            raise InputError(f"direction {direction.tolist()} given; three numbers that are not all 0 are wanted")
        return np.asarray(direction / length)
    if len(place) < 3:
        raise InputError(f"{len(place)} targets have no plane; give a direction, or look at x, y and z")
    normal: Array = np.linalg.svd(place - place.mean(axis=0), full_matrices=False)[2][2]
    largest = np.argmax(np.abs(normal)) if abs(normal[2]) < 1e-6 else 2
    return np.asarray(normal * np.sign(normal[largest]))


def _rigid_patterns(place: Array, along: Array) -> Array:
    """Return orthonormal patterns (m * d, r) of small rigid motions in the channels."""
    arm = place - place.mean(axis=0)
    motions = [np.tile(axis, (len(place), 1)) for axis in np.eye(3)] + [np.cross(axis, arm) for axis in np.eye(3)]
    channels = channels_of(np.stack(motions, axis=2), along)
    u, s, _ = np.linalg.svd(channels, full_matrices=False)
    return np.asarray(u[:, s > 1e-9 * s[0]])
