"""A made-up adult face: its surface, where 40 markers sit on it, and the blend shapes that deform it.

Axes of the head: x forward, y left, z up, origin midway between the ears. In front view (y, z) the skin is a height
field x(y, z): an ellipsoid with a nose, a chin, lips and so on as Gaussian bumps. A blend shape is a field of
displacements over the front view; that of the jaw turns the skin below about the jaw's joint. Sizes of the face are
means of adults (Farkas 1994: face breadth about 0.14 m, sellion to menton 0.12 m, mouth 0.05 m). Tables are in mm.

Displacements of the blend shapes at a coefficient of 1: jaw 12 mm at the incisors (speech opens 5 to 15 mm), lips
4 to 8 mm, brows 8 mm, cheeks 6 mm.
"""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only

_CENTRE_MM = np.array([10.0, 0.0, -15.0])
_SEMI_AXES_MM = np.array([85.0, 74.0, 125.0])
_BUMPS_MM = np.array(
    [
        # height, y, z, reach along y, reach along z
        [8.0, 0.0, 15.0, 8.0, 18.0],  # bridge of the nose
        [22.0, 0.0, -18.0, 10.0, 13.0],  # its tip
        [-7.0, 32.0, 12.0, 13.0, 9.0],  # eyes
        [-7.0, -32.0, 12.0, 13.0, 9.0],
        [3.0, 25.0, 31.0, 18.0, 7.0],  # brows
        [3.0, -25.0, 31.0, 18.0, 7.0],
        [6.0, 0.0, -52.0, 20.0, 9.0],  # lips
        [8.0, 0.0, -85.0, 16.0, 12.0],  # chin
        [4.0, 45.0, -10.0, 14.0, 14.0],  # cheekbones
        [4.0, -45.0, -10.0, 14.0, 14.0],
        [10.0, 0.0, 60.0, 45.0, 25.0],  # forehead
    ]
)
_JAW_JOINT_MM = np.array([10.0, 0.0, 0.0])
JAW_RAD = 12.0 / 110.0
"""Turn of the jaw at a coefficient of 1 [rad]: 12 mm at the incisors, 110 mm from its joint."""

_MIDDLE_MM = {
    "FHD": (0, 62), "NBR": (0, 14), "NTP": (0, -18), "ULP": (0, -43), "LLP": (0, -62), "CHN": (0, -85),
}  # fmt: skip
_LEFT_MM = {
    "FHD": (32, 58), "TMP": (62, 38), "BRI": (12, 32), "BRM": (28, 37), "BRO": (46, 32), "NWG": (15, -24),
    "LID": (32, -2), "CKU": (50, -8), "CKM": (29, -18), "CKL": (44, -38), "NLF": (27, -36), "ULP": (13, -45),
    "MTC": (26, -53), "LLP": (13, -60), "CHN": (19, -79), "JWF": (40, -75), "JWB": (62, -45),
}  # fmt: skip
"""Front view (y, z) of the markers in the middle, and of those with one on both sides (prefixes M, L, R).

FHD forehead, TMP temple, BRI BRM BRO inner, middle and outer brow, NBR NTP NWG bridge, tip and wing of the nose, LID
below the lower lid, CKU CKM CKL cheek, NLF fold from nose to mouth, ULP upper lip, MTC corner of the mouth, LLP
lower lip, CHN chin, JWF JWB jaw.
"""


@dataclass(frozen=True)
class _Pull:
    """A part of a blend shape: displacement ``way`` (x, y, z) at ``centre`` (y, z), and a Gaussian of ``reach``."""

    centre: tuple[float, float]
    reach: tuple[float, float]
    way: tuple[float, float, float]

    def at(self, yz: Array, side: float) -> Array:
        """Return displacements (n, 3) at front views (n, 2); ``side`` -1: of the mirror image."""
        away = (yz * [side, 1.0] - self.centre) / self.reach
        return np.asarray(np.exp(-0.5 * np.sum(away**2, axis=1))[:, None] * self.way * [1.0, side, 1.0])


# a pull in the middle counts for both sides
_CORNER, _BROW = (26.0, -53.0), (28.0, 36.0)
_PULLS_MM: dict[str, tuple[_Pull, ...]] = {
    "pucker": (_Pull(_CORNER, (14, 12), (4, -7, 0)), _Pull((0, -52), (14, 12), (1.5, 0, 0))),
    "spread": (_Pull(_CORNER, (16, 14), (-3, 7, 4)), _Pull((45, -20), (16, 16), (2, 1, 4))),
    "upper_lip": (_Pull((8, -44), (14, 7), (1, 0, 4)),),
    "lower_lip": (_Pull((8, -61), (14, 7), (1, 0, -4)),),
    "puff": (_Pull((44, -40), (18, 18), (3, 6, 0)),),
    "squint": (_Pull((32, -2), (14, 9), (0, 0, 3)), _Pull((45, -14), (14, 12), (1, 0, 2))),
    "brow_raise": (_Pull(_BROW, (26, 16), (-1, 0, 8)), _Pull((20, 60), (26, 14), (0, 0, 3))),
    "frown": (_Pull((12, 32), (14, 12), (1, -4, -3)),),
    "wrinkle": (_Pull((15, -24), (12, 12), (1, 0, 3)), _Pull((13, -45), (12, 10), (0, 0, 2))),
}
BOTH, LEFT, RIGHT = (1.0, -1.0), (1.0,), (-1.0,)
SHAPES: tuple[tuple[str, str, tuple[float, ...]], ...] = (
    ("jaw", "speech", BOTH),
    ("pucker", "speech", BOTH),
    ("spread", "speech", LEFT),
    ("spread", "speech", RIGHT),
    ("upper_lip", "speech", BOTH),
    ("lower_lip", "speech", BOTH),
    ("puff", "speech", BOTH),
    ("squint", "mimic", BOTH),
    ("brow_raise", "mimic", LEFT),
    ("brow_raise", "mimic", RIGHT),
    ("frown", "mimic", BOTH),
    ("wrinkle", "mimic", BOTH),
)
"""Blend shapes: name, the pulls that make it, and its sides."""


