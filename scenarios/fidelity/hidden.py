"""Occlusion of a marker: visible share and centroid against MuJoCo's ray caster on scan lines."""

from typing import Any

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from reports.fidelity import Check, Row
from scenarios.fidelity.measure import about, rms
from scenarios.fidelity.twin_adapter import ELECTRONS, Target, seen_by_twin
from scenarios.fidelity.views import small_camera
from twin.cameras.render.mesh_occlusion import MeshRays
from twin.cameras.render.occluders import occluders_of
from twin.cameras.render.render import has_meshes
from twin.scenes.scene import Scene
from witness.rays import MARKER_GROUP, POSITION, ROTATION, Path, World, fixed, seen_over_time
from witness.render import image_centroid

SIZE, SIGMA, F_PX = (160, 120), 0.6, 300.0
LENS, WITNESS = small_camera(SIZE, F_PX, (-0.2, 0.06, 5e-4, -4e-4))
SHARE, CENTROID_PX = 0.002, 0.004
"""Bars for the visible share, and for the centroid [px rms] where at least 0.3 of the marker is visible."""
AT, RADIUS, NEAR = np.array([0.06, -0.04, 1.5]), 0.02, 0.9
"""Position and radius of the marker (8 px in the image), and depth of its occluders [m]."""
TURN = Rotation.from_euler("xyz", [40.0, 28.0, 25.0], degrees=True).as_matrix()
GEOM = mujoco.mjtGeom
SOLIDS = {
    "sphere": (GEOM.mjGEOM_SPHERE, (0.045, 0.0, 0.0)),
    "capsule": (GEOM.mjGEOM_CAPSULE, (0.03, 0.07, 0.0)),
    "ellipsoid": (GEOM.mjGEOM_ELLIPSOID, (0.03, 0.05, 0.08)),
    "cylinder": (GEOM.mjGEOM_CYLINDER, (0.035, 0.05, 0.0)),
    "box": (GEOM.mjGEOM_BOX, (0.03, 0.05, 0.07)),
}
MESHES = {
    "mesh ball": trimesh.creation.icosphere(subdivisions=2, radius=0.045),
    "mesh torus": trimesh.creation.torus(major_radius=0.06, minor_radius=0.02, major_sections=24, minor_sections=12),
}
SWEEP_PX = (24.0, 21.0, 18.0, 15.0, 12.0)
INSTANTS = 16


def occlusion(quick: bool) -> Check:
    """Check occlusion by each solid, in steps from beside the marker to before it, at rest and moving."""
    rows: list[Row] = []
    sweep = SWEEP_PX[1:4:2] if quick else SWEEP_PX
    for name in [*SOLIDS, *MESHES]:
        found = np.array([_compared(_still(name, offset)) for offset in sweep])
        rows += _rows(f"{name} stands before it", found)
    moves = ((6.0, 2.0),) if quick else ((6.0, 2.0), (-5.0, 3.0))
    for name in ("capsule", "mesh ball") if quick else ("capsule", "box", "mesh ball"):
        found = np.array([_compared(_moving(name, px), INSTANTS) for px in moves])
        rows += _rows(f"{name} and marker move", found)
    where = _still("box", 18.0)
    shares = [seen_over_time(where, WITNESS, SIZE, SIGMA, lines_per_px=n).share for n in (24, 48)]
    return Check(
        "What hides a marker",
        "visible share of an 8 px marker, and the centre of light of its visible part",
        "MuJoCo's ray caster (mj_multiRay) along 24 scan lines a pixel, edges found by bisection",
        about(abs(shares[0] - shares[1]), "of the share"),
        (*rows, *_faults()),
    )


def _rows(name: str, found: Array) -> list[Row]:
    """Return the rows of the result of ``_compared``; its first column is the visible share."""
    clear = found[:, 0] >= 0.3
    rows = [Row(f"{name}: share, largest", float(np.abs(found[:, 1]).max()), "", SHARE)]
    if clear.any():
        rows.append(Row(f"{name}: centroid, rms", rms(found[clear, 2]), "px", CENTROID_PX))
    return rows


