"""Initial poses of cameras without known poses: two views by their essential matrix, the others by resection."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from mosca.calibration.initial.projective import fundamental
from mosca.calibration.initial.target_pose import poses_of
from mosca.continuous.comparison_methods.epipoles import FEWEST, TooFewPointsError, relative_pose
from mosca.continuous.comparison_methods.synchronous import Cameras, PosesAndPoints, Views, adjust, intersected
from mosca.data.arrays import Array
from mosca.errors import InputError

MOST_RAYS = 2000
"""Most correspondences that a start uses, spread evenly over all."""
STEP = 5
"""Number of instants from one with an initial value of its own to the next; those between start at the nearest."""
WORSE = 2.0
"""Instants with this many times the usual error are tried again from their neighbours' poses."""


def first_scene(views: Views, cameras: Cameras, *, epipoles: bool = True) -> PosesAndPoints:
    """Return a start for ``adjust``, adjusted once; with "moving" each instant separately.

    Datum: the first camera's pose and its distance to the second as given (with "moving" at each instant).
    ``epipoles``: whether to use them. InputError where no two cameras share enough points.
    """
    t, c = views.xy_px.shape[:2]
    poses = [camera.world_from_camera for camera in views.cameras]
    rotations = np.tile(np.array([p.rotation for p in poses]), (t, 1, 1, 1))
    centres = np.tile(np.array([p.translation for p in poses]), (t, 1, 1))
    if cameras == "known":
        return PosesAndPoints(rotations, centres, intersected(views, rotations, centres))
    if cameras == "fixed":
        try:
            found = _still(views, epipoles)
        except TooFewPointsError:
            raise InputError(
                f"cameras {', '.join(one.name for one in views.cameras)}: no two of them share 8 points at common "
                "instants (3 where both see each other); record longer or let the cameras overlap"
            ) from None
        except NoPoseError as lost:
            raise InputError(
                f"camera '{lost}': no pose fits its images of the points that two other cameras determine; check "
                'names, clocks and lenses, or give cameras = "known" with a calibrated rig'
            ) from None
        start = _scene(views, *found)
        return in_datum(adjust(views, start, "fixed", epipoles=epipoles).scene, views)
    centres, rotations = np.full((t, c, 3), np.nan), np.tile(np.eye(3), (t, c, 1, 1))
    for i in sorted(range(t), key=lambda i: (i % STEP != 0, i)):
        if i % STEP and np.isfinite(centres).any():
            break
        with suppress(TooFewPointsError, NoPoseError):
            rotations[i], centres[i] = _still(replace(views, xy_px=views.xy_px[[i]]), epipoles)
    if not np.isfinite(centres).any():
        raise InputError("moving cameras: at no instant do two cameras share 8 points (3 where both see each other)")
    return _moving(views, rotations, centres, epipoles)


def in_datum(scene: PosesAndPoints, views: Views) -> PosesAndPoints:
    """Return a scene transformed to its datum: first camera and its distance to the second as given."""
    own = views.cameras[0].world_from_camera
    other = views.cameras[1].world_from_camera
    wanted = float(np.linalg.norm(other.translation - own.translation)) or 1.0
    base = np.linalg.norm(scene.centres[:, 1] - scene.centres[:, 0], axis=1)
    scale = (wanted / base)[:, None, None]
    turn = own.rotation @ np.swapaxes(scene.rotations[:, 0], 1, 2)  # (t, 3, 3)

    def moved(x: Array) -> Array:
        away = np.einsum("tij,tmj->tmi", turn, x - scene.centres[:, :1])
        return np.asarray(own.translation + scale * away)

    return PosesAndPoints(turn[:, None] @ scene.rotations, moved(scene.centres), moved(scene.xyz))


def _moving(views: Views, rotations: Array, centres: Array, epipoles: bool) -> PosesAndPoints:
    """Adjust every instant from its own start and, where the result is poor, from its neighbours' poses."""
    ready = np.flatnonzero(np.isfinite(centres).all(axis=(1, 2)))
    nearest = ready[np.abs(ready - np.arange(len(centres))[:, None]).argmin(axis=1)]
    best = adjust(views, _scene(views, rotations[nearest], centres[nearest]), "moving", epipoles=epipoles)
    scene, rms = in_datum(best.scene, views), best.rms_px.copy()
    for _ in range(2):
        for step in (1, -1):
            beside = np.clip(np.arange(len(rms)) + step, 0, len(rms) - 1)
            again = np.flatnonzero((rms > WORSE * np.median(rms)) & (rms > rms[beside]))
            if not len(again):
                continue
            part = replace(views, xy_px=views.xy_px[again])
            start = _scene(part, scene.rotations[beside[again]], scene.centres[beside[again]])
            trial = adjust(part, start, "moving", epipoles=epipoles)
            better = trial.rms_px < rms[again]
            moved, chosen = in_datum(trial.scene, part), again[better]
            scene.rotations[chosen], scene.centres[chosen] = moved.rotations[better], moved.centres[better]
            scene.xyz[chosen], rms[chosen] = moved.xyz[better], trial.rms_px[better]
    return scene


