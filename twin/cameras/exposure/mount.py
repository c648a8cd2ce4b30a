"""The mount: how the camera body moves.

A rotation of the camera is given in pixels: the shift of the image of distant objects, right and down. The pose is a
function of continuous time, so that motion within an exposure blurs; the white shake alone is constant in a frame.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Pose
from mosca.errors import InputError
from mosca.numba_support.decorators import kernel
from twin.cameras.optics.lens import project
from twin.streams import rng

TONES = 64
"""Sinusoids that make up a vibration, each image axis."""
WANDER_STEP_S = 1.0
"""Time between the steps of the random walk, which is linear in between."""


@dataclass(frozen=True)
class Mount:
    """How the camera body moves."""

    body_px: float = 0.03
    """Rms shake from frame to frame, each image axis."""
    vibration_px: float = 0.0
    """Rms vibration, each image axis."""
    vibration_hz: tuple[float, float] = (5.0, 60.0)
    """Band of the vibration: lowest and highest frequency."""
    vibration_slope: float = 0.0
    """Power density of the vibration is in proportion to ``frequency ** vibration_slope``."""
    drift_px_per_s: tuple[float, float] = (0.0, 0.0)
    """Steady drift (x, y)."""
    wander_px: float = 0.0
    """Random walk: rms each axis in the first second."""
    wander_bound_px: float = 1.0
    """Bound of the random walk, which is reflected at plus and minus this value."""
    bump_s: float | None = None
    """When the camera is bumped (None: never)."""
    bump_px: tuple[float, float] = (0.0, 0.0)
    """Lasting motion of the image by the bump (x, y)."""
    bump_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Lasting motion of the camera by the bump along its own axes."""
    bump_rise_s: float = 0.01
    """Duration of the bump."""
    body: str | None = None
    """The scene's body that carries the camera (None: fixed in the world); the rig's ``world_from_camera`` is
    then read as ``body_from_camera``."""

    def __post_init__(self) -> None:
        low, high = self.vibration_hz
        if not 0.0 < low < high:
            raise InputError(
                f"mount: vibration_hz = {low:g}, {high:g} given; two rising frequencies above 0 are wanted"
            )
        for name in ("wander_bound_px", "bump_rise_s"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"mount: {name} = {getattr(self, name):g} given; a number above 0 is wanted")

    def fastest_hz(self, from_s: float, to_s: float) -> float:
        """Return the highest frequency of the camera's motion in an interval [1/s]; 0 where it moves slowly."""
        vibration = self.vibration_hz[1] if self.vibration_px > 0.0 else 0.0
        if self.bump_s is None or to_s < self.bump_s or from_s > self.bump_s + self.bump_rise_s:
            return vibration
        return max(vibration, 1.0 / self.bump_rise_s)


