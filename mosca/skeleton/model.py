"""A skeleton with markers as a MuJoCo model: bodies joined by ball joints, markers as sites.

The *parameters* (p) are estimated once for a subject: the place of each body's joint in its parent and the place of
each marker in its body. The *pose* (nq), MuJoCo's configuration, is estimated for each instant.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.files.bounded import read_text
from mosca.errors import InputError
from mosca.skeleton.kernels import Placed, Tree, fill_slopes, place, rotation_vectors
from mosca.skeleton.mjcf import MIDPOINT, MOST_BYTES, SIGMA, compiled
from mosca.skeleton.pose_kernels import RotationPrior

HUMAN = Path(__file__).with_name("human.xml")
PLACEMENT_M = 0.05
"""Standard deviation of a marker's place on its body where the model states none (site user) [m]."""
PROPORTION, JOINT_M = 0.06, 0.01
"""Standard deviation of a joint's place: along the line from its parent's joint, PROPORTION of the distance and
JOINT_M [m] in addition; across that line JOINT_M. Segment lengths at equal stature vary by 4 to 6 % (Winter; Pheasant
1986)."""
COINCIDENT_M = 1e-4
"""Standard deviation of a joint that the model places in its parent's joint [m]: it stays there."""
MIDPOINT_M, OFF_MIDPOINT_M = 0.0022, 0.02
"""Standard deviations of a joint against the midpoint of the two markers that the model names for it (tuple
midpoint/JOINT) [m]: along the line between them, 2.2 mm from person to person (knees of 40 bodies by CT: Lynnerup et
al. 2014, Biom. Biostat. Int. J. 1, 47); across it, where palpation is off by 5 to 8 mm (Della Croce et al. 1999) and
marker sets place them above or below the joint."""
LEFT_RIGHT_M = 0.004
"""Standard deviation of half the difference between the left and the right side of a body's joint places [m]."""


@dataclass(frozen=True, eq=False)
class SkeletonModel:
    """A model's structure, starting values of its parameters and their prior.

    ``mjcf``: text of the model. ``labels`` (m): its markers in use. ``joints`` (b): names of the joints of bodies
    that have a parent. ``parameters`` (p): places of these joints in the parent body (b, 3), then of the markers in
    their body (m, 3) [m]; ``information`` (p, p): their prior information matrix [1/m^2]. ``rotation_sigma`` (nv):
    prior standard deviation of the joints' rotation vectors [rad], inf where nothing is known.
    """

    mjcf: str
    labels: tuple[str, ...]
    joints: tuple[str, ...]
    parameters: Array
    information: Array
    rotation_sigma: Array

    def __post_init__(self) -> None:
        p = 3 * (len(self.joints) + len(self.labels))
        set_read_only(self, parameters=(p,), information=(p, p), rotation_sigma=(None,))

    def joint_rows(self, joint: str) -> slice:
        """Return the parameters that place ``joint``."""
        return slice(3 * (k := self.joints.index(joint)), 3 * k + 3)

    def marker_rows(self, label: str) -> slice:
        """Return the parameters that place the marker ``label``."""
        first = 3 * (len(self.joints) + self.labels.index(label))
        return slice(first, first + 3)


def read_skeleton_model(path: Path, labels: Sequence[str]) -> SkeletonModel:
    """Return the model in the MJCF file ``path`` with those of its sites that are in ``labels``.

    InputError where the file is no such model, or fewer than six of its markers are among the labels.
    """
    text = read_text(Path(path), "a skeleton model (MJCF)", most_bytes=MOST_BYTES)
    mj = compiled(text, str(path))
    return model_from_mjcf(text, mj, labels, str(path))


def model_from_mjcf(text: str, mj: mujoco.MjModel, labels: Sequence[str], source: str) -> SkeletonModel:
    """Return the model of ``mj``, which ``mjcf.compiled`` returned for ``text``; see ``read_skeleton_model``."""
    known = [mj.site(k).name for k in range(mj.nsite)]
    used = tuple(label for label in known if label in set(labels))
    if len(used) < 6:
        raise InputError(
            f"{source}: {len(used)} of the tracks' labels are markers of the model, six or more are wanted; it has "
            f"{', '.join(known[:8])}, ...; rename the tracks or give a model with your names"
        )
    joints = tuple(mj.joint(k).name for k in range(1, mj.njnt))
    sites = [mj.site(label).id for label in used]
    parameters = np.concatenate([mj.body_pos[2:].ravel(), mj.site_pos[sites].ravel()])
    sigma = np.full(mj.nv, np.inf)
    for k in range(mj.nnumeric):
        name = mj.numeric(k).name
        if name.startswith(SIGMA) and (joint := name.removeprefix(SIGMA)) in joints:
            first = int(mj.joint(joint).dofadr[0])
            sigma[first : first + 3] = np.deg2rad(mj.numeric(k).data[:3])
    return SkeletonModel(text, used, joints, parameters, _information(mj, joints, used), sigma)


