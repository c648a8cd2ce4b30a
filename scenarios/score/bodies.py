"""The scene's rigid bodies as a lab would define them, and the scores of their measured poses."""

import numpy as np

from mosca.calibration.common.robust_fit import rigid
from mosca.data.arrays import Array
from mosca.data.bodies import FEWEST_MARKERS, BodyPoses, RigidBody
from mosca.data.rotations import rotation_from_quaternion
from mosca.data.truth import Truth
from scenarios.score.tracks import SEEN_CAMERAS, SEEN_SHARE, block_of, ratio_of_sums
from scenarios.types import Score
from twin.scenes.scene import Scene


def rigid_bodies(scene: Scene) -> tuple[RigidBody, ...]:
    """Return the scene's bodies with three markers or more, at their poses of the session's start.

    A body's frame has its origin in the middle of its markers and, at the start, the world's axes.
    """
    places = scene.sampler().at(0.0).marker_xyz
    row_of = {name: row for row, name in enumerate(scene.marker_names)}
    found = []
    for name, markers in scene.bodies.items():
        if len(markers) >= FEWEST_MARKERS:
            own = places[[row_of[marker] for marker in markers]]
            found.append(RigidBody(name, tuple(markers), own - own.mean(axis=0)))
    return tuple(found)


def body_scores(poses: BodyPoses, bodies: tuple[RigidBody, ...], truth: Truth) -> dict[str, Score]:
    """Return errors of position (rms 3D distance) and attitude (rms angle), and the share of poses found.

    A body counts as seen where three of its markers count as seen. The true pose is the motion that maps the body's
    definition onto its true markers.
    """
    frames = len(truth.time_ns)
    block = block_of(frames)
    blocks = int(block.max(initial=0)) + 1
    away2, turn2, count, seen = (np.zeros(blocks) for _ in range(4))
    marker_seen = (truth.visible >= SEEN_SHARE).sum(axis=2) >= SEEN_CAMERAS
    for body in bodies:
        columns = [truth.names.index(marker) for marker in body.markers]
        wanted = marker_seen[:, columns].sum(axis=1) >= FEWEST_MARKERS
        seen += np.bincount(block, weights=wanted, minlength=blocks)
        measured = poses.of(body.name)
        at = np.asarray(measured.frame)
        for row in np.flatnonzero((at >= 0) & (at < frames)):
            if not wanted[at[row]]:
                continue
            true = rigid(body.positions, truth.xyz[at[row], columns])
            turn = rotation_from_quaternion(measured.quaternion[row]) @ true.rotation.T
            b = block[at[row]]
            away2[b] += float(((measured.position[row] - true.translation) ** 2).sum())
            turn2[b] += _angle(turn) ** 2
            count[b] += 1
    n = int(count.sum())
    scores = {"body_completeness": ratio_of_sums(count, seen, int(seen.sum()))}
    if n:
        scores["body_position_rms"] = ratio_of_sums(away2, count, n, np.sqrt)
        scores["body_angle_rms"] = ratio_of_sums(turn2, count, n, np.sqrt)
    return scores


def _angle(rotation: Array) -> float:
    """Return the angle of a rotation [rad]; exact for small angles too."""
    axis = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1.0))
