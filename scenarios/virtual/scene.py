"""A second MuJoCo scene whose mocap bodies are moved from outside, with physics around them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.rotations import quaternion_from_rotation, rotation_from_vector
from mosca.errors import InputError
from mosca.rigid_bodies.pose import vector_of
from twin.scenes.scene import UNSEEN_GROUP
from twin.scenes.user_model import DIVERGED, load_model

MOST_CATCH_UP_S = 0.25
"""Longest time of physics that one display computes; further time is left out, so that a pause causes no delay."""
_PLANE_M = 4.0
"""Half the drawn edge of a plane that is infinite in the scene."""

Placement = tuple[Array, Array]
"""Rotation (3, 3) and position (3,) [m] of world_from_body."""


class VirtualScene:
    """The scene of an MJCF file; ``moved``: its mocap bodies that are moved. Its world frame is that of the rig.

    Raises InputError for a file that MuJoCo cannot load, and for an object that is not one of its mocap bodies.
    """

    def __init__(self, path: Path, moved: tuple[str, ...]) -> None:
        _, self._model = load_model(path)
        names = [self._model.body(k).name or f"body {k}" for k in range(self._model.nbody)]
        free = [name for k, name in enumerate(names) if self._model.body_mocapid[k] >= 0]
        there = f"its mocap bodies are {', '.join(free)}" if free else 'give one of its bodies mocap="true"'
        for one in moved:
            if one not in names:
                raise InputError(f"{path}: no body '{one}' to move; {there}")
            if one not in free:
                raise InputError(f"{path}: body '{one}' is no mocap body and cannot be moved; {there}")
        self.names = tuple(names)
        self.left_out_s = 0.0
        self._path = path
        self._mocap = {one: int(self._model.body_mocapid[names.index(one)]) for one in moved}
        self._data = mujoco.MjData(self._model)
        self._last: dict[str, Placement] = {}
        self._now_s: float | None = None
        mujoco.mj_forward(self._model, self._data)

    def show(self, time_s: float, placed: Mapping[str, Placement]) -> None:
        """Move the mocap bodies in ``placed`` to their poses until ``time_s`` [s], and run the physics up to it.

        A body moves evenly from its last pose to the new one, so that it pushes others and does not appear inside
        them; its first pose is set at once. InputError where the scene's physics diverges.
        """
        start_s = time_s if self._now_s is None else self._now_s
        step_s = float(self._model.opt.timestep)
        for name, placement in placed.items():
            self._last.setdefault(name, placement)
        late = max(0.0, time_s - start_s - MOST_CATCH_UP_S)
        self.left_out_s += late
        steps = int((time_s - start_s - late) / step_s + 1e-6)
        for k in range(1, steps + 1):
            self._place({name: _along(self._last[name], end, k / steps) for name, end in placed.items()})
            mujoco.mj_step(self._model, self._data)
        self._now_s = max(start_s, start_s + late + steps * step_s)
        if any(self._data.warning[one].number for one in DIVERGED):
            raise InputError(f"{self._path}: the scene's physics diverges; give it a shorter option timestep")
        self.place(placed)

    def place(self, placed: Mapping[str, Placement]) -> None:
        """Set the mocap bodies in ``placed`` to their poses at once; other bodies react at the next ``show``."""
        self._place(placed)
        self._last.update(placed)
        mujoco.mj_kinematics(self._model, self._data)

    def placements(self) -> dict[str, Placement]:
        """Return the placement of each body."""
        rotations = self._data.xmat.reshape(-1, 3, 3)
        return {name: (rotations[k].copy(), self._data.xpos[k].copy()) for k, name in enumerate(self.names)}

    def meshes(self) -> Iterator[tuple[str, Array, Array, Array]]:
        """Yield body, vertices (v, 3) in its frame [m], triangles (f, 3) and colour (4,) 0 to 1 of visible geoms."""
        model = self._model
        for g in range(model.ngeom):
            made = None if model.geom_group[g] >= UNSEEN_GROUP else _mesh(model, g)
            if made is not None:
                rotation = np.zeros(9)
                mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
                vertices = made.vertices @ rotation.reshape(3, 3).T + model.geom_pos[g]
                material = int(model.geom_matid[g])
                colour = model.geom_rgba[g] if material < 0 else model.mat_rgba[material]
                yield self.names[model.geom_bodyid[g]], vertices, np.asarray(made.faces), np.array(colour)

    def _place(self, placed: Mapping[str, Placement]) -> None:
        for name, (rotation, position) in placed.items():
            self._data.mocap_pos[self._mocap[name]] = position
            self._data.mocap_quat[self._mocap[name]] = quaternion_from_rotation(rotation)


def _along(start: Placement, end: Placement, share: float) -> Placement:
    """Return the placement at a share of the way from one to another."""
    turn = rotation_from_vector(share * vector_of(end[0] @ start[0].T))
    return turn @ start[0], start[1] + share * (end[1] - start[1])


def _mesh(model: mujoco.MjModel, g: int) -> Any:
    """Return the trimesh of a geom in its own frame; None for a geom that is not drawn."""
    import trimesh  # takes a third of a second to import

    kind, size = mujoco.mjtGeom, np.array(model.geom_size[g])
    shape = int(model.geom_type[g])
    if shape == kind.mjGEOM_PLANE:
        half = np.where(size[:2] > 0, size[:2], _PLANE_M)
        return trimesh.creation.box(extents=[*(2 * half), 1e-3])
    if shape == kind.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if shape == kind.mjGEOM_SPHERE or shape == kind.mjGEOM_ELLIPSOID:
        ball = trimesh.creation.icosphere(subdivisions=2)
        ball.apply_scale(size if shape == kind.mjGEOM_ELLIPSOID else np.full(3, size[0]))
        return ball
    if shape == kind.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
    if shape == kind.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[16, 16])
    if shape == kind.mjGEOM_MESH:
        mesh = model.geom_dataid[g]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        begin, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        return trimesh.Trimesh(
            model.mesh_vert[first : first + count], model.mesh_face[begin : begin + faces], process=False
        )
    return None
