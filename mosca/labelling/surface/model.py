"""A surface model: mean places of markers on a deforming surface, and how these places vary together.

Differences between people (shape and placement of markers) and movements are modelled as normal distributions. Their
covariance over the markers is a Gaussian kernel of the distance: neighbours differ and move alike (as in Gaussian
process morphable models, Luethi et al. 2018, IEEE TPAMI 40, 1860). The places are read from a TOML file
(``face.toml`` describes its keys), so that no person has to be learned first.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from mosca.data.arrays import Array, read_only
from mosca.data.files.toml import NotNegative, Positive, Table, Vector, check, read_toml

FACE = Path(__file__).with_name("face.toml")
MOST_MARKERS = 200
LEAST_MARKERS = 6
_MIRROR = np.array([1.0, -1.0, 1.0])
"""Mirrors y, which runs from one side of the face to the other."""
_SAME_M = 1e-6
"""Markers are mirror images of each other if they are this near to it [m], as the file states them."""
NOISE_M = 0.0005
"""Largest error of a measured marker [m]: half hidden ones are off by tenths of millimetres."""

Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f]+$")]


class SurfaceMarker(Table):
    """A marker of the set."""

    name: Name
    other_side: Name | None = Field(None, description="marker that is its mirror image in y = 0")
    place_m: Vector = Field(description="its mean place at rest; x forward, y left, z up [m]")
    moves_m: tuple[NotNegative, NotNegative, NotNegative] = Field(description="rms of its movement along x, y, z [m]")
    seat_sigma_m: Positive | None = Field(
        None, description="how far it is put from its place [m]; default: the file's"
    )
    part: str = Field("", description="what it hangs on, where its neighbours do not")


class SurfaceTable(Table):
    """The whole file."""

    FILE_KIND: ClassVar[str] = "surface-model"

    kind: Literal["surface-model"] = Field(description='"surface-model"')
    size_sigma: Positive = Field(description="standard deviation of the logarithm of the size")
    shape_sigma_m: NotNegative = Field(description="how surfaces of one size differ [m]")
    shape_reach_m: Positive = Field(description="distance within which they differ alike [m]")
    seat_sigma_m: Positive = Field(description="how far markers are put from their places [m]")
    symmetry: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="correlation of both sides' differences")
    motion_reach_m: Positive = Field(description="distance within which markers move alike [m]")
    between_parts: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="correlation of parts' movements")
    marker: Annotated[tuple[SurfaceMarker, ...], Field(min_length=1, max_length=MOST_MARKERS)]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = [name for one in self.marker for name in (one.name, one.other_side) if name is not None]
        if len(set(names)) < len(names):
            raise ValueError(f"'{next(n for n in names if names.count(n) > 1)}' is named twice; names must differ")
        if not LEAST_MARKERS <= len(names) <= MOST_MARKERS:
            raise ValueError(f"{len(names)} markers; {LEAST_MARKERS} to {MOST_MARKERS} are wanted")
        return self


@dataclass(frozen=True, eq=False)
class SurfaceModel:
    """Markers (m) of a surface, and the distribution of their places."""

    names: tuple[str, ...]
    place_m: Array
    """(m, 3) mean places at rest."""
    person: Array
    """(3 m, 3 m) covariance of a person's own places, which stay [m^2]."""
    motion: Array
    """(3 m, 3 m) covariance of the movement about rest [m^2]."""
    size_sigma: float
    """Standard deviation of the logarithm of the size."""

    def __post_init__(self) -> None:
        m = len(self.names)
        object.__setattr__(self, "place_m", read_only(self.place_m, (m, 3), "place_m"))
        for name in ("person", "motion"):
            object.__setattr__(self, name, read_only(getattr(self, name), (3 * m, 3 * m), name))

    def covariance(self, share: float = 1.0) -> Array:
        """Return the covariance (3 m, 3 m) of the places in a frame, with a ``share`` of the movement's variance."""
        return np.asarray(self.person + share * self.motion)


def read_surface_model(path: Path = FACE) -> SurfaceModel:
    """Return the model in ``path``; InputError where the file is no surface model."""
    return surface_model(check(SurfaceTable, read_toml(path), path))


def surface_model(file: SurfaceTable) -> SurfaceModel:
    """Return the model of a file, with both sides."""
    names, places, moves, seats, parts = [], [], [], [], []
    for one in file.marker:
        for name, side in ((one.name, 1.0), (one.other_side, -1.0)):
            if name is not None:
                names.append(name)
                places.append(np.array(one.place_m) * [1.0, side, 1.0])
                moves.append(one.moves_m)
                seats.append(file.seat_sigma_m if one.seat_sigma_m is None else one.seat_sigma_m)
                parts.append(one.part)
    place, part = np.array(places), np.array(parts)
    away = np.sum((place[:, None] - place) ** 2, axis=2)
    across = np.sum((place[:, None] - place * _MIRROR) ** 2, axis=2)
    shape = file.shape_sigma_m**2 * np.exp(-0.5 * away / file.shape_reach_m**2)
    shape_across = file.shape_sigma_m**2 * np.exp(-0.5 * across / file.shape_reach_m**2)
    seat, opposite = np.square(seats), (across < _SAME_M**2).astype(float)
    # f(x) + mirrored f of the mirror image, scaled to the size of f: alike on both sides
    person = np.kron(shape + np.diag(seat), np.eye(3))
    person += file.symmetry * np.kron(shape_across + seat * opposite, np.diag(_MIRROR))
    # a product of kernels is a kernel: the covariance stays positive
    alike = np.where(part[:, None] == part, 1.0, file.between_parts) * np.exp(-0.5 * away / file.motion_reach_m**2)
    motion = np.zeros((len(names), 3, len(names), 3))
    for axis, rms in enumerate(np.array(moves).T):
        motion[:, axis, :, axis] = rms[:, None] * alike * rms
    return SurfaceModel(tuple(names), place, person, motion.reshape(person.shape), file.size_sigma)
