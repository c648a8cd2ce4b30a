"""Joints of a subject over time: their centres and rotations, with covariances."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only

JOINTS = (
    "pelvis",
    "lumbar",
    "neck",
    *(f"{side}_{joint}" for side in "lr" for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")),
)
"""Joints of a person, by the names that truth, models and files use. ``pelvis`` is the joint to the world."""


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Centres and rotations of j joints at n instants.

    Axes of the segments as the ISB recommends (Wu et al. 2002, 2005): x forward, y up, z to the right while the
    subject stands in the anatomical position.
    """

    frame: Array
    """(n,) pulse number."""
    time_ns: Array
    """(n,) mid-exposure."""
    joints: tuple[str, ...]
    """(j) names."""
    centre: Array
    """(n, j, 3) in the world [m]; NaN where unknown. The centre of ``pelvis`` is midway between the hips."""
    centre_covariance: Array
    """(n, j, 3, 3) [m^2]."""
    rotation: Array
    """(n, j, 4) unit quaternion wxyz of proximal_from_distal (``pelvis``: world_from_pelvis); NaN where unknown."""
    rotation_covariance: Array
    """(n, j, 3, 3) covariance of the rotation vector r in the distal segment's axes [rad^2], R_true = R exp([r])."""

    def __post_init__(self) -> None:
        n, j = len(np.asarray(self.frame)), len(self.joints)
        object.__setattr__(self, "joints", tuple(self.joints))
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,))
        set_read_only(self, centre=(n, j, 3), rotation=(n, j, 4))
        set_read_only(self, centre_covariance=(n, j, 3, 3), rotation_covariance=(n, j, 3, 3))
        if len(set(self.joints)) < j:
            raise ValueError(f"joint motion: {len(set(self.joints))} names for {j} joints; each has one of its own")

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: Array) -> "JointMotion":
        """Return the instants that a boolean mask or an index array (m,) selects."""
        columns = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return JointMotion(**{name: v if name == "joints" else v[rows] for name, v in columns.items()})