def _information(mj: mujoco.MjModel, joints: tuple[str, ...], labels: tuple[str, ...]) -> Array:
    """Return the information (p, p) of the starting values: proportions, placement, symmetry, marker midpoints."""
    sites = [mj.site(label).id for label in labels]
    placed = mj.site_user[sites] if mj.nuser_site == 3 else np.zeros((len(sites), 3))
    placed = np.where(placed > 0, placed, PLACEMENT_M)
    information = np.diag(np.concatenate([np.zeros(3 * len(joints)), placed.ravel() ** -2.0]))
    for k, offset in enumerate(mj.body_pos[2:]):
        length = float(np.linalg.norm(offset))
        own = slice(3 * k, 3 * k + 3)
        if length == 0:
            information[own, own] = np.eye(3) / COINCIDENT_M**2
            continue
        along = np.outer(offset, offset) / length**2
        information[own, own] = (np.eye(3) - along) / JOINT_M**2 + along / (JOINT_M**2 + (PROPORTION * length) ** 2)

    def tie(weight: Array, *parts: tuple[int, Array]) -> None:
        row = np.zeros((3, len(information)))
        for first, matrix in parts:
            row[:, first : first + 3] += matrix
        np.add(information, row.T @ weight @ row, out=information)

    one, mirrored = np.eye(3), -np.diag([1.0, 1.0, -1.0])
    for k, name in enumerate(joints):
        if name.startswith("l_") and (other := f"r_{name[2:]}") in joints:
            tie(one / (2 * LEFT_RIGHT_M) ** 2, (3 * k, one), (3 * joints.index(other), mirrored))
    for k in range(mj.ntuple):
        name = mj.tuple(k).name
        first = int(mj.tuple_adr[k])
        pair = [mj.site(int(i)).name for i in mj.tuple_objid[first : first + int(mj.tuple_size[k])]]
        if (
            name.startswith(MIDPOINT)
            and set(pair) <= set(labels)
            and (joint := name.removeprefix(MIDPOINT)) in joints
        ):
            ends = [(3 * (len(joints) + labels.index(label)), -one / len(pair)) for label in pair]
            line = mj.site(pair[0]).pos - mj.site(pair[1]).pos
            along = np.outer(line, line) / (line @ line)
            weight = along / MIDPOINT_M**2 + (one - along) / OFF_MIDPOINT_M**2
            tie(weight, (3 * joints.index(joint), one), *ends)
    return np.asarray(information)


