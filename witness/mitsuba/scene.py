"""A scene in plain values: cameras, rigid bodies that move, lights, room, sensor. Lengths in m, times in s."""

import ast
import hashlib
import json
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[Any]
Triple = tuple[float, float, float]


FIRST_MID_S = 0.1
"""Middle of the first exposure."""
HOLD_FROM_S = 0.05
"""Delay of a stand's begin after multiples of its length: no stand begins in an exposure centred on a multiple."""


@dataclass(frozen=True)
class LensCamera:
    """OpenCV's lens (``distortion`` k1, k2, p1, p2, k3) behind a thin lens; ``aperture_m``: diameter, 0: pinhole."""

    name: str
    size: tuple[int, int]
    focal_px: tuple[float, float]
    principal_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    position_m: Triple
    rotation_wxyz: tuple[float, float, float, float]
    """world_from_camera."""
    aperture_m: float = 0.0
    focus_m: float = 3.0
    """Distance of sharp focus along the axis."""

    @property
    def rotation(self) -> Array:
        """World_from_camera (3, 3)."""
        return rotation_matrix(self.rotation_wxyz)


@dataclass(frozen=True)
class Swing:
    """Position ``centre + amplitude sin(2 pi frequency t + phase)``, axis by axis; the same for the rotation vector.

    The rotation is applied to the base orientation: world_from_body = Exp(turn) base. With ``hold_s`` the body stands
    still for that long, and then jumps to the next pose.
    """

    centre_m: Triple = (0.0, 0.0, 0.0)
    amplitude_m: Triple = (0.0, 0.0, 0.0)
    frequency_hz: Triple = (0.0, 0.0, 0.0)
    phase_rad: Triple = (0.0, 0.0, 0.0)
    base_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    turn_rad: Triple = (0.0, 0.0, 0.0)
    turn_frequency_hz: Triple = (0.0, 0.0, 0.0)
    turn_phase_rad: Triple = (0.0, 0.0, 0.0)
    hold_s: float = 0.0

    def pose(self, t: float) -> tuple[Array, Array]:
        """Return world_from_body (3, 3) and the position (3) at ``t``."""
        if self.hold_s > 0:
            t = np.floor((t - HOLD_FROM_S) / self.hold_s) * self.hold_s
        swing = np.sin(2 * np.pi * np.array(self.frequency_hz) * t + self.phase_rad)
        if not any(self.turn_rad):
            return rotation_matrix(self.base_wxyz), np.array(self.centre_m) + np.array(self.amplitude_m) * swing
        turn = np.array(self.turn_rad) * np.sin(
            2 * np.pi * np.array(self.turn_frequency_hz) * t + self.turn_phase_rad
        )
        rotation = Rotation.from_rotvec(turn).as_matrix() @ rotation_matrix(self.base_wxyz)
        return rotation, np.array(self.centre_m) + np.array(self.amplitude_m) * swing


@dataclass(frozen=True)
class MarkerBall:
    """A marker ball at ``at_m`` of its body."""

    name: str
    at_m: Triple
    diameter_m: float


@dataclass(frozen=True)
class MarkerDisc:
    """A flat round marker, seen from the side to which ``normal`` points."""

    name: str
    at_m: Triple
    normal: Triple
    diameter_m: float


@dataclass(frozen=True)
class Bar:
    """A dark cylinder between two points."""

    start_m: Triple
    end_m: Triple
    diameter_m: float


@dataclass(frozen=True)
class Chessboard:
    """A chessboard: ``columns`` x ``rows`` squares, the upper left one black, on a plate with a white margin.

    Origin in the middle of the face, x right, y up, z to the front.
    """

    columns: int
    rows: int
    square_m: float
    margin_m: float


@dataclass(frozen=True)
class CodedPlate:
    """White dot and ring of ``sectors`` on a black plate; sectors counter-clockwise from ``x_axis`` in front view."""

    name: str
    at_m: Triple
    normal: Triple
    x_axis: Triple
    dot_radius_m: float
    sectors: tuple[bool, ...]


@dataclass(frozen=True)
class Mesh:
    """A surface that moves: ``file`` an .npz of ``vertices`` (frames, n, 3) [m] and ``faces`` (m, 3)."""

    file: str
    digest: str
    """Digest of the file's content."""
    reflectance: float


@dataclass(frozen=True)
class Limb:
    """A cylinder with round ends between two points, as a mesh of ``LIMB_SIDES``: part of a person's body."""

    start_m: Triple
    end_m: Triple
    diameter_m: float
    reflectance: float


