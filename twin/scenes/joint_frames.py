"""Anatomical frames that are fixed to a model's bodies, and joint truth from the bodies' poses.

``mosca.data.truth.JointTruth`` defines the frames.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array, set_read_only
from mosca.data.truth import JointTruth

NO_CENTRE = -1
"""Stands for the id of the body whose origin is a joint's centre, where there is no such body."""


@dataclass(frozen=True, eq=False)
class Segment:
    """A bone's anatomical axes: ``body`` id, ``axes`` (3, 3) body_from_segment, NaN where they are unknown."""

    body: int
    axes: Array


@dataclass(frozen=True, eq=False)
class JointFrames:
    """Joints (j) of a person in a model: the bodies that they join, and their axes there."""

    names: tuple[str, ...]
    proximal: Array
    """(j,): ids of the proximal bodies; 0: the world."""
    proximal_axes: Array
    """(j, 3, 3): body_from_segment; NaN where they are unknown."""
    distal: Array
    """(j,): ids of the distal bodies."""
    distal_axes: Array
    """(j, 3, 3): body_from_segment; NaN where they are unknown."""
    centre: Array
    """(j, 2): ids of two bodies; the centre is midway between their origins; NO_CENTRE where there is none."""

    def __post_init__(self) -> None:
        j = len(self.names)
        set_read_only(self, np.int64, proximal=(j,), distal=(j,), centre=(j, 2))
        set_read_only(self, proximal_axes=(j, 3, 3), distal_axes=(j, 3, 3))

    @classmethod
    def of(
        cls, joined: Mapping[str, tuple[Segment, Segment]], centres: Mapping[str, tuple[int, int]]
    ) -> "JointFrames":
        """Return joints by name from their (proximal, distal) segments and the bodies about their centres."""
        pairs = list(joined.values())
        return cls(
            tuple(joined),
            np.array([near.body for near, _ in pairs]),
            np.array([near.axes for near, _ in pairs]),
            np.array([far.body for _, far in pairs]),
            np.array([far.axes for _, far in pairs]),
            np.array([centres.get(name, (NO_CENTRE, NO_CENTRE)) for name in joined]),
        )

    def truth(self, body_xyz: Array, body_rotation: Array) -> JointTruth:
        """Return centres and rotations for bodies at ``body_xyz`` (t, b, 3) [m], turned by (t, b, 3, 3) to world."""
        near = body_rotation[:, self.proximal] @ self.proximal_axes
        far = body_rotation[:, self.distal] @ self.distal_axes
        centre = body_xyz[:, self.centre].mean(axis=2)
        centre[:, self.centre[:, 0] == NO_CENTRE] = np.nan
        return JointTruth(self.names, centre, _quaternions(np.swapaxes(near, -1, -2) @ far))


def _quaternions(rotation: Array) -> Array:
    """Return unit quaternions (t, j, 4) wxyz, w >= 0, of rotations (t, j, 3, 3); NaN for NaN."""
    known = np.isfinite(rotation).all(axis=(2, 3))
    wxyz = np.full((*known.shape, 4), np.nan)
    if known.any():
        wxyz[known] = Rotation.from_matrix(rotation[known]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return wxyz