@dataclass(frozen=True, eq=False)
class FaceSurface:
    """A person's face: sizes along x, y, z against the tables', and heights of the bumps [mm]."""

    scale: Array
    """(3,)"""
    bumps: Array
    """(b, 5): as in the table."""

    @classmethod
    def drawn(cls, size: float, rng: np.random.Generator) -> "FaceSurface":
        """Return a face of ``size`` times the tables' size; axes vary by 3 % and bumps by 20 % (one sigma)."""
        bumps = _BUMPS_MM.copy()
        bumps[:, 0] *= np.exp(rng.normal(0.0, 0.2, len(bumps)))
        scale = size * np.exp(rng.normal(0.0, 0.03, 3))
        return cls(read_only(scale, (3,), "scale"), read_only(bumps, (None, 5), "bumps"))

    def skin(self, yz_mm: Array) -> Array:
        """Return the skin (n, 3) [mm, tables' size] at front views (n, 2)."""
        inside = 1.0 - np.sum(((yz_mm - _CENTRE_MM[1:]) / _SEMI_AXES_MM[1:]) ** 2, axis=1)
        x = _CENTRE_MM[0] + _SEMI_AXES_MM[0] * np.sqrt(np.maximum(inside, 1e-3))
        away = (yz_mm[:, None] - self.bumps[:, 1:3]) / self.bumps[:, 3:]
        x = x + np.exp(-0.5 * np.sum(away**2, axis=2)) @ self.bumps[:, 0]
        return np.column_stack([x, yz_mm])

    def normals(self, yz_mm: Array) -> Array:
        """Return outward unit normals (n, 3) of the skin, head axes."""
        step = 0.01
        slope = [(self.skin(yz_mm + d)[:, 0] - self.skin(yz_mm - d)[:, 0]) / (2 * step) for d in step * np.eye(2)]
        normal = np.column_stack([np.ones(len(yz_mm)), -slope[0], -slope[1]]) / self.scale
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))

    def placed(self, skin_mm: Array) -> Array:
        """Return points (n, 3) [mm, tables' size] in the head [m]."""
        return np.asarray(1e-3 * skin_mm * self.scale)

    @property
    def jaw_joint(self) -> Array:
        """(3,) [m], head axes."""
        return self.placed(_JAW_JOINT_MM)


def markers_on_front() -> tuple[tuple[str, ...], Array]:
    """Return the markers' names and their positions in front view (m, 2) [mm]."""
    names, places = [f"M{name}" for name in _MIDDLE_MM], list(_MIDDLE_MM.values())
    for letter, side in (("L", 1), ("R", -1)):
        names += [letter + name for name in _LEFT_MM]
        places += [(side * y, z) for y, z in _LEFT_MM.values()]
    return tuple(names), np.array(places, dtype=np.float64)


def jaw_share(yz_mm: Array) -> Array:
    """Return the share (n,) of the jaw's turn that skin at front views (n, 2) follows: 1 below the mouth, 0 above."""
    soft = 3.5 + 12.0 * (yz_mm[:, 0] / 60.0) ** 2
    return np.asarray(1.0 / (1.0 + np.exp(np.clip((yz_mm[:, 1] + 53.0) / soft, -50, 50))))


@dataclass(frozen=True, eq=False)
class BlendShapes:
    """Displacements of m points of a face by the coefficients of ``SHAPES`` (s)."""

    linear: Array
    """(s, m, 3): displacements at a coefficient of 1 [m]; 0 for the jaw."""
    hangs: Array
    """(m, 3): points from the jaw's joint, times the share of its turn that they follow [m]."""

    @classmethod
    def of(cls, face: FaceSurface, yz_mm: Array) -> "BlendShapes":
        """Return the blend shapes of the skin of ``face`` at front views (m, 2)."""
        linear = np.zeros((len(SHAPES), len(yz_mm), 3))
        for k, (name, _, sides) in enumerate(SHAPES):
            for side in sides if name != "jaw" else ():
                linear[k] += sum(pull.at(yz_mm, side) for pull in _PULLS_MM[name])
        hangs = jaw_share(yz_mm)[:, None] * (face.placed(face.skin(yz_mm)) - face.jaw_joint)
        return cls(
            read_only(1e-3 * linear * face.scale, (len(SHAPES), None, 3), "linear"),
            read_only(hangs, (None, 3), "hangs"),
        )

    def moved(self, coefficients: Array) -> Array:
        """Return displacements (m, 3) [m] by coefficients (s,)."""
        c, s = np.cos(JAW_RAD * coefficients[0]), np.sin(JAW_RAD * coefficients[0])
        # a positive turn about y (to the left) takes the chin down and back
        turn = np.array([[c - 1.0, 0.0, s], [0.0, 0.0, 0.0], [-s, 0.0, c - 1.0]])
        return np.asarray(np.tensordot(coefficients, self.linear, axes=1) + self.hangs @ turn.T)