def _scene(views: Views, rotations: Array, centres: Array) -> PosesAndPoints:
    t = len(views.xy_px)
    if rotations.ndim == 3:
        rotations, centres = np.tile(rotations, (t, 1, 1, 1)), np.tile(centres, (t, 1, 1))
    return PosesAndPoints(rotations, centres, intersected(views, rotations, centres))


class NoPoseError(ValueError):
    """No pose of the named camera fits its images."""


def _still(views: Views, epipoles: bool) -> tuple[Array, Array]:
    """Return poses (c, 3, 3), (c, 3) of still cameras, up to a similarity.

    TooFewPointsError where no two cameras share enough points, NoPoseError where a camera's pose is not found.
    """
    rays = views.rays()
    own = rays[:, :, views.free]
    seen = np.asarray(np.isfinite(own).all(axis=-1))
    c = seen.shape[1]
    pairs = [(i, j) for i in range(c) for j in range(i + 1, c)]
    first, second = max(pairs, key=lambda pair: int((seen[:, pair[0]] & seen[:, pair[1]]).sum()))
    both = seen[:, first] & seen[:, second]
    thin = _thinned(int(both.sum()))
    a, b = own[:, first][both][thin], own[:, second][both][thin]
    toward, back = _epipole(views, rays, first, second), _epipole(views, rays, second, first)
    good = _agreeing(a, b)
    pose = relative_pose(a[good], b[good], toward if epipoles else None, back if epipoles else None).inverse()
    rotations, centres = np.tile(np.eye(3), (c, 1, 1)), np.zeros((c, 3))
    rotations[second], centres[second] = pose.rotation, pose.translation
    both_cameras = views.cameras[first], views.cameras[second]
    pair = replace(views, cameras=both_cameras, xy_px=views.xy_px[:, [first, second]])
    t = len(views.xy_px)
    both_r, both_c = rotations[[first, second]], centres[[first, second]]
    xyz = intersected(pair, np.tile(both_r, (t, 1, 1, 1)), np.tile(both_c, (t, 1, 1)))
    for k in range(c):
        if k in (first, second):
            continue
        good = np.asarray(seen[:, k] & np.isfinite(xyz).all(axis=-1))
        thin = _thinned(int(good.sum()))
        fits = poses_of(own[:, k][good][thin], xyz[good][thin])
        if not fits:
            raise NoPoseError(views.cameras[k].name)
        pose = fits[0].camera_from_target.inverse()
        rotations[k], centres[k] = pose.rotation, pose.translation
    return rotations, centres


def _agreeing(first: Array, second: Array) -> Array:
    """Return which pairs of rays (n, 3) fit one fundamental matrix: gross errors and wrong names are left out.

    All pairs are returned if there are too few to decide, or rays beyond 90 degrees from the axis.
    """
    every: Array = np.ones(len(first), dtype=bool)
    if len(first) < 2 * FEWEST[0] or min(first[:, 2].min(), second[:, 2].min()) <= 0.0:
        return every
    plain = [rays[:, :2] / rays[:, 2:] for rays in (first, second)]
    found = fundamental(plain[0], plain[1], np.random.default_rng(0))
    return found.inliers if found.inliers.sum() >= FEWEST[0] else every


def _epipole(views: Views, rays: Array, viewer: int, carrier: int) -> Array | None:
    """Return the mean ray (3,) on which one camera sees the centre of another; None where it does not."""
    for m in np.flatnonzero(views.carried_by == carrier):
        seen = rays[:, viewer, m][np.isfinite(rays[:, viewer, m]).all(axis=-1)]
        if len(seen) and not views.carried_at[m].any():
            return np.asarray(seen.mean(axis=0))
    return None


def _thinned(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, MOST_RAYS)).astype(int)) if count else np.zeros(0, int)
