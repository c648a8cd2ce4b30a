"""Light of a target on a camera: the electrons of a pixel that it fully covers, and when it shines.

The amount follows from the target's ``Glow``, its distance and its angle to the camera. Every lobe is a power
of the cosine, ``cos(a)^n`` with ``n = log(1/2) / log(cos(half))``: smooth, one half at the angle ``half``, zero at
90 degrees. The light of a ring light on a target falls with the square of the distance. The brightness of a
surface's image does not depend on the distance. A tape's curve may instead be even up to one angle and end at
another, as makers print it for glass beads; it then also falls with the observation angle, and lamps fall off their
axis (see ``Glow``).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from twin.scenes.emission import Blink, Glow, lit
from twin.scenes.scene import Scene

PLAIN, RETRO, PAPER, LAMP = 0, 1, 2, 3
_KINDS = {"plain": PLAIN, "retro": RETRO, "paper": PAPER, "lamp": LAMP}
ALWAYS = (-math.inf, math.inf)
NEVER = (0.0, 0.0)
NEVER_FADES = (math.pi, 2 * math.pi)


@dataclass(frozen=True, eq=False)
class GlowTable:
    """The glows of m targets side by side."""

    kind: Array
    """(m,): PLAIN, RETRO, PAPER or LAMP."""
    strength: Array
    """(m,): factor on the marker signal."""
    exponent: Array
    """(m,): exponent of the lobe's cosine; 0: no lobe."""
    at_m: Array
    """(m,): distance of full brightness; NaN: the same at all distances."""
    lobe_m: Array
    """(m,): radius of the ring light over the lobe's observation angle; 0: the observation angle has no effect."""
    lamp_exponent: Array
    """(m,): exponent of the cosine of the angle off the camera's axis; 0: lamps alike to all sides."""
    fade_rad: Array
    """(m, 2): angles off the normal at which a tape begins to send less and sends none; NEVER_FADES: no such tape."""
    limb: Array
    """(m,): share of brightness that the rim lacks, by the lobe and the target's own limb together."""
    shade: Array
    """(m, 3): gradient of brightness, world frame."""
    ball: Array
    """(m,): whether the target is a ball."""
    blinks: tuple[Blink | None, ...]
    """Code of each; None: always on."""


@dataclass(frozen=True, eq=False)
class TargetLight:
    """Light of m targets as the renderer takes it, camera frame."""

    electrons: Array
    """(m,): electrons that a pixel fully covered by the target collects in the window's length."""
    limb: Array
    """(m,): share of brightness that the rim lacks."""
    shade: Array
    """(m, 3): change of brightness from the middle to the rim."""
    fade_rad: Array
    """(m, 2): angles off a ball's normal at which its light begins to fade and ends; NEVER_FADES: no fading."""


@dataclass(frozen=True, eq=False)
class LitIntervals:
    """When m targets shine during a frame, in seconds from the opening of its first row."""

    first: Array
    """(m, 2): a target's first interval; (-inf, inf) where it is never dark, an empty one where it is never lit."""
    again: Array
    """(k,): targets that shine once more; a target is listed once for each further interval."""
    again_s: Array
    """(k, 2): these further intervals."""


def glow_table(glows: Sequence[Glow], ball: Array) -> GlowTable:
    """Return the table of ``glows``; ``ball`` (m,): which targets are balls.

    A retro ball shows all angles at once, so that its lobe is limb darkening. The renderer's law is the brightness
    ``1 - limb (1 - cos a)``, which is one half at ``half_deg``. A rim cannot be darker than dark: for ``half_deg``
    below 60 the law is one half at 60.
    """
    fading = np.array([glow.even_deg is not None for glow in glows], dtype=bool)
    lobed = np.array([glow.kind in ("retro", "lamp") and glow.half_deg < 90.0 for glow in glows], dtype=bool)
    lobed &= ~fading
    half = np.deg2rad([min(glow.half_deg, 89.0) for glow in glows])
    is_ball = np.asarray(ball, dtype=bool)
    retro_ball = is_ball & ~fading & np.array([glow.kind == "retro" for glow in glows], dtype=bool)
    towards = np.array([glow.shade_world for glow in glows], dtype=float).reshape(-1, 3)
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    own_limb = np.array([glow.limb for glow in glows], dtype=float)
    lobe_limb = np.where(retro_ball, np.minimum(1.0, 0.5 / (1.0 - np.cos(half))), 0.0)
    return GlowTable(
        kind=np.array([_KINDS[glow.kind] for glow in glows], dtype=np.int64),
        strength=np.array([glow.strength for glow in glows], dtype=float),
        exponent=np.where(lobed & ~retro_ball, math.log(0.5) / np.log(np.cos(half)), 0.0),
        at_m=np.array([_ring_distance(glow) for glow in glows], dtype=float),
        lobe_m=np.array([glow.ring_m / math.radians(glow.lobe_deg) for glow in glows], dtype=float),
        lamp_exponent=np.array([_exponent(glow.lamp_half_deg) for glow in glows], dtype=float),
        fade_rad=np.array(
            [
                NEVER_FADES if g.even_deg is None else np.deg2rad([g.even_deg, 2 * g.half_deg - g.even_deg])
                for g in glows
            ],
            dtype=float,
        ).reshape(-1, 2),
        limb=1.0 - (1.0 - own_limb) * (1.0 - lobe_limb),
        shade=np.array([[glow.shade] for glow in glows]).reshape(-1, 1) * towards / length,
        ball=is_ball,
        blinks=tuple(glow.blink for glow in glows),
    )


