"""A body with axes defined by its targets, as the Mosca paper's robot (section 4.3): a centre, an x and a y axis."""

from dataclasses import dataclass, replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.rotations import quaternion_from_rotation, rotation_from_quaternion
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.rigid_bodies.learn import learn_body


@dataclass(frozen=True)
class DeckAxes:
    """Names of targets: the ``centre``; back and front target of the ``x`` axis; right and left target of ``y``."""

    centre: str
    x: tuple[str, str]
    y: tuple[str, str]

    @property
    def names(self) -> tuple[str, ...]:
        """All names."""
        return (self.centre, *self.x, *self.y)


PAPER = DeckAxes("T8", ("T6", "T10"), ("T13", "T3"))
"""Axes of the paper's robot: #8; #6 and #10; #3 and #13."""


def read_axes(text: str) -> DeckAxes:
    """Return the axes given as ``CENTRE,BACK-FRONT,RIGHT-LEFT``; InputError for any other text."""
    parts = [part.strip() for part in text.split(",")]
    pairs = [tuple(part.split("-")) for part in parts[1:]]
    if len(parts) != 3 or not parts[0] or not all(len(pair) == 2 and all(pair) for pair in pairs):
        raise InputError(f"--axes {text[:60]}: CENTRE,BACK-FRONT,RIGHT-LEFT is wanted, as T8,T6-T10,T13-T3")
    (back, front), (right, left) = pairs
    return DeckAxes(parts[0], (back, front), (right, left))


def in_axes(body: RigidBody, axes: DeckAxes) -> RigidBody:
    """Return ``body`` in the axes defined by its targets: x through its two targets, y across x, z up.

    The origin is at the centre. Raises InputError where a target is missing, or the two axes are within 30 degrees of
    each other.
    """
    origin, rotation = _frame(body, axes)
    return replace(body, positions=(body.positions - origin) @ rotation.T)


def learned_deck(tracks: Tracks, axes: DeckAxes) -> RigidBody:
    """Return the body "deck" learned from the labelled targets of ``tracks``, in the axes of ``axes``.

    Raises InputError where a target is missing or the targets are not a rigid body.
    """
    labels = np.unique(tracks.label[tracks.label != ""]).tolist()
    missing = [name for name in axes.names if name not in labels]
    if missing:
        there = ", ".join(labels[:20]) or "no labels"
        raise InputError(
            f"no target '{missing[0]}' for the axes: the tracks have {there}; name others with --axes, or give the "
            "targets' places with --body"
        )
    named = tracks.select(np.isin(tracks.label, labels))
    number = np.searchsorted(np.array(labels), named.label)
    return in_axes(learn_body(replace(named, track=number), range(len(labels)), "deck", labels), axes)


def poses_in_axes(poses: BodyPoses, body: RigidBody, axes: DeckAxes) -> BodyPoses:
    """Return the measured ``poses`` of ``body`` as those of the same body in the axes of ``in_axes``."""
    origin, rotation = _frame(body, axes)
    mine = poses.of(body.name)
    world = np.array([rotation_from_quaternion(q) for q in mine.quaternion]).reshape(len(mine), 3, 3)
    arm = world @ origin
    # by a rotation r about the world's axes the origin moves by r x arm
    change = np.tile(np.eye(6), (len(mine), 1, 1))
    change[:, :3, 3:] = np.cross(arm[:, None, :], np.eye(3)[None])
    covariance = change @ mine.covariance @ change.transpose(0, 2, 1)
    quaternion = np.array([quaternion_from_rotation(one @ rotation.T) for one in world]).reshape(len(mine), 4)
    return replace(mine, quaternion=quaternion, position=mine.position + arm, covariance=covariance)


def _frame(body: RigidBody, axes: DeckAxes) -> tuple[Array, Array]:
    """Return origin (3,) [m] and rotation (3, 3) deck_from_body of ``axes`` in the body's own frame."""
    missing = [name for name in axes.names if name not in body.markers]
    if missing:
        raise InputError(
            f"--axes: body '{body.name}' has no target '{missing[0]}'; it has {', '.join(body.markers[:20])}"
        )
    place = {name: body.positions[body.markers.index(name)] for name in axes.names}
    x, y = (place[two] - place[one] for one, two in (axes.x, axes.y))
    lengths = np.linalg.norm(x), np.linalg.norm(y)
    if min(lengths) == 0 or np.linalg.norm(np.cross(x, y)) < 0.5 * lengths[0] * lengths[1]:
        raise InputError(
            f"--axes: {'-'.join(axes.x)} and {'-'.join(axes.y)} of body '{body.name}' point the same way within 30 "
            "degrees; name targets of axes across each other"
        )
    x = x / lengths[0]
    z = np.cross(x, y)
    z = z / np.linalg.norm(z)
    return place[axes.centre], np.array([x, np.cross(z, x), z])