Part = Limb | MarkerBall | MarkerDisc | Bar | Chessboard | CodedPlate | Mesh


@dataclass(frozen=True)
class Body:
    """Parts that move together."""

    motion: Swing
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class SceneLamps:
    """``ring``: radiance of an annulus around each lens; ``panels``: squares (x, y, z, edge, radiance), face down."""

    ring: float = 1.0
    ring_inner_m: float = 0.03
    ring_outer_m: float = 0.045
    panels: tuple[tuple[float, float, float, float, float], ...] = ()


@dataclass(frozen=True)
class Room:
    """``floor`` and ``walls`` are reflectances (0: none there), textured by noise of ``contrast`` and ``grain_m``."""

    floor: float = 0.0
    walls: float = 0.0
    floor_z_m: float = -1.1
    half_width_m: float = 4.5
    height_m: float = 4.0
    contrast: float = 0.0
    grain_m: float = 0.1
    bounces: int = 0
    """Diffuse reflections between the first surface and a lamp."""


@dataclass(frozen=True)
class SensorValues:
    """See ``sensor.py``. ``peak_e``: photoelectrons of the brightest pixel of a near target."""

    bits: int = 8
    peak_e: float = 4000.0
    peak_dn: float = 200.0
    """Count of ``peak_e`` above the black level, at 8 bits; with more bits it is 2^(bits - 8) times as large."""
    read_dn: float = 0.7
    """Temporal dark noise in counts, also at 8 bits."""
    black_dn: float = 2.0
    stray_e: float = 30.0
    """Even light from elsewhere, photoelectrons a pixel."""
    prnu: float = 0.005
    dsnu_dn: float = 0.2
    hot_share: float = 0.0
    hot_e: float = 1500.0
    full_well_e: float = 10000.0

    @property
    def gain_dn_per_e(self) -> float:
        """Counts per photoelectron."""
        return self.peak_dn / self.peak_e * 2.0 ** (self.bits - 8)


@dataclass(frozen=True)
class Quality:
    """Samples per pixel; powers of two."""

    window_samples: int = 512
    background_samples: int = 64
    plate_samples: int = 64
    """Samples in windows around boards, plates and meshes."""
    edge_samples: int = 64
    """Samples at edges printed on them, where this is more than ``plate_samples``."""


@dataclass(frozen=True)
class WitnessScene:
    """A whole scene; ``finish`` of balls and discs: ``lambert`` or ``retro``."""

    name: str
    cameras: tuple[LensCamera, ...]
    bodies: tuple[Body, ...]
    frames: int
    rate_hz: float
    exposure_s: float
    finish: str = "retro"
    light: SceneLamps = field(default_factory=SceneLamps)
    room: Room = field(default_factory=Room)
    sensor: SensorValues = field(default_factory=SensorValues)
    quality: Quality = field(default_factory=Quality)
    seed: int = 1

    def mid_exposure_s(self, frame: int) -> float:
        """Middle of the exposure, from the session's start."""
        return FIRST_MID_S + frame / self.rate_hz

    def render_key(self) -> str:
        """Return the digest of all inputs of the noise-free images: scene without sensor, and the code."""
        values = asdict(self)
        del values["sensor"], values["name"]
        text = json.dumps(values, sort_keys=True) + code_digest()
        return hashlib.sha256(text.encode()).hexdigest()[:20]


RENDER_CODE = ("scene.py", "projection.py", "textures.py", "surfaces.py", "transport.py", "film.py")
"""Files on which noise-free images depend."""


def code_digest() -> str:
    """Return the digest of the code that makes noise-free images, comments and docstrings left out."""
    folder = Path(__file__).parent
    trees = [ast.parse((folder / name).read_text(encoding="utf-8")) for name in RENDER_CODE]
    for tree in trees:
        for node in ast.walk(tree):
            # string statements: docstrings, also those under constants
            if isinstance(getattr(node, "body", None), list):
                node.body = [  # type: ignore[attr-defined]
                    one
                    for one in node.body  # type: ignore[attr-defined]
                    if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))
                ]
    return hashlib.sha256("".join(ast.dump(tree) for tree in trees).encode()).hexdigest()


@cache
def rotation_matrix(wxyz: tuple[float, float, float, float]) -> Array:
    """Return the rotation (3, 3) of a unit quaternion."""
    w, x, y, z = wxyz
    result: Array = Rotation.from_quat([x, y, z, w]).as_matrix()
    return result


def quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion wxyz of a rotation (3, 3)."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return float(w), float(x), float(y), float(z)
