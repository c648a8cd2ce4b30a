"""A rigid body's definition learned from tracks: the shape that fits all frames of a stretch best.

Generalised Procrustes analysis (Gower 1975) with the samples' covariances. It alternates between the body's pose in
every frame and each marker's position, the weighted mean of its samples in the body's frame.
"""

from collections.abc import Sequence

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import FEWEST_MARKERS, RigidBody
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.rigid_bodies.ambiguity import ALIKE_M, check_bodies
from mosca.rigid_bodies.pose import UNKNOWN_M
from mosca.rigid_bodies.pose_kernels import fit_pose

ROUNDS = 50
SETTLED_M = 1e-7
"""The estimation has converged when no marker of the model moves by more than this [m] in a round."""
NOT_RIGID_M = 0.003
"""A marker whose rms distance from its mean position is more [m] is not fixed to the others."""


def learn_body(
    tracks: Tracks, ids: Sequence[int], name: str, markers: Sequence[str] | None = None, alike_m: float = ALIKE_M
) -> RigidBody:
    """Return the rigid body whose markers are the tracks ``ids``, from all frames that show three or more of them.

    ``markers``: their names; by default ``name/1``, ``name/2``, ... The body's origin is the markers' centroid. Its
    axes are the world's in the first frame that shows all markers. ``sigma_m`` is the standard error of a
    marker's position from the samples' scatter. Raises InputError where no frame shows all markers, the markers move
    against each other or lie in a line, or the body is ambiguous under rotation.
    """
    names = tuple(markers) if markers is not None else tuple(f"{name}/{k + 1}" for k in range(len(ids)))
    if len(names) != len(ids) or len(ids) < FEWEST_MARKERS:
        raise InputError(
            f"body '{name}': {len(ids)} tracks and {len(names)} names given; as many are wanted, "
            f"{FEWEST_MARKERS} or more"
        )
    xyz, covariance = _grid(tracks, ids)
    whole = np.flatnonzero(np.isfinite(xyz).all(axis=(1, 2)))
    if not len(whole):
        raise InputError(
            f"body '{name}': no frame shows all of the tracks {', '.join(map(str, ids))} at once; name tracks that "
            "are seen together"
        )
    start = xyz[whole[0]] - xyz[whole[0]].mean(axis=0)
    places, residuals = _shape(start, xyz, covariance)
    rms = np.sqrt(np.nanmean(np.sum(residuals**2, axis=2), axis=0))
    if rms.max() > NOT_RIGID_M:
        loose = _loosest(xyz)
        raise InputError(
            f"body '{name}': its markers are up to {1e3 * rms.max():.1f} mm rms off their places, "
            f"{1e3 * NOT_RIGID_M:g} mm are allowed; '{names[loose]}' (track {ids[loose]}) moves most against the "
            "others: leave it out or learn from a stretch where it is fixed"
        )
    seen = np.isfinite(residuals).all(axis=2).sum(axis=0)
    # degrees of freedom: a pose takes 6 of the 3 m values of a frame; those that the shape takes are neglected
    share = max(1.0 - 2.0 / len(ids), 1.0 / 3.0)
    sigma = float(np.sqrt(np.mean(rms**2 / 3.0 / share / seen)))
    try:
        body = RigidBody(name, names, places - places.mean(axis=0), sigma)
    except ValueError as error:
        raise InputError(f"{error} (learned from tracks {', '.join(map(str, ids))})") from None
    check_bodies([body], alike_m)
    return body


def _grid(tracks: Tracks, ids: Sequence[int]) -> tuple[Array, Array]:
    """Return the tracks' samples by frame: (t, m, 3) [m], NaN where there is none, and (t, m, 3, 3) [m^2]."""
    measured = tracks.select((tracks.status == "measured") & np.isin(tracks.track, ids))
    frames, row = np.unique(measured.frame, return_inverse=True)
    column_of = {identity: k for k, identity in enumerate(ids)}
    column = np.array([column_of[int(t)] for t in measured.track], dtype=int)
    xyz = np.full((len(frames), len(ids), 3), np.nan)
    covariance = np.tile(UNKNOWN_M**2 * np.eye(3), (*xyz.shape[:2], 1, 1))
    xyz[row, column] = measured.xyz
    known = np.isfinite(measured.covariance).all(axis=(1, 2))
    covariance[row[known], column[known]] = measured.covariance[known]
    return xyz, covariance


def _loosest(xyz: Array) -> int:
    """Return the marker whose distances from the others change most: one loose marker spoils the fit of all."""
    distances = np.linalg.norm(xyz[:, :, None] - xyz[:, None], axis=3)
    changes = np.sqrt(np.nanmean((distances - np.nanmean(distances, axis=0)) ** 2, axis=0))
    return int(np.argmax(np.median(changes, axis=1)))


def _shape(places: Array, xyz: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the marker positions (m, 3) [m] in the body's frame, and each sample's residual (t, m, 3) in it."""
    seen = np.asarray(np.isfinite(xyz).all(axis=2))
    frames = np.flatnonzero(seen.sum(axis=1) >= 3)
    residuals = np.full(xyz.shape, np.nan)
    weight = np.linalg.inv(covariance)
    for _round in range(ROUNDS):
        normal, right = np.zeros((len(places), 3, 3)), np.zeros((len(places), 3))
        for t in frames:
            used = seen[t]
            rotation, translation = np.empty((3, 3)), np.empty(3)
            args = places[used], xyz[t, used], covariance[t, used]
            if fit_pose(*args, 0.0, rotation, translation, np.empty((6, 6)), np.empty(used.sum())) < 0:
                continue
            carried = (xyz[t, used] - translation) @ rotation
            turned = rotation.T @ weight[t, used] @ rotation
            normal[used] += turned
            right[used] += np.einsum("mij,mj->mi", turned, carried)
            residuals[t, used] = carried - places[used]
        better = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        moved = float(np.abs(better - places).max())
        places = better
        if moved < SETTLED_M:
            break
    return places, residuals