@dataclass(frozen=True, eq=False)
class CameraSupport:
    """A mounted camera during a session: its pose at any instant, a pure function of (seed, name, frame, time)."""

    mount: Mount
    name: str
    pose: Pose
    """``world_from_camera``, or ``body_from_camera`` of a camera on a moving body."""
    px_per_radian: float
    seed: int
    tones: Array = field(repr=False)
    """(2, n, 3) frequency [1/s], amplitude [px] and phase of the vibration's sinusoids along the image's x and y."""
    walk: Array = field(repr=False)
    """(2, k) positions of the random walk, WANDER_STEP_S apart [px]."""

    @classmethod
    def of(
        cls, mount: Mount, name: str, pose: Pose, px_per_radian: float, seed: int, duration_s: float
    ) -> "CameraSupport":
        """Return the camera's mount for a session of ``duration_s`` (a longer one begins identically)."""
        return cls(
            mount, name, pose, px_per_radian, seed, _tones(mount, name, seed), _walk(mount, name, seed, duration_s)
        )

    @cached_property
    def steady(self) -> bool:
        """Whether the camera is at rest within a frame and on no moving body."""
        m = self.mount
        still = m.vibration_px == 0.0 and m.wander_px == 0.0 and m.drift_px_per_s == (0.0, 0.0)
        return still and m.bump_s is None and m.body is None

    def image_shift_px(self, times_s: Array) -> Array:
        """Return the image shift of distant objects (k, 2) [px], without the shake of each frame."""
        t = np.asarray(times_s, dtype=float)
        m = self.mount
        shift = t[:, None] * np.array(m.drift_px_per_s)
        for axis in range(2):
            if m.vibration_px > 0.0:
                frequency, amplitude, phase = self.tones[axis].T
                shift[:, axis] += np.sin(2.0 * np.pi * t[:, None] * frequency + phase) @ amplitude
            if m.wander_px > 0.0:
                knots = WANDER_STEP_S * np.arange(self.walk.shape[1])
                shift[:, axis] += np.interp(t, knots, self.walk[axis])
        result: Array = shift + self._bumped(t)[:, None] * np.array(m.bump_px)
        return result

    def pose_at(self, times_s: Array, frame: int, carrier: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
        """Return ``world_from_camera`` at instants (k,) of a frame: rotations (k, 3, 3) and positions (k, 3) [m].

        ``carrier``: ``world_from_body`` of the body that carries it, rotations (k, 3, 3) and positions (k, 3) [m].
        """
        k = len(times_s)
        angles, moved = np.zeros((k, 2)), np.zeros((k, 3))
        if self.mount.body_px != 0.0:
            angles += rng(self.seed, f"camera/{self.name}/body", frame).normal(0.0, self.mount.body_px, 2)
        if not self.steady:
            shift = self.image_shift_px(times_s)
            # a rotation about y to the left moves the image right, a rotation about x upwards moves it down
            angles[:, 0] += shift[:, 1]
            angles[:, 1] -= shift[:, 0]
            moved += self._bumped(np.asarray(times_s))[:, None] * np.array(self.mount.bump_m)
        angles /= self.px_per_radian
        rotation, position = _placed(self.pose.rotation, self.pose.translation, angles, moved)
        if carrier is None:
            return rotation, position
        riding, from_body = carrier
        return riding @ rotation, (riding @ position[:, :, None])[:, :, 0] + from_body

    def _bumped(self, times_s: Array) -> Array:
        """Return the share of the bump's motion that is completed (k,), 0 to 1."""
        if self.mount.bump_s is None:
            return np.zeros(len(times_s))
        share = np.clip((times_s - self.mount.bump_s) / self.mount.bump_rise_s, 0.0, 1.0)
        return np.asarray(0.5 - 0.5 * np.cos(np.pi * share))


@kernel
def pixels_per_radian(lens: Array) -> float:
    """Return how far the image moves for a small rotation of the camera, at the middle of the view [px/rad]."""
    _u, _v, ux, _uy, _uz, _vx, vy, _vz, _ok = project(lens, 0.0, 0.0, 1.0)
    return math.sqrt(ux * ux + vy * vy) / math.sqrt(2.0)


def _tones(mount: Mount, name: str, seed: int) -> Array:
    """Return sinusoids (2, n, 3) of the stated spectrum: one at a random frequency in each of n slices of the band.

    Their phases are random. The sum of many such sinusoids is a Gaussian process (Shinozuka & Deodatis, Applied
    Mechanics Reviews 44 (1991) 191), and its rms over a long time is exactly the stated one.
    """
    low, high = mount.vibration_hz
    random = rng(seed, f"camera/{name}/vibration")
    offset, phase = random.random((2, TONES)), random.uniform(0.0, 2.0 * math.pi, (2, TONES))
    frequency = low + (high - low) * (np.arange(TONES) + offset) / TONES
    power = frequency**mount.vibration_slope
    amplitude = mount.vibration_px * np.sqrt(2.0 * power / power.sum(axis=1, keepdims=True))
    return np.stack([frequency, amplitude, phase], axis=-1)


def _walk(mount: Mount, name: str, seed: int, duration_s: float) -> Array:
    """Return a random walk (2, k) that starts at 0 and is reflected at the bounds [px]."""
    if mount.wander_px == 0.0:
        return np.zeros((2, 1))
    steps = math.ceil(duration_s / WANDER_STEP_S) + 2
    free = np.stack(
        [np.cumsum(rng(seed, f"camera/{name}/wander/{axis}").normal(0.0, mount.wander_px, steps)) for axis in "xy"]
    )
    bound = mount.wander_bound_px
    folded = np.abs((free + bound) % (4.0 * bound) - 2.0 * bound) - bound
    return np.concatenate([np.zeros((2, 1)), -folded], axis=1)


@kernel
def _placed(rotation: Array, translation: Array, angles: Array, moved: Array) -> Any:
    """Return the pose * (moved, small rotations about the camera's x and y axes) at each instant."""
    count = angles.shape[0]
    out_rotation, out_xyz = np.empty((count, 3, 3)), np.empty((count, 3))
    shake = np.empty((3, 3))
    for k in range(count):
        x, y = angles[k, 0], angles[k, 1]
        angle = math.sqrt(x * x + y * y)
        # Rodrigues' formula about (x, y, 0)
        s = math.sin(angle) / angle if angle > 1e-12 else 1.0
        c = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 1e-12 else 0.5
        shake[0, 0], shake[0, 1], shake[0, 2] = 1.0 - c * y * y, c * x * y, s * y
        shake[1, 0], shake[1, 1], shake[1, 2] = c * x * y, 1.0 - c * x * x, -s * x
        shake[2, 0], shake[2, 1], shake[2, 2] = -s * y, s * x, 1.0 - c * (x * x + y * y)
        for i in range(3):
            out_xyz[k, i] = translation[i]
            for n in range(3):
                out_xyz[k, i] += rotation[i, n] * moved[k, n]
            for j in range(3):
                out_rotation[k, i, j] = 0.0
                for n in range(3):
                    out_rotation[k, i, j] += rotation[i, n] * shake[n, j]
    return out_rotation, out_xyz
