"""Tracked bodies bound to objects of another scene: each object's pose at the instant at which it is shown."""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.bodies import BodyPoses
from mosca.errors import InputError
from mosca.rigid_bodies.prediction import BodyPredictor, PredictedPose, PredictionSettings

SHOWN_STATUSES = ("interpolated", "extrapolated", "starting", "stale")
CURRENT = ("interpolated", "extrapolated")
"""Statuses of objects whose motion is known up to now."""


class ShownObject(NamedTuple):
    """An object as it is shown at one instant."""

    object: str
    body: str
    time_ns: int
    """Time of the display, on the frames' clock."""
    meant_ns: int
    """The instant whose pose is shown."""
    pose: PredictedPose
    measured: PredictedPose
    """The newest measured pose, without prediction."""


@dataclass(frozen=True, eq=False)
class ShownPoses:
    """Objects as they were shown, one row (n) for each object and display."""

    body: Array
    """(n,) str."""
    time_ns: Array
    """(n,) time of the display."""
    meant_ns: Array
    """(n,) instant whose pose is shown: that of the display less its delay."""
    newest_ns: Array
    """(n,) middle of the newest known exposure."""
    rotation: Array
    """(n, 3, 3) rotation of world_from_body."""
    position: Array
    """(n, 3) [m]"""
    covariance: Array
    """(n, 6, 6) as in ``BodyPoses``."""
    status: Array
    """(n,) one of SHOWN_STATUSES."""
    measured_rotation: Array
    """(n, 3, 3), (n, 3): the newest measured pose, without prediction."""
    measured_position: Array

    def __post_init__(self) -> None:
        n = len(np.asarray(self.time_ns))
        set_read_only(self, np.int64, time_ns=(n,), meant_ns=(n,), newest_ns=(n,))
        set_read_only(self, np.str_, body=(n,), status=(n,))
        set_read_only(self, rotation=(n, 3, 3), position=(n, 3), covariance=(n, 6, 6))
        set_read_only(self, measured_rotation=(n, 3, 3), measured_position=(n, 3))

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def age_s(self) -> Array:
        """(n,) time from the middle of the newest exposure to the display [s]."""
        result: Array = (self.time_ns - self.newest_ns) * 1e-9
        return result

    @classmethod
    def of(cls, rows: Sequence[ShownObject]) -> "ShownPoses":
        """Return rows as columns."""
        n = len(rows)
        poses, measured = [one.pose for one in rows], [one.measured for one in rows]
        return cls(
            np.array([one.body for one in rows], dtype=np.str_),
            np.array([one.time_ns for one in rows], dtype=np.int64),
            np.array([one.meant_ns for one in rows], dtype=np.int64),
            np.array([one.newest_ns for one in poses], dtype=np.int64),
            np.array([one.rotation for one in poses]).reshape(n, 3, 3),
            np.array([one.position for one in poses]).reshape(n, 3),
            np.array([one.covariance for one in poses]).reshape(n, 6, 6),
            np.array([one.status for one in poses], dtype=np.str_),
            np.array([one.rotation for one in measured]).reshape(n, 3, 3),
            np.array([one.position for one in measured]).reshape(n, 3),
        )


@dataclass(eq=False)
class BoundObjects:
    """Objects that follow bodies, ``bound`` object -> body. One thread gives poses, another takes them.

    An object whose body has not been found yet is absent; one whose pose is no longer known is held as stale.
    """

    bound: Mapping[str, str]
    settings: PredictionSettings = field(default_factory=PredictionSettings)

    def __post_init__(self) -> None:
        self._predictors = {body: BodyPredictor(self.settings) for body in self.bound.values()}
        self._last: dict[str, PredictedPose] = {}
        self._lock = threading.Lock()

    def update(self, poses: BodyPoses) -> None:
        """Take the poses of one instant, or of several in order of time."""
        with self._lock:
            for body, predictor in self._predictors.items():
                predictor.update(poses.select(poses.body == body))

    def at(self, time_ns: int, delay_ns: int = 0) -> list[ShownObject]:
        """Return the objects to show at ``time_ns`` on the frames' clock, with their poses ``delay_ns`` before it."""
        meant_ns = time_ns - delay_ns
        with self._lock:
            found = {body: (one.at(meant_ns), one.newest()) for body, one in self._predictors.items()}
        shown = []
        for name, body in self.bound.items():
            pose, measured = found[body]
            if pose is None and name in self._last:
                pose = self._last[name]._replace(status="stale")
            if pose is not None and measured is not None:
                self._last[name] = pose
                shown.append(ShownObject(name, body, time_ns, meant_ns, pose, measured))
        return shown


def bindings(texts: Sequence[str], bodies: Sequence[str], where: str, key: str = "--bind") -> dict[str, str]:
    """Return object -> body of ``BODY=OBJECT`` texts; InputError for an unknown body or an object given twice.

    ``bodies``: names of those defined in ``where``; ``key``: beginning of an error's message. One body may move
    several objects.
    """
    bound: dict[str, str] = {}
    for text in texts:
        body, equals, name = (part.strip() for part in text.partition("="))
        if not (body and equals and name):
            raise InputError(f"{key} {text}: BODY=OBJECT is wanted, as drone=cup")
        if body not in bodies:
            raise InputError(f"{key} {text}: {where} has no body '{body}'; there are {', '.join(bodies) or 'none'}")
        if name in bound:
            raise InputError(
                f"{key} {text}: object '{name}' follows body '{bound[name]}' already; leave one of them out"
            )
        bound[name] = body
    return bound