def scene_glows(scene: Scene) -> GlowTable:
    """Return the glows of a scene's markers in the order of ``marker_names``; spheres are balls."""
    spheres = scene.model.geom_type[list(scene.marker_geoms)] == 2
    return glow_table([scene.glows.get(name, Glow()) for name in scene.marker_names], spheres)


def target_light(
    glows: GlowTable,
    signal_e: float,
    xyz: Array,
    axis: Array,
    camera_position: Array,
    camera_rotation: Array,
    radius: Array | None = None,
) -> TargetLight:
    """Return the light of targets at ``xyz`` (m, 3) that face along ``axis`` (m, 3), world frame [m].

    ``signal_e``: electrons that a pixel fully covered by a target of strength 1 collects while the light is
    on for a whole exposure. ``camera_position`` (3,): also that of the ring light; ``camera_rotation`` (3, 3): camera
    -> world. Paper and lobes send nothing backwards; a plain target's strength is the same from everywhere.
    ``radius`` (m,) [m]: of flat targets. Under a ring light, their nearer parts are brighter (None, 0: even).
    """
    electrons = _electrons(glows, signal_e, xyz, axis, camera_position, camera_rotation)
    gradient = np.zeros((len(xyz), 3))
    uneven = ~glows.ball & ~np.isnan(glows.at_m) & (electrons > 0.0)
    if radius is not None and uneven.any():
        for k, to in enumerate(np.eye(3)):
            above, below = (
                _electrons(glows, signal_e, xyz + sign * radius[:, None] * to, axis, camera_position, camera_rotation)
                for sign in (1.0, -1.0)
            )
            gradient[uneven, k] = (above - below)[uneven] / (2.0 * electrons[uneven])
        gradient -= (gradient * axis).sum(axis=1, keepdims=True) * axis
    fade = np.where(glows.ball[:, None], glows.fade_rad, NEVER_FADES)
    return TargetLight(electrons, glows.limb, (glows.shade + gradient) @ camera_rotation, fade)


def _electrons(
    glows: GlowTable, signal_e: float, xyz: Array, axis: Array, camera_position: Array, camera_rotation: Array
) -> Array:
    """Return the electrons (m,) of pixels fully covered by targets, as in ``target_light``."""
    towards = camera_position - xyz
    squared = (towards * towards).sum(axis=1)
    cosine = (towards * axis).sum(axis=1) / np.sqrt(squared)
    electrons = signal_e * glows.strength * np.maximum(cosine, 0.0) ** glows.exponent
    behind = (cosine <= 0.0) & ((glows.exponent > 0.0) | ((glows.kind == PAPER) & ~glows.ball))
    falling = ~np.isnan(glows.at_m)
    electrons[behind] = 0.0
    electrons[falling] *= glows.at_m[falling] ** 2 / squared[falling]
    lobe = glows.lobe_m > 0.0
    electrons[lobe] *= np.exp(glows.lobe_m[lobe] ** 2 * (1.0 / glows.at_m[lobe] ** 2 - 1.0 / squared[lobe]))
    ahead = np.maximum(-(towards @ camera_rotation[:, 2]) / np.sqrt(squared), 0.0)
    electrons *= ahead**glows.lamp_exponent
    flat = ~glows.ball
    electrons[flat] *= faded(np.arccos(np.clip(cosine[flat], -1.0, 1.0)), glows.fade_rad[flat])
    return np.asarray(electrons)


def faded(angle: Array, fade_rad: Array) -> Array:
    """Return the brightness of a tape (m,) at ``angle`` (m,) off its normal: 1, then a smooth step, then nothing."""
    rise = np.clip((fade_rad[:, 1] - angle) / (fade_rad[:, 1] - fade_rad[:, 0]), 0.0, 1.0)
    return np.asarray(rise * rise * (3.0 - 2.0 * rise))


def lit_during(
    glows: GlowTable, opening_s: float, span_s: float, strobe_s: tuple[float, float] = ALWAYS
) -> LitIntervals:
    """Return when targets shine between ``opening_s`` (session clock) and ``span_s`` later.

    Lamps follow their codes. ``strobe_s``: when the camera's strobe is on, from ``opening_s``; retro and plain
    targets shine with it, lamps and paper (in the room's even light) at all times.
    """
    first = np.empty((len(glows.blinks), 2))
    first[:] = ALWAYS
    first[(glows.kind == RETRO) | (glows.kind == PLAIN)] = strobe_s
    again: list[int] = []
    again_s: list[Array] = []
    for k, blink in enumerate(glows.blinks):
        if blink is None:
            continue
        closing_s = opening_s + span_s
        intervals = lit(blink, opening_s, closing_s)
        if len(intervals) == 0:
            first[k] = NEVER
        elif not (intervals[0] == (opening_s, closing_s)).all():
            first[k] = intervals[0] - opening_s
            again += [k] * (len(intervals) - 1)
            again_s += list(intervals[1:] - opening_s)
    return LitIntervals(first, np.array(again, dtype=np.int64), np.array(again_s, dtype=float).reshape(-1, 2))


def _exponent(half_deg: float | None) -> float:
    """Return the exponent for which the cosine's power is one half at ``half_deg``; None: 0."""
    return 0.0 if half_deg is None else math.log(0.5) / math.log(math.cos(math.radians(half_deg)))


def _ring_distance(glow: Glow) -> float:
    return glow.at_m if glow.kind == "retro" and glow.at_m is not None else math.nan
