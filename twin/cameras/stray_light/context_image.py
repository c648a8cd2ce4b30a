"""The context image: scene and body in a camera's image, without the markers.

One ray for a few pixels, along the lens's own rays, finds the visible surface. It is shaded by Lambert's law in even
ambient light and in the light of a lamp at the camera, which falls with the square of the distance. Markers are left
out (they are integrated, see ``render``). Shadows, textures and mirror images are not made. The image's resolution is
that of its rays, in place of the lens's blur. It is made at a stated rate, and used until the next refresh, so that
fast limbs lag slightly; markers never do.
"""

import math
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass
from fnmatch import fnmatchcase
from threading import Lock
from typing import Any

import cv2
import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from twin.cameras.optics.lens import TwinLens
from twin.cameras.render.occluders import PRIMITIVES
from twin.cameras.stray_light.context_rays import Covers, Illumination, Met, RayGrid, cast, ray_grid, shade
from twin.scenes.scene import MARKER_GROUP, UNSEEN_GROUP, Scene, SceneSampler

GREY = np.array([0.2126, 0.7152, 0.0722])
"""Grey value of a colour: luminance of linear RGB (ITU-R BT.709)."""
_MUJOCO_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)


@dataclass(frozen=True)
class Cloth:
    """A covering of the geoms whose names match a pattern."""

    pattern: str
    """Pattern of names with the wildcards of file names: ``*``, ``?``."""
    reflectance: float
    """Reflectance as a Lambert surface; overrides that of the geoms' colour."""
    retro: float = 0.0
    """Brightness under the camera's own lamp, seen head on, over that of a white Lambert surface (falls with cos^2):
    reflective tape has 100 and more."""
    band_m: tuple[float, float] | None = None
    """The cloth covers only the part between these positions along the geom's z axis (a capsule's length), measured
    from its middle."""


@dataclass(frozen=True)
class Context:
    """Settings of the context image."""

    rate_hz: float = 10.0
    """Rate of refreshes."""
    step_px: int = 2
    """Distance of the rays in x and y [px]."""
    ambient: float = 0.01
    """Light of a white surface in even light, over the saturation capacity in one exposure."""
    lamp: float = 0.02
    """Light that the camera's lamp adds to a white surface facing it at ``at_m``, in the same unit."""
    at_m: float = 3.0
    """Distance at which the lamp has that brightness."""
    clothes: tuple[Cloth, ...] = ()
    """A later one covers an earlier one."""

    def __post_init__(self) -> None:
        allowed = (
            ("rate_hz", self.rate_hz, 0.0 < self.rate_hz < math.inf, "a rate above zero"),
            ("step_px", self.step_px, self.step_px in range(1, 17), "a whole number from 1 to 16"),
            ("ambient", self.ambient, 0.0 <= self.ambient < math.inf, "a share from 0 up"),
            ("lamp", self.lamp, 0.0 <= self.lamp < math.inf, "a share from 0 up"),
            ("at_m", self.at_m, 0.0 < self.at_m < math.inf, "a distance above zero"),
        )
        for name, value, fine, wanted in allowed:
            if not fine:
                raise InputError(f"context: {name} = {value} given; {wanted} is wanted")
        for cloth in self.clothes:
            if not (0.0 <= cloth.reflectance < math.inf and 0.0 <= cloth.retro < math.inf):
                raise InputError(
                    f"context: cloth {cloth.pattern!r}: reflectance = {cloth.reflectance}, retro = {cloth.retro} "
                    "given; numbers from 0 up are wanted"
                )
            if cloth.band_m is not None and not cloth.band_m[0] < cloth.band_m[1]:
                raise InputError(
                    f"context: cloth {cloth.pattern!r}: band_m = {cloth.band_m} given; from and to are wanted, the "
                    "smaller one first"
                )


@dataclass(frozen=True, eq=False)
class ContextView:
    """Data that all context images of a camera share, made once by ``context_view``."""

    grid: RayGrid
    context: Context
    full_well_e: float
    """Saturation capacity [electrons]."""
    geom: Array
    """(k,): ids of the geoms that are shown."""
    kind: Array
    """(k,): MuJoCo's types of these geoms."""
    size: Array
    """(k, 3): MuJoCo's sizes of these geoms [m]."""
    bound: Array
    """(k,): radii of bounding spheres [m]."""
    covers: Covers
    row_of: Array
    """(ngeom,): row of a geom in these arrays, or -1."""


def context_view(
    scene: Scene, lens: TwinLens, width: int, height: int, context: Context, full_well_e: float
) -> ContextView:
    """Return the data that all context images of ``scene`` through ``lens`` share.

    Raises InputError for a cloth that no geom wears.
    """
    model = scene.model
    names = [model.geom(g).name for g in range(model.ngeom)]
    colours = np.array([_rgba(model, g) for g in range(model.ngeom)]).reshape(-1, 4)
    hidden_groups = (MARKER_GROUP, UNSEEN_GROUP)
    seen = [g for g in range(model.ngeom) if model.geom_group[g] not in hidden_groups and colours[g, 3] > 0]
    for cloth in context.clothes:
        if not any(fnmatchcase(names[g], cloth.pattern) for g in seen):
            some = ", ".join(repr(names[g]) for g in seen if names[g]) or "none with a name"
            raise InputError(
                f"context: cloth pattern {cloth.pattern!r} given; no geom has such a name; there are: {some}"
            )
    row_of = np.full(model.ngeom, -1, dtype=np.int64)
    row_of[seen] = np.arange(len(seen))
    wears = [[fnmatchcase(names[g], cloth.pattern) for cloth in context.clothes] for g in seen]
    cloths = [(c.reflectance, c.retro, *(c.band_m or (-math.inf, math.inf))) for c in context.clothes]
    return ContextView(
        grid=ray_grid(lens, width, height, context.step_px),
        context=context,
        full_well_e=full_well_e,
        geom=np.array(seen, dtype=np.int64),
        kind=np.array([model.geom_type[g] for g in seen], dtype=np.int64),
        size=np.ascontiguousarray(model.geom_size[seen], dtype=float).reshape(-1, 3),
        bound=np.array([model.geom_rbound[g] for g in seen], dtype=float),
        covers=Covers(
            np.ascontiguousarray(colours[seen, :3] @ GREY, dtype=float),
            np.array(wears, dtype=bool).reshape(len(seen), len(cloths)),
            np.array(cloths, dtype=float).reshape(-1, 4),
        ),
        row_of=row_of,
    )


