"""Image points of a wand calibration, arranged by camera and object point, in pixels and in plain coordinates."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.bundle.solver import Distances
from mosca.data.arrays import Array, read_only
from mosca.data.rig import Lens, MoscaLens, OpenCVLens, principal_distances_px
from mosca.data.sightings import Sightings
from mosca.errors import InputError

NO_DISTANCES = Distances(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class PointViews:
    """n image points: ``camera`` (n,) saw object ``point`` (n,) at ``xy_px`` (n, 2) +- ``sigma_px`` (n,).

    ``names`` and ``sizes`` (c, 2) of the c cameras, ``lenses`` their lenses as far as they are known (model and
    shape of the pixels); ``points``: how many object points there are; ``rods``: known distances between them;
    ``row`` (n,) which of the sightings each is.
    """

    names: tuple[str, ...]
    sizes: Array
    lenses: tuple[Lens, ...]
    camera: Array
    point: Array
    xy_px: Array
    sigma_px: Array
    points: int
    rods: Distances
    row: Array

    def __post_init__(self) -> None:
        n, c = len(self.xy_px), len(self.names)
        for name, shape, dtype in (
            ("sizes", (c, 2), np.int64),
            ("camera", (n,), np.int64),
            ("point", (n,), np.int64),
            ("xy_px", (n, 2), np.float64),
            ("sigma_px", (n,), np.float64),
            ("row", (n,), np.int64),
        ):
            object.__setattr__(self, name, read_only(getattr(self, name), shape, name, dtype))

    def __len__(self) -> int:
        return len(self.xy_px)

    def only(self, keep: Array) -> "PointViews":
        """Return the image points ``keep`` (mask or indices); cameras and object points are counted as before."""
        return replace(
            self,
            camera=self.camera[keep],
            point=self.point[keep],
            xy_px=self.xy_px[keep],
            sigma_px=self.sigma_px[keep],
            row=self.row[keep],
        )

    def table(self) -> Array:
        """Return each camera's image point (c, p), by index, of each object point; -1 where it did not see it."""
        out = np.full((len(self.names), self.points), -1, dtype=np.int64)
        out[self.camera, self.point] = np.arange(len(self))
        return out

    def common(self) -> Array:
        """Return the number (c, c) of object points that both cameras of each pair saw."""
        seen = (self.table() >= 0).astype(np.float64)
        return np.asarray(np.rint(seen @ seen.T).astype(np.int64))

    def of_cameras(self, cameras: Iterable[int]) -> "PointViews":
        """Return those image points of some cameras whose object point a second one of these cameras saw."""
        chosen = np.isin(self.camera, list(cameras))
        rays = np.bincount(self.point[chosen], minlength=self.points)
        return self.only(chosen & (rays[self.point] >= 2))

    def thinned(self, most: int, rng: np.random.Generator) -> "PointViews":
        """Return at most about ``most`` image points: whole object points and rods, drawn by ``rng``."""
        if len(self) <= most:
            return self
        # points that rods join are drawn together
        group = np.arange(self.points)
        np.minimum.at(group, self.rods.second, self.rods.first)
        chosen = rng.random(self.points) < most / len(self)
        return self.only(chosen[group][self.point])

    def middle_px(self, camera: int) -> Array:
        """Return the middle (2,) of a camera's image [px]."""
        return np.asarray((self.sizes[camera] - 1) / 2)

    def reach_px(self, camera: int) -> float:
        """Return half the diagonal of a camera's image [px of its x axis]."""
        width, height = self.sizes[camera]
        return float(np.hypot(width, height * self.aspect(camera)) / 2)

    def aspect(self, camera: int) -> float:
        """Return the height of a camera's pixels over their width."""
        fx, fy = principal_distances_px(self.lenses[camera])
        return fx / fy

    def plain(self, camera: int, xy_px: Array, bend: float) -> Array:
        """Return pixels (n, 2) as plain coordinates: from the image's middle, in half diagonals, y downwards.

        ``bend``: the straightening x / (1 + bend r^2) of the division model (Fitzgibbon 2001), r in half diagonals
        of the distorted image.
        """
        x = (np.asarray(xy_px) - self.middle_px(camera)) * (1.0, self.aspect(camera)) / self.reach_px(camera)
        return np.asarray(x / (1 + bend * (x**2).sum(axis=-1, keepdims=True)))

    def pinhole(self, camera: int, focal: float, bend: float) -> OpenCVLens:
        """Return the lens of a focal length [half diagonals] whose k1 and k2 imitate ``bend``."""
        f = focal * self.reach_px(camera)
        measured = np.linspace(0.1, 1.0, 10)
        ideal = measured / (1 + bend * measured**2)
        r2 = (ideal / focal) ** 2
        design = np.column_stack([r2, r2**2]) * ideal[:, None]
        k1, k2 = np.linalg.lstsq(design, measured - ideal, rcond=None)[0] if bend else (0.0, 0.0)
        cx, cy = self.middle_px(camera)
        return OpenCVLens(f, f / self.aspect(camera), float(cx), float(cy), float(k1), float(k2))


def point_views(
    sightings: Sightings, marks: int, lenses: Sequence[Lens], rods: Distances | None = None
) -> PointViews:
    """Return the sightings as tracks; object point ``frame * marks + mark``, unknown marks (-1) left out.

    ``lenses``: of each camera. InputError where a mark occurs twice in an image or the lenses do not suit.
    """
    known = np.flatnonzero(sightings.mark >= 0)
    point = sightings.frame[known] * marks + sightings.mark[known]
    camera = sightings.camera[known]
    key = camera * (sightings.frames * marks) + point
    if len(np.unique(key)) < len(key):
        first = known[np.argmax(np.bincount(np.unique(key, return_inverse=True)[1]) > 1)]
        raise InputError(
            f"sightings: camera '{sightings.cameras[sightings.camera[first]]}' has a mark twice in one frame; each "
            "mark of the target is seen once at the most, so leave the doubtful one out"
        )
    if len(lenses) != len(sightings.cameras):
        raise InputError(f"lenses: {len(lenses)} given for {len(sightings.cameras)} cameras; give one for each")
    for name, lens in zip(sightings.cameras, lenses, strict=True):
        if not isinstance(lens, MoscaLens | OpenCVLens):
            raise InputError(
                f"camera '{name}': lens model '{lens.model}' cannot be found without a known target; allowed: mosca, "
                "opencv; calibrate a fisheye with a board or a test field"
            )
    return PointViews(
        sightings.cameras,
        sightings.sizes,
        tuple(lenses),
        camera,
        point,
        sightings.xy_px[known],
        np.maximum(sightings.sigma_px[known], 1e-3),
        sightings.frames * marks,
        NO_DISTANCES if rods is None else rods,
        known,
    )
