"""The actor's marker sets: positions of up to 60 markers on the body, by priority.

Names are those of the usual full-body sets (Vicon Plug-in Gait) where they exist. Each marker is placed by a ray
from inside its body part: its seat is where the ray leaves the part's own shapes.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from twin.scenes.anatomy import FORWARD, LEFT, UP, Anatomy
from twin.scenes.world import Shape, ball_centre, outermost

FEWEST, MOST = 30, 60
LARGEST_SCATTER_M = 0.02
MarkerSet = Literal["default", "anatomical"]
MARKER_SETS: tuple[MarkerSet, ...] = ("default", "anatomical")


@dataclass(frozen=True)
class MarkerSite:
    """A marker site on a part of the body: where a ray from a line between two points meets the skin."""

    name: str
    part: str
    start: str
    """Named points at the line's ends."""
    end: str
    along: float
    """Start of the ray on the line, as a share of its length."""
    toward: tuple[float, float, float]
    """Direction of the ray (outward from the midline, forward, up); on limbs its component across the limb."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the ray's start, in the same axes, in metres of a 1.75 m person."""
    across: bool = True


@dataclass(frozen=True, eq=False)
class Seat:
    """Position of a marker on the skin."""

    name: str
    part: str
    surface: Array
    """(3,) rest pose coordinates [m]."""
    normal: Array
    """(3,) unit vector."""

    def centre(self, diameter_m: float) -> Array:
        """Return the centre (3,) of a ball of ``diameter_m`` whose base is on this seat [m]."""
        return ball_centre(self.surface, self.normal, diameter_m)


def _both(name: str, part: str, start: str, end: str, along: float, toward: tuple[float, float, float],
          shift: tuple[float, float, float] = (0.0, 0.0, 0.0), across: bool = True) -> list[MarkerSite]:  # fmt: skip
    def own(side: str, point: str) -> str:
        return point if point in ("hips", "neck", "head_center") else side + point

    return [
        MarkerSite(
            letter + name,
            part if part in ("pelvis", "chest", "head", "abdomen") else side + part,
            own(side, start),
            own(side, end),
            along,
            toward,
            shift,
            across,
        )
        for letter, side in (("L", "l_"), ("R", "r_"))
    ]


