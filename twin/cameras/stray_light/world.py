"""Light sources in the world frame: the scene's targets, other cameras' ring lights, shiny spots."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from twin.cameras.exposure.lighting import ALWAYS, GlowTable, glow_table, target_light
from twin.cameras.render.outline import BALL, FLAT
from twin.cameras.render.render import TargetsInCamera
from twin.scenes.emission import Glow
from twin.scenes.world import rotation_to


@dataclass(frozen=True)
class RingLight:
    """The ring light of each camera as others see it: a bright disc about the lens. It shines while its camera's
    strobe does.
    """

    radius_m: float = 0.04
    """Radius of the disc."""
    strength: float = 20.0
    """Brightness, seen head on, over that of a marker."""
    half_deg: float = 30.0
    """Angle off the disc's axis at which it is half as bright."""

    def __post_init__(self) -> None:
        _positive("ring light", radius_m=self.radius_m, strength=self.strength)
        _angle("ring light", self.half_deg)


@dataclass(frozen=True)
class ShinySpot:
    """A fixed bright ball that reflects the ring light: a tripod's chrome, a screw, tape on the floor."""

    position_m: tuple[float, float, float]
    """Its centre."""
    radius_m: float
    """Radius of the ball."""
    strength: float
    """Brightness over that of a marker."""
    facing: tuple[float, float, float] | None = None
    """(3,): direction from which it is brightest; None: the same from all sides."""
    half_deg: float = 20.0
    """Angle off ``facing`` at which it is half as bright."""
    at_m: float | None = None
    """Distance at which it has that brightness, which falls with the distance squared; None: constant."""

    def __post_init__(self) -> None:
        at_m = {} if self.at_m is None else {"at_m": self.at_m}
        _positive("shiny spot", radius_m=self.radius_m, strength=self.strength, **at_m)
        _angle("shiny spot", self.half_deg)
        if self.facing is not None and not 0.0 < np.linalg.norm(self.facing) < np.inf:
            raise InputError(f"shiny spot: facing = {self.facing} given; a direction of three numbers is wanted")


@dataclass(frozen=True, eq=False)
class TargetsInWorld:
    """Targets in the world during one exposure."""

    path: Array
    """(m, K, 3): centres at the window's nodes [m]."""
    rotation: Array
    """(m, K, 3, 3): target's axes -> world."""
    radius: Array
    """(m,) [m]."""
    shape: Array
    """(m,): shape code of the renderer (BALL, FLAT or FIGURE)."""
    figure: Array
    """(m,): number of the figure in the renderer, or -1."""
    geom: Array
    """(m,): id of each target's geom, or -1."""
    glows: GlowTable
    """Glows of all targets."""
    lit_s: Array
    """(m, 2): when each shines."""

    def __len__(self) -> int:
        return len(self.radius)


@dataclass(frozen=True, eq=False)
class RigPoses:
    """Poses of all cameras of a rig during one exposure, at the window's nodes, and their ring lights."""

    position: Array
    """(c, K, 3): centres, world frame [m]."""
    rotation: Array
    """(c, K, 3, 3): camera -> world."""
    lit_s: Array
    """(c, 2): when their ring lights shine."""


def ring_lights(light: RingLight, heads: RigPoses, chosen: Sequence[int]) -> TargetsInWorld:
    """Return the ring lights of the ``chosen`` cameras: flat discs that face along the cameras' axes."""
    at = list(chosen)
    glow = Glow("lamp", strength=light.strength, half_deg=light.half_deg)
    return _targets(
        heads.position[at], heads.rotation[at], [light.radius_m] * len(at), FLAT, [glow] * len(at), heads.lit_s[at]
    )


def shiny_spots(spots: Sequence[ShinySpot], seen_from: Array, nodes: int) -> TargetsInWorld:
    """Return the spots for a camera at ``seen_from`` (3,): spots without a facing face the camera."""
    where = np.array([spot.position_m for spot in spots], dtype=float).reshape(-1, 3)
    facing = [
        seen_from - at if spot.facing is None else np.array(spot.facing)
        for spot, at in zip(spots, where, strict=True)
    ]
    rotation = np.array([rotation_to(along) for along in facing]).reshape(-1, 3, 3)
    glows = [Glow("retro", strength=s.strength, half_deg=s.half_deg, at_m=s.at_m) for s in spots]
    return _targets(
        np.repeat(where[:, None], nodes, axis=1), np.repeat(rotation[:, None], nodes, axis=1),
        [spot.radius_m for spot in spots], BALL, glows, np.tile(ALWAYS, (len(spots), 1)),
    )  # fmt: skip


def in_camera(
    targets: TargetsInWorld, signal_e: float, position: Array, rotation: Array, gain: Array | None = None
) -> TargetsInCamera:
    """Return targets in the frame of a camera at ``position`` (K, 3), ``rotation`` (K, 3, 3) camera -> world.

    ``signal_e`` as in ``target_light``, evaluated at the middle node; ``gain`` (m,): factor on the electrons.
    """
    middle = len(position) // 2
    light = target_light(
        targets.glows,
        signal_e,
        targets.path[:, middle],
        targets.rotation[:, middle, :, 2],
        position[middle],
        rotation[middle],
    )
    return TargetsInCamera(
        path=np.ascontiguousarray(np.einsum("mki,kij->mkj", targets.path - position, rotation)),
        rotation=np.ascontiguousarray(np.einsum("kia,mkij->mkaj", rotation, targets.rotation)),
        radius=targets.radius,
        shape=targets.shape,
        figure=targets.figure,
        electrons=light.electrons if gain is None else light.electrons * gain,
        lit_s=targets.lit_s,
        limb=light.limb,
        shade=light.shade,
        fade_rad=light.fade_rad,
    )


def some(targets: TargetsInWorld, chosen: Array) -> TargetsInWorld:
    """Return the ``chosen`` of the targets (indices)."""
    g = targets.glows
    of_glows = {f.name: getattr(g, f.name)[chosen] for f in fields(g) if f.name != "blinks"}
    glows = GlowTable(**of_glows, blinks=tuple(g.blinks[k] for k in chosen))
    arrays = {f.name: getattr(targets, f.name)[chosen] for f in fields(targets) if f.name != "glows"}
    return TargetsInWorld(**arrays, glows=glows)


def joined(*parts: TargetsInCamera) -> TargetsInCamera:
    """Return the targets of all parts as one, in order."""
    names = [f.name for f in fields(TargetsInCamera)]
    return TargetsInCamera(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def _targets(
    path: Array, rotation: Array, radius: Sequence[float], shape: int, glows: Sequence[Glow], lit_s: Array
) -> TargetsInWorld:
    m = len(radius)
    none = np.full(m, -1, dtype=np.int64)
    return TargetsInWorld(
        path,
        rotation,
        np.array(radius, dtype=float),
        np.full(m, shape, dtype=np.int64),
        none,
        none,
        _lobed(tuple(glows)),
        lit_s,
    )


@lru_cache(maxsize=64)
def _lobed(glows: tuple[Glow, ...]) -> GlowTable:
    """Return a table in which every lobe is about its target's facing, also that of a ball."""
    return glow_table(glows, np.zeros(len(glows), dtype=bool))


def _positive(what: str, **values: float) -> None:
    for name, value in values.items():
        if not 0.0 < value < np.inf:
            raise InputError(f"{what}: {name} = {value} given; a number above zero is wanted")


def _angle(what: str, half_deg: float) -> None:
    if not 0.0 < half_deg < 90.0:
        raise InputError(f"{what}: half_deg = {half_deg} given; an angle above 0 and below 90 is wanted")
