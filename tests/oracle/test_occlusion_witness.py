"""What hides a marker: the twin's visible share and image against MuJoCo's ray caster on a fine grid."""

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from witness_render import Array, image_centroid, opencv_lens, seen_by_rays

from mosca.data.rig import OpenCVLens
from twin.cameras.kernel import gaussian_kernel
from twin.cameras.lens import TwinLens
from twin.cameras.occlusion import occluders_of
from twin.cameras.render import BALL, FLAT, MarkersInCamera, MeshRays, Seen, has_meshes, render_markers
from twin.scenes.scene import MARKER_GROUP, UNSEEN_GROUP, Scene

W, H = 160, 120
ELECTRONS = 12_000.0
KERNEL = gaussian_kernel(0.6)
LENS = OpenCVLens(300.0, 302.0, 79.0, 60.0, -0.2, 0.06, 5e-4, -4e-4)
WITNESS = opencv_lens(
    np.array([[300.0, 0, 79.0], [0, 302.0, 60.0], [0, 0, 1]]), np.array([-0.2, 0.06, 5e-4, -4e-4, 0.0])
)
# world_from_camera: looks along the world's +y, a little down and askew
ROTATION = (
    np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) @ Rotation.from_rotvec([-0.2, 0.1, 0.15]).as_matrix()
)
POSITION = np.array([0.1, -2.0, 0.3])
KINDS = {
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, (0.045, 0.0, 0.0)),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, (0.03, 0.07, 0.0)),
    "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, (0.03, 0.05, 0.08)),
    "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, (0.035, 0.05, 0.0)),
    "box": (mujoco.mjtGeom.mjGEOM_BOX, (0.03, 0.05, 0.07)),
}
MARKER_AT = np.array([0.06, -0.04, 1.5])


class Setting:
    """A world built in camera coordinates: one marker and what may stand before it."""

    def __init__(self, normal: Array | None = None, radius: float = 0.02, at: Array = MARKER_AT) -> None:
        self.spec = mujoco.MjSpec()
        self.flat = normal is not None
        kind, size = mujoco.mjtGeom.mjGEOM_SPHERE, [radius, 0, 0]
        turn = np.eye(3)
        if normal is not None:
            kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, 2e-5, 0]
            turn = Rotation.align_vectors([normal], [[0, 0, 1.0]])[0].as_matrix()
        self.add(kind, size, at, turn, MARKER_GROUP, "marker")

    def add(self, kind, size, at, turn=None, group=0, name="", **more):
        """Add a geom at ``at`` [m], turned by ``turn`` (3, 3), both in the camera frame."""
        turn = ROTATION @ (np.eye(3) if turn is None else turn)
        quat = Rotation.from_matrix(turn).as_quat(scalar_first=True)
        pos = ROTATION @ np.asarray(at) + POSITION
        self.spec.worldbody.add_geom(
            type=kind, size=size, pos=pos, quat=quat, group=group, name=name, **more
        )
        return self

    def add_kind(self, name, at, turn=None, **more):
        kind, size = KINDS[name]
        return self.add(kind, size, at, turn, **more)

    def add_mesh(self, shape: trimesh.Trimesh, at, turn=None):
        self.spec.add_mesh(name="mesh", uservert=shape.vertices.ravel(), userface=shape.faces.ravel())
        return self.add(mujoco.mjtGeom.mjGEOM_MESH, [0, 0, 0], at, turn, meshname="mesh")

    def look(self):
        """Return the twin's image and what it saw, and what MuJoCo's rays see of the marker."""
        model = self.spec.compile()
        marker = model.geom("marker").id
        scene = Scene(model, ("marker",), (marker,), lambda t: np.zeros(0), 1.0)
        sampler = scene.sampler()
        state = sampler.at(0.0)
        centre = ROTATION.T @ (state.marker_xyz[0] - POSITION)
        markers = MarkersInCamera(
            np.repeat(centre[None, None], 3, axis=1),
            np.ascontiguousarray(state.marker_axis @ ROTATION),
            model.geom_size[[marker], 0].copy(),
            np.array([FLAT if self.flat else BALL], dtype=np.int64),
            np.array([ELECTRONS]),
        )
        occluders = occluders_of(scene)
        mesh_rays = None
        if has_meshes(occluders):
            mesh_rays = MeshRays(model, sampler.data, occluders, scene.marker_geoms, (ROTATION, POSITION))
        light = np.zeros((H, W), dtype=np.float32)
        vector = TwinLens.of(LENS, W, H).vector
        seen = render_markers(
            light, vector, KERNEL, markers, occluders,
            np.ascontiguousarray((state.geom_xyz[occluders.geom] - POSITION) @ ROTATION),
            np.ascontiguousarray(ROTATION.T @ state.geom_rotation[occluders.geom]),
            mesh_rays,
        )  # fmt: skip
        rays = seen_by_rays(model, sampler.data, marker, ROTATION, POSITION, WITNESS)
        return light, seen, rays