def _trunk(name: str, part: str, along: float, toward: tuple[float, float, float],
           shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[MarkerSite]:  # fmt: skip
    return [MarkerSite(name, part, "hips", "neck", along, toward, shift, across=False)]


_FRONT, _BACK, _OUT, _UP = (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
_IN = (-1.0, 0.0, 0.0)
_HEAD = ("head", "head_center", "head_center", 0.0)
_PELVIS = ("pelvis", "hips", "neck", 0.0)
_PELVIC = (0.0, 0.0, 0.09)  # from the hips up to the middle of the pelvis' shape

MARKER_SITES: tuple[MarkerSite, ...] = (
    *_both("FHD", *_HEAD, (0.6, 0.75, 0.3), across=False),
    *_both("BHD", *_HEAD, (0.6, -0.75, 0.25), across=False),
    MarkerSite("C7", "chest", "neck", "neck", 0.0, _BACK, (0.0, 0.0, 0.055), across=False),
    *_trunk("T10", "chest", 0.63, _BACK),
    *_trunk("CLAV", "chest", 0.93, _FRONT),
    *_trunk("STRN", "chest", 0.64, _FRONT),
    *_both("ASI", *_PELVIS, (0.55, 0.8, 0.0), _PELVIC, across=False),
    *_both("PSI", *_PELVIS, (0.34, -1.0, 0.0), _PELVIC, across=False),
    *_both("SHO", "chest", "upper_arm", "upper_arm", 0.0, _UP, (-0.04, 0.0, 0.0), across=False),
    *_both("ELB", "upper_arm", "upper_arm", "forearm", 0.96, (0.0, -0.6, 0.8)),
    *_both("WRA", "wrist", "forearm", "hand", 0.95, _FRONT),
    *_both("FIN", "hand", "hand", "fingers", 0.3, _UP),
    *_both("KNE", "thigh", "thigh", "shank", 0.96, _OUT),
    *_both("ANK", "shank", "shank", "foot", 0.97, _OUT),
    *_both("HEE", "foot", "heel", "heel", 0.0, _BACK, across=False),
    *_both("TOE", "foot", "heel", "ball", 0.95, _UP),
    *_both("THI", "thigh", "thigh", "shank", 0.5, _OUT),
    # 30 up to here: every part is seen.
    *_both("WRB", "wrist", "forearm", "hand", 0.95, _BACK),
    *_both("TIB", "shank", "shank", "foot", 0.5, _OUT),
    *_both("UPA", "upper_arm", "upper_arm", "forearm", 0.5, _UP),
    *_both("FRM", "forearm", "forearm", "hand", 0.4, _UP),
    *_both("MT5", "foot", "heel", "ball", 0.68, _OUT),
    *_both("THF", "thigh", "thigh", "shank", 0.36, _FRONT),
    *_both("SHN", "shank", "shank", "foot", 0.28, _FRONT),
    *_both("PNK", "hand", "hand", "fingers", 0.62, _BACK),
    *_trunk("RBAK", "chest", 0.72, _BACK, (0.08, 0.0, 0.0)),
    *_trunk("LBAK", "chest", 0.80, _BACK, (0.08, 0.0, 0.0)),
    *_both("WT", *_PELVIS, (1.0, 0.0, 0.3), _PELVIC, across=False),
    # 50 up to here: the default.
    MarkerSite("ARIEL", "head", "head_center", "head_center", 0.0, _UP, across=False),
    *_both("UPB", "upper_arm", "upper_arm", "forearm", 0.38, _BACK),
    *_both("THB", "thigh", "thigh", "shank", 0.6, _BACK),
    *_both("CLF", "shank", "shank", "foot", 0.4, _BACK),
    *_trunk("L3", "abdomen", 0.42, _BACK),
    *_both("CHE", "chest", "hips", "neck", 0.78, _FRONT, (0.07, 0.0, 0.0), across=False),
)


_LEFT_OUT = ("LWT", "RWT", "RBAK")
ANATOMICAL_SITES: tuple[MarkerSite, ...] = (
    *(site for site in MARKER_SITES[:50] if site.name not in _LEFT_OUT),
    *_both("KNM", "thigh", "thigh", "shank", 0.96, _IN),
    *_both("ANM", "shank", "shank", "foot", 0.97, _IN),
    *_both("ELM", "upper_arm", "upper_arm", "forearm", 0.96, (0.0, 0.6, -0.8)),
)
"""The default 50 less three, and one opposite to each KNE, ANK and ELB, so that each of these joints has two."""


def seats(anatomy: Anatomy, shapes: dict[str, list[Shape]], markers: int, marker_set: MarkerSet) -> list[Seat]:
    """Return the positions of the first ``markers`` of the default set, or of the 53 of the anatomical set.

    Raises InputError outside 30..60 and for an unknown set.
    """
    if marker_set not in MARKER_SETS:
        raise InputError(f"marker_set = {marker_set!r} given; allowed: {', '.join(MARKER_SETS)}")
    if not FEWEST <= markers <= MOST:
        raise InputError(f"markers = {markers} given; {FEWEST} to {MOST} fit on an actor")
    sites = MARKER_SITES[:markers] if marker_set == "default" else ANATOMICAL_SITES
    return [_seat(site, anatomy, shapes) for site in sites]


def scattered(seated: list[Seat], sigma_m: float, rng: np.random.Generator) -> list[Seat]:
    """Return ``seated`` as another person would place them: off by ``sigma_m`` (each coordinate) along the skin.

    Across the skin they are off by half of that, for flesh of another thickness. Palpation of one landmark by several
    people scatters by 5 to 8 mm along the skin (Della Croce et al. 1999, Med. Biol. Eng. Comput. 37, 155). 0 changes
    nothing.
    """
    if not 0 <= sigma_m <= LARGEST_SCATTER_M:
        raise InputError(f"seat_sigma_m = {sigma_m} given; 0 to {LARGEST_SCATTER_M} m wanted")
    if sigma_m == 0:
        return seated
    moved = []
    for seat, offset in zip(seated, sigma_m * rng.normal(size=(len(seated), 3)), strict=True):
        across = seat.normal * (seat.normal @ offset)
        moved.append(replace(seat, surface=seat.surface + offset - across / 2))
    return moved


def _seat(site: MarkerSite, anatomy: Anatomy, shapes: dict[str, list[Shape]]) -> Seat:
    # In a skeleton without a wrist joint, the forearm reaches down to the hand.
    part = anatomy.part_or(site.part, site.part.replace("wrist", "forearm"))
    outward = -LEFT if site.name.startswith("R") else LEFT
    axes = np.stack([outward, FORWARD, UP])
    start, end = anatomy.points[site.start], anatomy.points[site.end]
    origin = start + site.along * (end - start) + anatomy.scale * np.asarray(site.shift) @ axes
    toward = np.asarray(site.toward) @ axes
    if site.across:
        limb = (end - start) / np.linalg.norm(end - start)
        toward = toward - toward @ limb * limb
    surface, normal = outermost(shapes[part], origin, toward)
    return Seat(site.name, part, surface, normal)
