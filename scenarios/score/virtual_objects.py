"""Objects that follow tracked bodies, compared with the true poses of the bodies at the shown instants."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mosca.calibration.common.robust_fit import rigid
from mosca.data.arrays import Array, set_read_only
from mosca.data.bodies import RigidBody
from mosca.rigid_bodies.pose import vector_of
from scenarios.score.tracks import BLOCKS, block_of, ratio_of_sums
from scenarios.types import Score
from scenarios.virtual.objects import CURRENT, ShownPoses
from twin.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class ObjectErrors:
    """Errors of each shown object (n): shown minus true pose, and the same without prediction."""

    position_m: Array
    """(n, 3) at the intended instant."""
    rotation_rad: Array
    """(n, 3) rotation vector about the world's axes."""
    unpredicted_m: Array
    """(n, 3) error of the newest measured pose, at the display's instant."""
    unpredicted_rad: Array
    """(n, 3)"""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.position_m))
        set_read_only(self, position_m=(n, 3), rotation_rad=(n, 3), unpredicted_m=(n, 3), unpredicted_rad=(n, 3))


def object_errors(shown: ShownPoses, bodies: Sequence[RigidBody], scene: Scene) -> ObjectErrors:
    """Return the errors of ``shown``; NaN beyond the scene's end, and for bodies with markers that are not in it."""
    true_pose = _true_poses(bodies, scene)
    rows = np.full((len(shown), 4, 3), np.nan)
    for k in range(len(shown)):
        body = str(shown.body[k])
        meant, now = true_pose(body, int(shown.meant_ns[k])), true_pose(body, int(shown.time_ns[k]))
        if meant is None or now is None:
            continue
        rows[k, 0] = shown.position[k] - meant[1]
        rows[k, 1] = vector_of(shown.rotation[k] @ meant[0].T)
        rows[k, 2] = shown.measured_position[k] - now[1]
        rows[k, 3] = vector_of(shown.measured_rotation[k] @ now[0].T)
    return ObjectErrors(*rows.swapaxes(0, 1))


def object_scores(
    shown: ShownPoses, errors: ObjectErrors, calibration_m2: Callable[[Array], Array] | None
) -> dict[str, Score]:
    """Return rms errors of the objects whose motion is known, their share, NEES of the position, age of the poses.

    ``calibration_m2``: covariance (n, 3, 3) that the calibration's error adds to points (n, 3).
    """
    n = len(shown)
    block = block_of(n)
    blocks = min(BLOCKS, n)

    def over_blocks(values: Array, rows: Array) -> tuple[Array, Array]:
        chosen = block[rows]
        return np.bincount(chosen, values[rows], blocks), np.bincount(chosen, minlength=blocks)

    current = np.asarray(np.isin(shown.status, CURRENT))
    known = np.asarray(np.isfinite(errors.position_m).all(axis=1))
    scores = {"objects_current": ratio_of_sums(*over_blocks(current.astype(float), known), int(known.sum()))}
    rows: Array = known & current
    if not rows.any():
        return scores
    count = int(rows.sum())
    for name, vectors in (("position", errors.position_m), ("angle", errors.rotation_rad)):
        squares = np.where(rows, (np.nan_to_num(vectors) ** 2).sum(axis=1), 0.0)
        scores[f"object_{name}_rms"] = ratio_of_sums(*over_blocks(squares, rows), count, np.sqrt)
    spread = shown.covariance[:, :3, :3] + (0.0 if calibration_m2 is None else calibration_m2(shown.position))
    off = np.nan_to_num(errors.position_m)
    nees = (off * np.linalg.solve(spread, off[:, :, None])[:, :, 0]).sum(axis=1)
    scores["object_nees"] = ratio_of_sums(*over_blocks(nees, rows), count)
    scores["object_age_p99"] = Score(float(np.quantile(shown.age_s[rows], 0.99)), count)
    return scores


def shown_words(shown: ShownPoses, errors: ObjectErrors | None) -> str:
    """Return a line on the age of the shown poses, and the gain by prediction."""
    if not len(shown):
        return "no body was found: no object moved"
    p50, p99 = 1e3 * np.quantile(shown.age_s, [0.5, 0.99])
    others = "".join(f", {int((shown.status == one).sum())} {one}" for one in ("starting", "stale"))
    line = f"{len(shown)} shown{others}; from exposure to display {p50:.1f} ms, p99 {p99:.1f} ms (simulated)"
    if errors is None:
        return line
    rows = np.isin(shown.status, CURRENT) & np.isfinite(errors.position_m).all(axis=1)
    if not rows.any():
        return line
    away, late = (1e3 * np.sqrt((v[rows] ** 2).sum(axis=1).mean()) for v in (errors.position_m, errors.unpredicted_m))
    return f"{line}; objects off by {away:.3g} mm rms, unpredicted {late:.3g} mm"


def _true_poses(bodies: Sequence[RigidBody], scene: Scene) -> Callable[[str, int], tuple[Array, Array] | None]:
    """Return a function of body and time [ns] -> pose that maps the body's definition onto its true markers."""
    sampler, row_of = scene.sampler(), {name: row for row, name in enumerate(scene.marker_names)}
    of = {body.name: body for body in bodies}

    def pose(name: str, time_ns: int) -> tuple[Array, Array] | None:
        body, time_s = of[name], time_ns * 1e-9
        if not 0.0 <= time_s <= scene.duration_s or not set(body.markers) <= set(row_of):
            return None
        found = rigid(body.positions, sampler.at(time_s).marker_xyz[[row_of[one] for one in body.markers]])
        return found.rotation, found.translation

    return pose