class Kinematics:
    """Places of a model's markers and bodies at given parameters and poses, and their derivatives."""

    def __init__(self, model: SkeletonModel, parameters: Array | None = None) -> None:
        self.model = model
        self.mj = mujoco.MjModel.from_xml_string(model.mjcf)
        self._sites = np.array([self.mj.site(label).id for label in model.labels])
        self.body_of_marker = self.mj.site_bodyid[self._sites].astype(np.int64)
        nbody = self.mj.nbody
        self.parent = np.concatenate([[-1], self.mj.body_parentid[1:]]).astype(np.int64)
        above = np.zeros((nbody, nbody), dtype=bool)  # [body, body at or above it]
        for body in range(1, nbody):
            above[body] = above[self.parent[body]]
            above[body, body] = True
        self.above = above
        self.moved_by = above[:, self.mj.dof_bodyid]
        """(nbody, nv) whether a degree of freedom moves a body."""
        self._count = np.maximum(self.moved_by.sum(axis=1), 3)
        self._dofs = np.full((nbody, int(self._count.max())), -1)
        for body in range(nbody):
            dofs = np.flatnonzero(self.moved_by[body]) if body else np.arange(3)
            self._dofs[body, : len(dofs)] = dofs
        self.placed = Placed(
            np.empty((nbody, 3, 3)), np.empty((nbody, 3)), np.empty((len(self._sites), 3)), np.empty((nbody, 3, 3))
        )
        weight = np.zeros((nbody, 3))
        weight[2:] = model.rotation_sigma[6:].reshape(-1, 3) ** -2.0
        self._prior = RotationPrior(weight, np.zeros((nbody, 3)))
        self.set_parameters(model.parameters if parameters is None else parameters)

    def set_parameters(self, parameters: Array) -> None:
        """Place joints and markers by ``parameters`` (p,)."""
        self.parameters = np.array(parameters, dtype=np.float64)
        split = 3 * len(self.model.joints)
        self.mj.body_pos[2:] = self.parameters[:split].reshape(-1, 3)
        self.mj.site_pos[self._sites] = self.local
        self.tree = Tree(
            self.parent, np.array(self.mj.body_pos), np.array(self.mj.body_quat), self.body_of_marker, self.local,
            self._dofs, self._count,
        )  # fmt: skip

    @property
    def local(self) -> Array:
        """(m, 3) places of the markers in their bodies' axes [m]."""
        return self.parameters[3 * len(self.model.joints) :].reshape(-1, 3)

    def prior(self, posture: Array | float, share: float) -> RotationPrior:
        """Return the prior of the joints' rotation vectors about ``posture`` (nv,) with ``share`` of its weight."""
        mean = np.zeros_like(self._prior.mean)
        if np.ndim(posture):
            mean[2:] = np.reshape(posture, -1)[6:].reshape(-1, 3)
        return RotationPrior(share * self._prior.weight, mean)

    def pose(self, q: Array) -> None:
        """Take the pose ``q`` (nq,)."""
        place(self.tree, np.array(q, dtype=np.float64), self.placed)

    def markers(self) -> Array:
        """Return the markers' places (m, 3) in the world [m] in the present pose."""
        return np.array(self.placed.marker)

    def joint_centres(self) -> Array:
        """Return the places (nbody - 1, 3) of all joints in the world [m], the root's first."""
        return np.array(self.placed.origin[1:])

    def rotations(self) -> Array:
        """Return world_from_body (nbody, 3, 3)."""
        return np.array(self.placed.rotation)

    def by_pose(self, points: Array, bodies: Array) -> Array:
        """Return derivatives (n, 3, nv) of ``points`` (n, 3), fixed to ``bodies`` (n,), by the pose's tangent."""
        slopes = np.zeros((len(points), 3, self.mj.nv))
        fill_slopes(self.tree, self.placed, np.array(bodies), np.array(points, dtype=np.float64), slopes)
        return slopes

    def turned_by_pose(self, bodies: Array) -> Array:
        """Return derivatives (n, 3, nv) of the bodies' rotation vectors in world axes by the pose's tangent."""
        axes = np.concatenate([np.zeros((3, 3)), *self.placed.rotation[1:].transpose(0, 2, 1)]).T
        return np.asarray(axes * self.moved_by[bodies][:, None, :])

    def by_parameters(self, bodies: Array) -> Array:
        """Return derivatives (n, 3, 3 b) of points fixed to ``bodies`` (n,) by joints' places in their parents."""
        rotations = self.rotations()
        of_parent = rotations[self.mj.body_parentid[2:]]  # (b, 3, 3)
        mask = self.above[np.asarray(bodies)][:, 2:]  # (n, b)
        n, b = mask.shape
        columns = mask[:, :, None, None] * of_parent
        return np.asarray(columns.transpose(0, 2, 1, 3).reshape(n, 3, 3 * b))

    def moved(self, q: Array, step: Array) -> Array:
        """Return the pose ``q`` (nq,) moved by the tangent vector ``step`` (nv,)."""
        new = np.array(q, dtype=np.float64)
        mujoco.mj_integratePos(self.mj, new, np.ascontiguousarray(step), 1.0)
        return new

    def rotation_vectors(self, q: Array) -> tuple[Array, Array]:
        """Return the ball joints' rotation vectors (b, 3) [rad] and their derivatives (b, 3, 3) by their tangent."""
        vectors, slopes = np.empty((self.mj.njnt - 1, 3)), np.empty((self.mj.njnt - 1, 3, 3))
        rotation_vectors(np.array(q, dtype=np.float64), vectors, slopes)
        return vectors, slopes
