"""A scene: a compiled MuJoCo model, its markers, and its configuration at any instant.

The motion of the subject (a recorded motion, a flown path, contact physics) is hidden behind one function,
``configuration_at``: time -> qpos, which is also defined between physics steps. The geoms outside the marker group
hide the markers.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import mujoco
import numpy as np

from mosca.data.arrays import Array, read_only
from twin.scenes.emission import Glow
from twin.scenes.figure import Figure
from twin.scenes.joint_frames import JointFrames
from twin.scenes.plate import PlateModes

MARKER_GROUP = 4
"""Geom group of markers. Spheres are ball markers; cylinders are flat round targets facing their +z; thin boxes
are plates with a figure on their +z face."""
UNSEEN_GROUP = 5
"""Geom group of helpers that neither show nor hide anything (collision shapes, cages)."""


FINEST = 2.0**40
"""Steps per metre (or radian) to which a configuration is rounded, 1e-12: the last digits of a sine differ between
versions of a mathematics library, and frames must not.
"""


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands given to the subject on the session clock."""

    names: tuple[str, ...]
    """Names of the k values."""
    time_ns: Array
    """(n,)."""
    values: Array
    """(n, k)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_ns", read_only(self.time_ns, (None,), "time_ns", np.int64))
        n = len(self.time_ns)
        object.__setattr__(self, "values", read_only(self.values, (n, len(self.names)), "values"))


@dataclass(frozen=True, eq=False)
class Scene:
    """A subject with markers in a world."""

    model: mujoco.MjModel
    """Compiled MjModel; markers are geoms in MARKER_GROUP."""
    marker_names: tuple[str, ...]
    marker_geoms: tuple[int, ...]
    """Their geoms, in the order of the names."""
    configuration_at: Callable[[float], Array]
    """qpos (nq,) at session time t [s], for -0.1 <= t <= duration_s + 0.1: a pure function (same t, same bytes, any
    thread)."""
    duration_s: float
    bodies: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Rigid body -> names of the markers that it carries."""
    commands: Commands | None = None
    """Commands that drove the subject; None where there were none."""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    """Marker -> figure on its +z face. A marker without a figure shines as a whole; a box must have one."""
    glows: Mapping[str, Glow] = field(default_factory=dict)
    """Marker -> its light (default: ``Glow()``)."""
    joints: JointFrames | None = None
    """A person's joints; None for other subjects."""
    modes: PlateModes | None = None
    """A panel's modes at its markers; None for other subjects."""

    def __post_init__(self) -> None:
        for name in ("bodies", "figures", "glows"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        for what, named in (("figure", self.figures), ("glow", self.glows)):
            unknown = sorted(set(named) - set(self.marker_names))
            if unknown:
                raise ValueError(f"{what} of '{unknown[0]}': the scene has no such marker")
        for name, geom in zip(self.marker_names, self.marker_geoms, strict=True):
            kind = int(self.model.geom_type[geom])
            if kind == mujoco.mjtGeom.mjGEOM_BOX and name not in self.figures:
                raise ValueError(f"marker '{name}' is a plate without a figure")
            if kind == mujoco.mjtGeom.mjGEOM_SPHERE and name in self.figures:
                raise ValueError(f"marker '{name}' is a ball; only flat markers have figures")

    def sampler(self) -> "SceneSampler":
        """Return a sampler with its own MjData: one for each thread."""
        return SceneSampler(self)


@dataclass(frozen=True, eq=False)
class SceneState:
    """Markers and geoms at one instant, world frame [m]."""

    marker_xyz: Array
    """(m, 3) centres."""
    marker_axis: Array
    """(m, 3) unit +z of each marker's geom (a flat target's normal)."""
    geom_xyz: Array
    """(g, 3)"""
    geom_rotation: Array
    """(g, 3, 3)"""


class SceneSampler:
    """Evaluates a scene's geometry at an instant by forward kinematics. Not to be shared by threads."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.data = mujoco.MjData(scene.model)
        self._geoms = np.asarray(scene.marker_geoms, dtype=np.int64)

    def at(self, time_s: float) -> SceneState:
        """Return the geometry at session time ``time_s`` [s]."""
        self.data.qpos[:] = np.rint(self.scene.configuration_at(time_s) * FINEST) / FINEST
        mujoco.mj_kinematics(self.scene.model, self.data)
        xyz = self.data.geom_xpos.copy()
        rotation = self.data.geom_xmat.reshape(-1, 3, 3).copy()
        return SceneState(xyz[self._geoms], rotation[self._geoms, :, 2], xyz, rotation)
