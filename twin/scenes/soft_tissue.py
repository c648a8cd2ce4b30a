"""Soft tissue: sliding of an actor's markers on the bones beneath the skin.

Two effects move a marker. *Posture*: the joints at both ends of a segment pull the skin along, by a smooth function
of their rotations. *Wobble*: the tissue is a mass on a damped spring, which rings after a footfall. Half of the
variance by posture is common to the markers of a segment, so that an average over a cluster does not remove it; half
is each marker's own. Four fifths of the variance lie along the skin. Coefficients are drawn anew for each person.

Sizes are from reviews of pins in bones and of fluoroscopy: Leardini et al. 2005 (Gait Posture 21, 212), Peters et
al. 2010 (Gait Posture 31, 1), Benoit et al. 2006 (Gait Posture 24, 152); docs/people.md states how they were derived.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from mosca.data.arrays import Array
from mosca.data.motion.motion import multiply_quaternions, quaternions_from_euler
from twin.scenes.actor_markers import Seat
from twin.scenes.anatomy import Anatomy

Skin = Literal["off", "moderate", "strong"]
SKINS: tuple[Skin, ...] = ("off", "moderate", "strong")
LEVELS: Mapping[str, float] = MappingProxyType({"moderate": 0.4, "strong": 1.0})
STRONG_M: Mapping[str, float] = MappingProxyType(
    {
        "thigh": 0.015, "shank": 0.010, "pelvis": 0.008, "upper_arm": 0.008, "abdomen": 0.008, "forearm": 0.004,
        "wrist": 0.004, "chest": 0.004, "foot": 0.0025, "hand": 0.0025, "head": 0.0008,
    }
)  # fmt: skip
"""Rms displacement over persons at "strong", when the joints at the segment's ends have turned by 1 rad [m]."""
_MOVED_BY: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "pelvis": ("abdomen", "l_thigh", "r_thigh"), "abdomen": ("abdomen", "chest"),
        "chest": ("chest", "neck", "l_upper_arm", "r_upper_arm"), "head": ("neck", "head"),
        "thigh": ("thigh", "shank"), "shank": ("shank", "foot"), "foot": ("foot", "toes"),
        "upper_arm": ("upper_arm", "forearm"), "forearm": ("forearm", "wrist", "hand"),
        "wrist": ("forearm", "wrist", "hand"), "hand": ("hand",),
    }
)  # fmt: skip
"""Part -> parts whose first joints pull its skin; parts that a skeleton lacks are left out."""
SLIDES = "skin/"
"""Prefix of the names of the markers' bodies and slide joints; the marker's name follows."""
_LINEAR_SHARE, _COMMON_SHARE, _NORMAL_SHARE = 0.7, 0.5, 0.2  # of the variance
_NORMAL = np.sqrt(2 * _NORMAL_SHARE / (1 - _NORMAL_SHARE))  # of an isotropic vector's normal part, against tangents
_KEPT = np.sqrt(3 / (2 + _NORMAL**2))
_NATURAL_HZ, _DAMPING = (10.0, 15.0), 0.3
_OWN_GAIN = (0.5, 1.5)
_GRID_HZ = 200.0
_BEFORE_S, _AFTER_S = 0.7, 0.15  # beyond the scene; what rang at the start has faded to exp(-11) before -0.1 s
_TERMS = 9  # of a joint: three linear, six quadratic


@dataclass(frozen=True, eq=False)
class SoftTissue:
    """A configuration whose markers slide: that of the bones, plus the positions of the slides."""

    bones: Callable[[float], Array]
    slides: Array
    """(m, 3) addresses in qpos."""
    joints: Array
    """(j,) addresses of the quaternions of the joints that pull the skin."""
    from_reference: Array
    """(j, 4) conjugates of these quaternions when standing with hanging arms, signed so that w > 0 at the start."""
    posture: Array
    """(3 m, 9 j) displacement for each term of the joints' rotations [m]."""
    wobble: Array
    """(3 m, 3 p) displacement for that of the tissue of p parts: as for the thigh, in proportion to STRONG_M."""
    tissue: CubicSpline
    """Displacement (3 p,) of the parts' tissue over the session's time, in the bones' axes [m]."""

    def __call__(self, time_s: float) -> Array:
        """Return qpos (nq,) at session time ``time_s`` [s]."""
        qpos = self.bones(time_s)
        turned = multiply_quaternions(self.from_reference, qpos[self.joints[:, None] + np.arange(4)])
        held = min(max(time_s, self.tissue.x[0]), self.tissue.x[-1])
        moved = self.posture @ terms(turned).reshape(-1) + self.wobble @ self.tissue(held)
        qpos[self.slides] = moved.reshape(-1, 3)
        return qpos