def context_image(view: ContextView, sampler: SceneSampler, time_s: float, rotation: Array, position: Array) -> Array:
    """Return the mean light (H, W) float32 [electrons] of one exposure at session time ``time_s``.

    ``rotation`` (3, 3) and ``position`` (3,) [m]: world_from_camera. Leaves the sampler's data at ``time_s``.
    """
    state = sampler.at(time_s)
    xyz = np.ascontiguousarray((state.geom_xyz[view.geom] - position) @ rotation)
    geom_rotation = np.ascontiguousarray(rotation.T @ state.geom_rotation[view.geom])
    met = cast(view.grid, view.kind, view.size, view.bound, xyz, geom_rotation)
    if not np.isin(view.kind, (*PRIMITIVES, int(mujoco.mjtGeom.mjGEOM_PLANE))).all():
        _ask_mujoco(view, sampler, rotation, position, met)
    context = view.context
    coarse = shade(
        view.grid.rays, met.geom, met.distance, met.normal, xyz, geom_rotation, view.covers,
        Illumination(context.ambient * view.full_well_e, context.lamp * view.full_well_e, float(context.at_m)),
    )  # fmt: skip
    return enlarged(coarse, context.step_px, view.grid.width, view.grid.height)


def enlarged(coarse: Array, step_px: int, width: int, height: int) -> Array:
    """Return values at every pixel (H, W) float32, bilinear between those at the middles of step x step pixels."""
    rows, columns = coarse.shape
    if step_px == 1:
        return coarse
    fine = cv2.resize(coarse, (columns * step_px, rows * step_px), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[:height, :width])


def refresh_pulse(pulse: int, frame_rate_hz: float, rate_hz: float) -> int:
    """Return the pulse whose context image is used at ``pulse``: the last at or before it that begins a refresh.

    Refresh n begins at the first pulse at or after n / rate; a rate above the frame rate refreshes each pulse.
    """
    if rate_hz >= frame_rate_hz:
        return pulse
    number = math.floor(pulse * rate_hz / frame_rate_hz + 1e-9)
    return math.ceil(number * frame_rate_hz / rate_hz - 1e-9)


class Refreshed:
    """Values that are used until their next refresh, made once and shared by threads.

    A value must be a pure function of its key, so that it does not matter which thread makes it, nor how often.
    """

    def __init__(self, keep: int = 16) -> None:
        self._keep = keep
        self._lock = Lock()
        self._made: dict[Hashable, Future[Any]] = {}

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return the value of ``key``; ``make()`` is called unless it exists or another thread is making it."""
        with self._lock:
            known = self._made.get(key)
            if known is None:
                known = self._made[key] = Future()
                mine = known
                while len(self._made) > self._keep:
                    del self._made[next(iter(self._made))]
            else:
                mine = None
        if mine is not None:
            try:
                mine.set_result(make())
            except BaseException as error:
                mine.set_exception(error)
                with self._lock:
                    self._made.pop(key, None)
                raise
        return known.result()


def _ask_mujoco(view: ContextView, sampler: SceneSampler, rotation: Array, position: Array, met: Met) -> None:
    """Replace the results of rays near meshes, height fields and the like by those of MuJoCo's exact ray caster."""
    asked = view.grid.rays[met.other]
    n = len(asked)
    if n == 0:
        return
    groups = np.ones(6, dtype=np.uint8)
    groups[[MARKER_GROUP, UNSEEN_GROUP]] = 0
    ids, far, facing = np.full(n, -1, dtype=np.int32), np.zeros(n), np.zeros((n, 3))
    rays = np.ascontiguousarray(asked @ rotation.T)
    mujoco.mj_multiRay(
        sampler.scene.model, sampler.data, np.ascontiguousarray(position), rays.reshape(-1), groups, 1, -1, ids, far,
        facing.reshape(-1), n, mujoco.mjMAXVAL,
    )  # fmt: skip
    hit = ids >= 0
    met.geom[met.other] = np.where(hit, view.row_of[ids], -1)
    met.distance[met.other] = np.where(hit, far, np.inf)
    met.normal[met.other] = facing @ rotation


def _rgba(model: mujoco.MjModel, geom: int) -> Array:
    """The colour that MuJoCo's viewer gives a geom: its own, or its material's where it has none of its own."""
    own = model.geom_rgba[geom]
    material = model.geom_matid[geom]
    if material >= 0 and tuple(own) == _MUJOCO_DEFAULT_RGBA:
        return np.asarray(model.mat_rgba[material])
    return np.asarray(own)
