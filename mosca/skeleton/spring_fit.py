"""Bones pulled by springs: the fit of the "Guide to Optical Motion Capture", for comparison in studies only.

"Spring Model": each marker has a spring that pulls on its bone; opposing springs keep the bone in place, and the
system's damping cancels noise. Bones are rigid and not hinged together; the guide's "loosely coupled" inverse
kinematics is a spring between the two ends of each joint. In each frame the bones move from their last places,
without inertia and with friction in the joints, until forces and torques are in equilibrium. In a motion that its
springs leave free, a bone follows its parent. The skeleton is not fitted: bones are those of the scaled template. The
rest places of the markers on them are means over the first frames, in which the scaled template is posed by hand
(here by ``solve_pose``).
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.joint_motion import JOINTS, JointMotion
from mosca.errors import InputError
from mosca.skeleton.anatomical_axes import CHAINS, segment_axes
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import Kinematics, SkeletonModel
from mosca.skeleton.pose import LARGEST_TURN, solve_pose
from mosca.skeleton.start import COARSE_M, size_of, starting_pose

FIRST_FRAMES = 50
"""Frames in which the animator places the markers: about a second."""
JOINT_STIFFNESS = 1.0
"""Stiffness of a joint's spring, relative to a marker's."""
FRICTION_M2 = 1e-6
"""Friction in the joints, relative to a marker's stiffness: that of a lever of one millimetre. It sets how fast bones
settle, and determines only what no spring determines."""
SETTLED = 1e-6
"""Largest step of a bone that counts as in equilibrium [m, rad]."""
ITERATIONS = 100


class SpringBones:
    """Rigid bones on springs. ``rotation`` (b, 3, 3) world_from_bone and ``origin`` (b, 3) [m] move in ``settle``.

    ``bone_of_marker`` (m,) carries each marker at ``rest`` (m, 3); joint k joins ``offset[k]`` (j, 3) of bone
    ``parent[k]`` with the origin of bone ``child[k]``.
    """

    def __init__(
        self, bone_of_marker: Array, rest: Array, parent: Array, child: Array, offset: Array, joint_stiffness: float
    ) -> None:
        self.bone_of_marker, self.rest = np.asarray(bone_of_marker), np.array(rest, dtype=np.float64)
        self.parent, self.child, self.offset = np.asarray(parent, int), np.asarray(child, int), np.asarray(offset)
        self.joint_stiffness = joint_stiffness
        b = 1 + int(max(self.bone_of_marker.max(), *self.child, 0))
        self.rotation, self.origin = np.tile(np.eye(3), (b, 1, 1)), np.zeros((b, 3))
        relative = np.zeros((len(self.child), b))
        relative[np.arange(len(self.child)), self.child] = 1.0
        relative[np.arange(len(self.child)), self.parent] -= 1.0
        turning = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        self._friction = FRICTION_M2 * np.kron(relative.T @ relative, turning) + 1e-12 * np.eye(6 * b)

    def joint_ends(self) -> tuple[Array, Array]:
        """Return the ends (j, 3) of the joints on their parents and on their children in the world [m]."""
        on_parent = self.origin[self.parent] + np.einsum("jik,jk->ji", self.rotation[self.parent], self.offset)
        return on_parent, self.origin[self.child]

    def settle(self, xyz: Array) -> bool:
        """Move the bones into equilibrium with markers ``xyz`` (m, 3), NaN where not measured; return whether done.

        Implicit steps of the motion without inertia: (stiffness + friction) step = forces and torques.
        """
        seen = np.isfinite(xyz[:, 0])
        j, b = len(self.child), len(self.origin)
        bones = np.concatenate([self.bone_of_marker[seen], self.parent, self.child])
        local = np.concatenate([self.rest[seen], self.offset, np.zeros((j, 3))])
        m = int(seen.sum())
        rows = np.arange(m + 2 * j)
        stiffness = np.repeat([1.0, self.joint_stiffness], [3 * m, 3 * j])
        for _ in range(ITERATIONS):
            lever = np.einsum("nik,nk->ni", self.rotation[bones], local)
            place = self.origin[bones] + lever
            slopes = np.zeros((len(rows), 3, b, 6))
            slopes[rows, :, bones, :3] = np.eye(3)
            slopes[rows, :, bones, 3:] = -np.cross(lever[:, None, :], np.eye(3)).transpose(0, 2, 1)
            pull = np.concatenate([xyz[seen] - place[:m], place[m : m + j] - place[m + j :]]).ravel()
            stretched = np.concatenate([slopes[:m], slopes[m + j :] - slopes[m : m + j]]).reshape(-1, 6 * b)
            shaped = stiffness[:, None] * stretched
            step = cho_solve(cho_factor(stretched.T @ shaped + self._friction), shaped.T @ pull).reshape(b, 6)
            step *= min(1.0, LARGEST_TURN / max(float(np.abs(step[:, 3:]).max()), 1e-12))
            self.origin += step[:, :3]
            self.rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ self.rotation
            if np.abs(step).max() < SETTLED:
                return True
        return False


def spring_fit(
    model: SkeletonModel, frames: MarkerFrames, source: str = "tracks", joint_stiffness: float = JOINT_STIFFNESS
) -> JointMotion:
    """Return the joints of ``model``, scaled to the person in ``frames``, whose labels are the model's.

    A joint's centre is midway between its two ends; covariances are NaN: the method has none. InputError, naming
    ``source``, where no frame shows a marker or the size is no person's.
    """
    size = size_of(model, frames, source)
    kinematics = Kinematics(
        replace(model, parameters=model.parameters * size, information=model.information / size**2)
    )
    counts = frames.seen.sum(axis=1)
    shown = np.flatnonzero(counts >= max(1, counts.max() // 2))[:FIRST_FRAMES]
    if not len(shown):
        raise InputError(f"{source}: no frame shows a marker of the model; label the tracks")
    mj = kinematics.mj
    rest = _rest_places(kinematics, frames.select(shown))
    child = np.arange(1, mj.nbody - 1)
    offset = np.array(mj.body_pos[2:])
    bones = SpringBones(kinematics.body_of_marker - 1, rest, mj.body_parentid[2:] - 1, child, offset, joint_stiffness)
    kinematics.pose(starting_pose(kinematics, frames.xyz[shown[0]]).q)
    bones.rotation, bones.origin = kinematics.rotations()[1:], kinematics.joint_centres()
    return _settled(bones, kinematics, frames)


def _rest_places(kinematics: Kinematics, frames: MarkerFrames) -> Array:
    """Return the markers' mean places (m, 3) on the bones of the template, posed in each of ``frames`` [m].

    A marker that is never seen there stays where the template has it.
    """
    q = starting_pose(kinematics, frames.xyz[0]).q
    places = np.full(frames.xyz.shape, np.nan)
    bone = kinematics.body_of_marker
    for k, xyz in enumerate(frames.xyz):
        information = np.where(frames.seen[k], COARSE_M[-1] ** -2.0, 0.0)[:, None, None] * np.eye(3)
        q = solve_pose(kinematics, q, xyz, information).q
        kinematics.pose(q)
        away = xyz - kinematics.joint_centres()[bone - 1]
        places[k] = np.einsum("mki,mk->mi", kinematics.rotations()[bone], away)
    seen = frames.seen.sum(axis=0)[:, None]
    own = kinematics.parameters[3 * len(kinematics.model.joints) :].reshape(-1, 3)
    return np.where(seen > 0, np.nansum(places, axis=0) / np.maximum(seen, 1), own)


def _settled(bones: SpringBones, kinematics: Kinematics, frames: MarkerFrames) -> JointMotion:
    """Return the joints of the bones in all frames."""
    names = [kinematics.mj.body(k).name for k in range(1, kinematics.mj.nbody)]
    mj_joints = kinematics.model.joints
    axes = {name: _axes(name, bones, kinematics) for name in names}
    joints = tuple(joint for joint in JOINTS if CHAINS[joint].distal in names)
    n, j = len(frames), len(joints)
    centre, rotation = np.full((n, j, 3), np.nan), np.full((n, j, 4), np.nan)
    for k in range(n):
        if not frames.seen[k].any():
            continue
        bones.settle(frames.xyz[k])
        middle = np.mean(bones.joint_ends(), axis=0)
        world_from = {name: bones.rotation[i] @ axes[name] for i, name in enumerate(names)}
        for i, joint in enumerate(joints):
            chain = CHAINS[joint]
            near = world_from[chain.proximal] if chain.proximal else np.eye(3)
            rotation[k, i] = Rotation.from_matrix(near.T @ world_from[chain.distal]).as_quat()[[3, 0, 1, 2]]
            hips = ["l_hip", "r_hip"] if joint == "pelvis" else [chain.centre]
            if set(hips) <= set(mj_joints):
                centre[k, i] = np.mean([middle[mj_joints.index(hip)] for hip in hips], axis=0)
    nothing = np.full((n, j, 3, 3), np.nan)
    return JointMotion(frames.frame, frames.time_ns, joints, centre, nothing, rotation, nothing)


def _axes(body: str, bones: SpringBones, kinematics: Kinematics) -> Array:
    """Return body_from_anatomical (3, 3) with the template's flexion axes; without landmarks, the template's axes."""
    model = kinematics.model
    places = dict(zip(model.labels, bones.rest, strict=True)) | dict(zip(model.joints, bones.offset, strict=True))
    hinge = np.array([0.0, 0.0, 1.0])
    try:
        return segment_axes(
            body, places.__getitem__, dict.fromkeys(("l_knee", "r_knee", "l_elbow", "r_elbow"), hinge)
        )
    except KeyError:
        return np.eye(3)