def terms(wxyz: Array) -> Array:
    """Return the terms (j, 9) by which rotations (j, 4) pull the skin: unit vectors at 1 rad, bounded.

    The linear terms are g = sqrt(2) u / sqrt(1 + u^2) with u = 2 sin(angle / 2) along the axis: skin yields less and
    less. The others are products of two components of g; products of different components are times sqrt(2).
    """
    u = 2 * wxyz[:, 1:]
    g = np.sqrt(2 / (1 + np.sum(u * u, axis=1, keepdims=True))) * u
    crossed = np.sqrt(2) * g * g.take((1, 2, 0), axis=1)
    return np.concatenate([g, g * g, crossed], axis=1)


def add_slides(body: mujoco.MjsBody, marker: str) -> mujoco.MjsBody:
    """Return a body on ``body``, in its axes, that slides along each of them."""
    holder: mujoco.MjsBody = body.add_body(name=SLIDES + marker)
    for axis, along in zip("xyz", np.eye(3), strict=True):
        holder.add_joint(name=f"{SLIDES}{marker}/{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=along)
    return holder


def soft_tissue(
    bones: Callable[[float], Array],
    model: mujoco.MjModel,
    anatomy: Anatomy,
    seated: list[Seat],
    skin: Skin,
    duration_s: float,
    rng: np.random.Generator,
) -> SoftTissue:
    """Return the configuration of an actor with slides (``add_slides``) whose bones move by ``bones``.

    ``skin``: "moderate" or "strong"; ``rng`` draws the person's coefficients.
    """
    drawn = drawn_skin(anatomy, seated, skin, rng)
    addresses = np.array([int(model.joint(f"joint/{anatomy.parts[part]}").qposadr[0]) for part in drawn.joints])
    reference = np.array([_conjugate_reference(part) for part in drawn.joints])
    at_start = multiply_quaternions(reference, bones(0.0)[addresses[:, None] + np.arange(4)])
    reference[at_start[:, 0] < 0] *= -1
    slides = [[int(model.joint(f"{SLIDES}{seat.name}/{axis}").qposadr[0]) for axis in "xyz"] for seat in seated]
    tissue = _ringing(bones, model, anatomy, seated, drawn.parts, duration_s, rng)
    return SoftTissue(bones, np.array(slides), addresses, reference, drawn.posture, drawn.wobble, tissue)


@dataclass(frozen=True, eq=False)
class DrawnSkin:
    """A person's skin: ``posture`` and ``wobble`` as in SoftTissue, for p ``parts`` and for ``joints`` (j).

    Each joint is named by the part that starts at it.
    """

    parts: list[str]
    joints: list[str]
    posture: Array
    wobble: Array


def drawn_skin(anatomy: Anatomy, seated: list[Seat], skin: Skin, rng: np.random.Generator) -> DrawnSkin:
    """Return the skin of a person drawn by ``rng``."""
    parts = sorted({seat.part for seat in seated})
    joints = sorted({joint for part in parts for joint in _moved_by(part, anatomy)})
    common = {part: _coefficients(part, joints, anatomy, rng) for part in parts}
    posture = np.zeros((len(seated), 3, _TERMS * len(joints)))
    wobble = np.zeros((len(seated), 3, 3 * len(parts)))
    for k, seat in enumerate(seated):
        size = LEVELS[skin] * STRONG_M[_kind(seat.part)]
        own = _coefficients(seat.part, joints, anatomy, rng)
        mixed = np.sqrt(_COMMON_SHARE) * common[seat.part] + np.sqrt(1 - _COMMON_SHARE) * own
        along = along_skin(seat.normal)
        posture[k] = anatomy.scale * size * along @ mixed
        first = 3 * parts.index(seat.part)
        wobble[k, :, first : first + 3] = size / STRONG_M["thigh"] * rng.uniform(*_OWN_GAIN) * along
    rows = 3 * len(seated)
    return DrawnSkin(parts, joints, posture.reshape(rows, -1), wobble.reshape(rows, -1))


def along_skin(normal: Array) -> Array:
    """Return the map (3, 3) that keeps an isotropic vector's variance and leaves a fifth of it along ``normal``."""
    return np.asarray(_KEPT * (np.eye(3) - (1 - _NORMAL) * np.outer(normal, normal)))


def _coefficients(part: str, drawing: list[str], anatomy: Anatomy, rng: np.random.Generator) -> Array:
    """Return drawn coefficients (3, 9 j) for unit variance of the displacement at 1 rad in all joints of a part."""
    drawn = np.zeros((3, len(drawing), _TERMS))
    at = [drawing.index(joint) for joint in _moved_by(part, anatomy)]
    share = np.repeat([_LINEAR_SHARE, 1 - _LINEAR_SHARE], [3, 6]) / (3 * len(at))
    drawn[:, at] = np.sqrt(share) * rng.normal(size=(3, len(at), _TERMS))
    return drawn.reshape(3, -1)


def _ringing(
    bones: Callable[[float], Array],
    model: mujoco.MjModel,
    anatomy: Anatomy,
    seated: list[Seat],
    parts: list[str],
    duration_s: float,
    rng: np.random.Generator,
) -> CubicSpline:
    """Return the displacement (3 p,) of tissue on a damped spring, x'' + 2 z w x' + w^2 x = -a, over time.

    ``a``: acceleration of the middle of a part's markers in the bone's axes, taken as linear between the grid's
    instants, for which the response is exact. The tissue stiffens: a displacement x becomes x / sqrt(1 + x^2 / s^2),
    s the thigh's size by posture.
    """
    time_s = np.arange(-_BEFORE_S, duration_s + _AFTER_S, 1 / _GRID_HZ)
    ids = [int(model.body(_body(anatomy, part)).id) for part in parts]
    middle = np.array([_middle(anatomy, seated, part) for part in parts])
    rotation, xyz = np.empty((len(time_s), len(parts), 3, 3)), np.empty((len(time_s), len(parts), 3))
    data = mujoco.MjData(model)
    for k, time in enumerate(time_s):
        data.qpos[:] = bones(float(time))
        mujoco.mj_kinematics(model, data)
        rotation[k], xyz[k] = data.xmat[ids].reshape(-1, 3, 3), data.xpos[ids]
    xyz += np.einsum("tpab,pb->tpa", rotation, middle)
    pushed = np.einsum("tpba,tpb->tpa", rotation, CubicSpline(time_s, xyz)(time_s, 2))
    moved = np.empty_like(pushed)
    for k, natural_hz in enumerate(rng.uniform(*_NATURAL_HZ, len(parts))):
        moved[:, k] = response(pushed[:, k], float(natural_hz))
    moved /= np.sqrt(1 + np.sum(moved * moved, axis=2, keepdims=True) / STRONG_M["thigh"] ** 2)
    return CubicSpline(time_s, moved.reshape(len(time_s), -1))


def response(acceleration: Array, natural_hz: float, damping: float = _DAMPING, rate_hz: float = _GRID_HZ) -> Array:
    """Return the displacement (n, k) of masses on damped springs whose mounts accelerate (n, k), from rest."""
    from scipy.signal import cont2discrete, lfilter  # takes a second to import

    w = 2 * np.pi * natural_hz
    forward, back, _ = cont2discrete(([-1.0], [1.0, 2 * damping * w, w * w]), 1 / rate_hz, method="foh")
    return np.asarray(lfilter(forward.ravel(), back, acceleration, axis=0))


def _kind(part: str) -> str:
    return part.removeprefix("l_").removeprefix("r_")


def _moved_by(part: str, anatomy: Anatomy) -> list[str]:
    """Return the parts whose first joints pull the skin of ``part``."""
    kind = _kind(part)
    side = part.removesuffix(kind)
    near = [joint if joint in anatomy.parts else side + joint for joint in _MOVED_BY[kind]]
    return [joint for joint in near if joint in anatomy.parts]


def _conjugate_reference(part: str) -> Array:
    """Return the conjugate (4,) of the rotation of a part's first joint when the person stands with hanging arms."""
    turn = {"l_upper_arm": -np.pi / 2, "r_upper_arm": np.pi / 2}.get(part, 0.0)
    return quaternions_from_euler(np.array([turn]), "Y")


def _body(anatomy: Anatomy, part: str) -> str:
    return anatomy.skeleton.names[anatomy.parts[part]]


def _middle(anatomy: Anatomy, seated: list[Seat], part: str) -> Array:
    """Return the middle (3,) of a part's markers on the skin, from its first joint [m]."""
    return np.asarray(np.mean([s.surface for s in seated if s.part == part], axis=0) - anatomy.points[part])