def beside(offset_px: float, depth_m: float = NEAR, angle_rad: float = 0.35) -> Array:
    """Return a point [m] whose image is ``offset_px`` from that of the marker."""
    away = offset_px * depth_m / F_PX * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    return np.array([*(AT[:2] / AT[2] * depth_m + away), depth_m])


def _still(name: str, offset_px: float) -> World:
    return put(World(fixed(AT), RADIUS), name, fixed(beside(offset_px)))


def _moving(name: str, solid_px: tuple[float, float]) -> World:
    return put(World(moving(AT, (3.0, -3.0)), RADIUS), name, moving(beside(17.0), solid_px))


def moving(middle: Array, px: tuple[float, float]) -> Path:
    """Return a path through ``middle`` half way in the exposure, ``px`` long in the image."""
    step = np.array([*px, 0.0]) * middle[2] / F_PX
    return lambda t: middle + step * (t - 0.5)


def put(world: World, name: str, at: Path, turn: Path | None = None) -> World:
    """Add an occluder by its name, at a fixed rotation unless ``turn`` is given."""
    turn = fixed(TURN) if turn is None else turn
    if name in MESHES:
        return world.add_mesh(MESHES[name], at, turn)
    return world.add(*SOLIDS[name], at, turn)


def _compared(world: World, instants: int = 1) -> tuple[float, float, float]:
    """Return the witness's visible share, the twin's minus that, and the distance of the centroids [px]."""
    image, visible = seen_in(world)
    rays = seen_over_time(world, WITNESS, SIZE, SIGMA, instants, 1.0, 24 if instants == 1 else 16)
    off = float(np.hypot(*(image_centroid(image) - rays.centroid))) if rays.share >= 0.3 else 0.0
    return rays.share, visible - rays.share, off


def seen_in(world: World) -> tuple[Array, float]:
    """Return the twin's image of the marker (geom 0) and its visible share by the twin; other markers are dark."""
    model, data = world.compile()
    geoms = tuple(int(g) for g in np.flatnonzero(model.geom_group == MARKER_GROUP))
    scene = Scene(model, tuple(f"m{g}" for g in geoms), geoms, lambda t: np.zeros(0), 1.0)
    occluders = occluders_of(scene)

    def geoms_at(t: float) -> tuple[Array, Array]:
        world.move(model, data, t)
        turns = data.geom_xmat.reshape(-1, 3, 3)[occluders.geom]
        return (data.geom_xpos[occluders.geom] - POSITION) @ ROTATION, ROTATION.T @ turns

    more: dict[str, Any] = {"occluders": occluders, "geoms_at": geoms_at}
    if has_meshes(occluders):
        _model, there = world.compile()

        def state_at(t: float) -> tuple[mujoco.MjData, Array, Array]:
            world.move(model, there, t)
            return there, ROTATION, POSITION

        more["mesh_rays"] = MeshRays(model, state_at, 0.5, occluders, geoms)
    targets = []
    for g in geoms:
        at, turn = world.paths[int(model.geom(g).name[1:])]
        light = ELECTRONS if g == 0 else 0.0
        targets.append(Target(at, model.geom_size[g, 0], turn, g == 0 and world.flat, electrons=light))
    image, seen = seen_by_twin(LENS, SIZE, targets, **more)
    return image, float(seen.visible[0])


def _faults() -> list[Row]:
    """Return the errors of the share of a twin whose world differs slightly from that of the witness."""
    still = seen_over_time(_still("box", 18.0), WITNESS, SIZE, SIGMA).share
    in_motion = seen_over_time(_moving("box", (6.0, 2.0)), WITNESS, SIZE, SIGMA, INSTANTS, 1.0, 16).share
    stopped = put(World(fixed(AT), RADIUS), "box", moving(beside(17.0), (6.0, 2.0)))
    early = put(World(moving(AT, (3.0, -3.0)), RADIUS), "box", fixed(moving(beside(17.0), (6.0, 2.0))(0.0)))
    faults = {
        "an edge off by a tenth of a pixel": seen_in(_still("box", 17.9))[1] - still,
        "a marker that stands still": seen_in(stopped)[1] - in_motion,
        "an occluder judged at the exposure's start": seen_in(early)[1] - in_motion,
    }
    return [Row(f"fault: {name}", abs(off), "", SHARE, control=True) for name, off in faults.items()]
