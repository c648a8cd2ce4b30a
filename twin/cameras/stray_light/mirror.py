"""Mirrors: images of targets in a reflecting plane rectangle.

The image of a target in a plane mirror is a virtual target behind the mirror, seen through the rectangle as through a
window. Equivalently, it is the target seen by the camera's mirror image. Position, size and orientation of the image
are exact. Its visible share is estimated at mid-exposure from 19 lines of sight spread over its disc: a line counts
if it passes the rectangle and is occluded neither before the mirror nor between mirror and target. That share scales
the light of the whole image. Only one reflection is modelled: no mirror in a mirror.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from twin.cameras.exposure.lighting import RETRO
from twin.cameras.render.outline import BALL
from twin.cameras.render.render import TargetsInCamera
from twin.cameras.stray_light.world import TargetsInWorld, in_camera, some
from twin.scenes.figure import LINE, Figure
from twin.scenes.scene import UNSEEN_GROUP

THICKNESS_M = 0.01
"""Solids this near to a mirror's plane count as the mirror's own and hide nothing."""
_RINGS = ((1, 0.0), (6, math.sqrt(4 / 19)), (12, math.sqrt(13 / 19)))
_DISC = np.array(
    [
        (radius * math.cos(2 * math.pi * k / n), radius * math.sin(2 * math.pi * k / n))
        for n, radius in _RINGS
        for k in range(n)
    ]
)


@dataclass(frozen=True)
class PlaneMirror:
    """A reflecting rectangle.

    It occludes nothing itself: a mirror with objects behind it needs a geom of its own in the scene.
    """

    center_m: tuple[float, float, float]
    """(3,)"""
    normal: tuple[float, float, float]
    """(3,) points to the reflecting side."""
    x_axis: tuple[float, float, float]
    """(3,) direction of the first side, perpendicular to the normal."""
    size_m: tuple[float, float]
    """Lengths of the sides."""
    reflectance: float = 0.9
    """Share of light that is reflected."""

    def __post_init__(self) -> None:
        lengths = np.linalg.norm(self.normal), np.linalg.norm(self.x_axis)
        if not min(lengths) > 0 or abs(np.dot(self.normal, self.x_axis)) > 1e-6 * lengths[0] * lengths[1]:
            raise InputError(
                f"mirror: normal = {self.normal}, x_axis = {self.x_axis} given; directions at right angles are wanted"
            )
        if not min(self.size_m) > 0 or not 0 < self.reflectance <= 1:
            raise InputError(
                f"mirror: size_m = {self.size_m}, reflectance = {self.reflectance} given; sides above zero and a "
                "share above 0 up to 1 are wanted"
            )

    @property
    def axes(self) -> Array:
        """Unit x axis, y axis and normal (3, 3), one a row."""
        z = np.array(self.normal) / np.linalg.norm(self.normal)
        x = np.array(self.x_axis) / np.linalg.norm(self.x_axis)
        return np.stack([x, np.cross(z, x), z])

    @property
    def flip(self) -> Array:
        """The reflection of directions (3, 3): ``I - 2 n n^T``."""
        n = self.axes[2]
        return np.asarray(np.eye(3) - 2.0 * np.outer(n, n))

    def image(self, points: Array) -> Array:
        """Return the mirror images of points (..., 3) [m]."""
        center = np.array(self.center_m)
        return np.asarray((points - center) @ self.flip + center)


class SceneRays:
    """MuJoCo's exact ray caster, with ``data`` at mid-exposure."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.model, self.data = model, data
        self.groups = np.ones(6, dtype=np.uint8)
        self.groups[UNSEEN_GROUP] = 0

    def cast(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Return the distances (n,) [m] at which rays from ``origin`` (3,) along unit ``directions`` (n, 3) meet a
        geom (inf: none), and the geoms (n,) that they meet, or -1.
        """
        n = len(directions)
        met, far = np.full(n, -1, dtype=np.int32), np.zeros(n)
        rays = np.ascontiguousarray(directions, dtype=float).reshape(-1)
        if n:
            mujoco.mj_multiRay(
                self.model, self.data, np.ascontiguousarray(origin, dtype=float), rays, self.groups, 1, -1, met, far,
                None, n, mujoco.mjMAXVAL,
            )  # fmt: skip
        return np.where(met >= 0, far, np.inf), met


def mirrored(
    mirror: PlaneMirror,
    targets: TargetsInWorld,
    signal_e: float,
    position: Array,
    rotation: Array,
    rays: SceneRays,
    figures: int = 0,
) -> TargetsInCamera:
    """Return the mirror images that a camera sees, in its frame; images that are wholly hidden are left out.

    ``position`` (K, 3), ``rotation`` (K, 3, 3) camera -> world at the window's nodes. Light that the camera itself
    has sent (to retroreflective targets) is reflected twice. A figure's image has the number of the figure plus
    ``figures``, the number of figures: see ``with_mirrored``. The renderer must draw images without occluders: their
    occlusion is computed here, and geoms behind the mirror do not occlude them.
    """
    middle = len(position) // 2
    share = seen_share(mirror, targets, position[middle], rays)
    chosen = np.flatnonzero(share > 0.0)
    seen = some(targets, chosen)
    # the camera's mirror image would receive this light; the camera sees the flipped targets
    eye, eye_rotation = mirror.image(position), mirror.flip @ rotation
    passes = np.where(seen.glows.kind == RETRO, 2, 1)
    through_image = in_camera(seen, signal_e, eye, eye_rotation, share[chosen] * mirror.reflectance**passes)
    # a reflection of axes becomes a rotation when the second axis (and the figure) is inverted
    turned = through_image.rotation * np.array([1.0, -1.0, 1.0])
    figure = np.where(seen.figure >= 0, seen.figure + figures, -1)
    return replace(through_image, rotation=np.ascontiguousarray(turned), figure=figure)


def seen_share(mirror: PlaneMirror, targets: TargetsInWorld, eye: Array, rays: SceneRays) -> Array:
    """Return the share (m,) of each target's disc that is seen from ``eye`` (3,) by way of the mirror."""
    x_axis, y_axis, normal = mirror.axes
    center = np.array(mirror.center_m)
    share = np.zeros(len(targets))
    eye_height = float((eye - center) @ normal)
    if eye_height <= 0.0:
        return share
    image_eye = mirror.image(eye)
    middle = targets.path.shape[1] // 2
    before = np.flatnonzero((targets.path[:, middle] - center) @ normal > targets.radius)
    points = _discs(targets, before, image_eye)
    lines = points - image_eye
    crossing = image_eye + lines * (eye_height / (lines @ normal))[..., None]
    inside = (np.abs((crossing - center) @ x_axis) <= mirror.size_m[0] / 2) & (
        np.abs((crossing - center) @ y_axis) <= mirror.size_m[1] / 2
    )
    at, ends, owner = crossing[inside], points[inside], before[np.nonzero(inside)[0]]
    to_mirror = np.linalg.norm(at - eye, axis=1)
    slack = THICKNESS_M * to_mirror / eye_height
    far, _met = rays.cast(eye, (at - eye) / to_mirror[:, None])
    free = far > to_mirror - slack
    # from the mirror to the target, as seen by the camera's image: geoms behind the mirror do not occlude
    to_end = np.linalg.norm(ends - image_eye, axis=1)
    way = (ends - image_eye) / to_end[:, None]
    far, met = rays.cast(image_eye, way)
    for k in np.flatnonzero(free & (far < to_mirror + slack)):
        start = to_mirror[k] + slack[k]
        beyond, geom = rays.cast(image_eye + start * way[k], way[k : k + 1])
        far[k], met[k] = start + beyond[0], geom[0]
    own = (met >= 0) & (met == targets.geom[owner])
    free &= own | (far > to_end - targets.radius[owner] - 1e-6)
    return np.bincount(owner[free], minlength=len(targets)) / len(_DISC)


def with_mirrored(figures: Sequence[Figure]) -> tuple[Figure, ...]:
    """Return ``figures`` followed by their mirror images (y inverted), for targets seen in mirrors."""
    return (*figures, *(_mirrored_figure(f) for f in figures))


def _mirrored_figure(figure: Figure) -> Figure:
    """Return a figure's mirror image; its contours run backwards, so that the inside stays on their left."""
    old = figure.pieces[::-1]
    new = old.copy()
    line = old[:, 0] == LINE
    new[line, 1], new[line, 3] = old[line, 3], old[line, 1]
    new[line, 2], new[line, 4] = -old[line, 4], -old[line, 2]
    new[~line, 2] = -old[~line, 2]
    new[~line, 4], new[~line, 5] = -old[~line, 5], -old[~line, 4]
    return replace(figure, pieces=new)


def _discs(targets: TargetsInWorld, chosen: Array, eye: Array) -> Array:
    """Return points (n, 19, 3) spread evenly over the discs that ``eye`` sees of the ``chosen`` targets."""
    middle = targets.path.shape[1] // 2
    centers, rotation = targets.path[chosen, middle], targets.rotation[chosen, middle]
    # a ball's disc is perpendicular to the line of sight; a flat target is its own disc
    towards = eye - centers
    aside = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards), axis=1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    over = np.cross(towards / np.linalg.norm(towards, axis=1, keepdims=True), aside)
    ball = (targets.shape[chosen] == BALL)[:, None]
    x, y = np.where(ball, aside, rotation[:, :, 0]), np.where(ball, over, rotation[:, :, 1])
    spread = _DISC[:, :1] * x[:, None] + _DISC[:, 1:] * y[:, None]
    return np.asarray(centers[:, None] + targets.radius[chosen, None, None] * spread)
