"""The twin compared with OpenGL: MuJoCo's own renderer and pyrender, where the machine has them."""

import ctypes.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.rig import OpenCVLens
from reports.fidelity import Check, Row
from scenarios.fidelity.measure import centroids_apart
from scenarios.fidelity.twin_adapter import Target, ball, disc, seen_by_twin
from scenarios.fidelity.views import small_camera
from twin.cameras.render.occluders import occluders_of
from twin.scenes.scene import Scene
from witness import gl
from witness.image import contour_image
from witness.rays import World, fixed, seen_over_time
from witness.render import area_and_centroid, ball_outline, disc_outline, image_centroid

SIGMA, SIZE = 0.6, (gl.WIDTH, gl.HEIGHT)
LENS, WITNESS = small_camera(SIZE, gl.FOCAL_PX)
FREE_PX, HIDDEN_PX, PIXEL = 0.003, 0.01, 0.008
"""Bars: about twice the peers' own errors; a nearly hidden marker has only a few fine pixels in their images."""
HIDDEN = [0, 4]
"""Indices of the partly hidden markers: balls first, then discs."""
NO_GL = "no system OpenGL here: on Debian install libegl1, libopengl0 and libgl1-mesa-dri, or libosmesa6"


def mujoco_renderer(quick: bool) -> Check:
    """Compare with MuJoCo's renderer."""
    return _beside("mujoco", "mujoco.Renderer", quick)


def pyrender_renderer(quick: bool) -> Check:
    """Compare with pyrender."""
    return _beside("pyrender", "pyrender", quick)


def platform() -> str | None:
    """Return the GL platform that this machine offers, or None."""
    if ctypes.util.find_library("EGL"):
        return "egl"
    return "osmesa" if ctypes.util.find_library("OSMesa") else None


def _beside(name: str, shown: str, quick: bool) -> Check:
    title, compared = (
        f"Beside {shown}",
        "centre of light, and every pixel, of three balls and two discs, two partly hidden",
    )
    witness = f"{shown}, {gl.FINE} x {gl.FINE} fine pixels a pixel, behind the same blur"
    where = platform()
    if quick or where is None:
        return Check(title, compared, witness, "", (), NO_GL if where is None else "left out by --quick")
    peer, complaint = _peer_image(name, where)
    if peer is None:
        return Check(title, compared, witness, "", (), f"{shown} does not run here: {complaint}")
    image = _twin_image(LENS)
    own, off = np.zeros((5, 2)), np.zeros((5, 2))  # centroid [px] and pixels of each marker
    for number, outline in enumerate(_outlines()):
        part = _around(outline)
        exact, centroid = contour_image(outline, SIGMA, *SIZE), area_and_centroid(outline)[1]
        if number in HIDDEN:
            rays = seen_over_time(_hidden_world(number), WITNESS, SIZE, SIGMA, lines_per_px=48)
            exact, centroid = rays.image, rays.centroid
        corner = [part[1].start, part[0].start]
        own[number] = (np.hypot(*(image_centroid(peer[part]) + corner - centroid)), np.abs(peer - exact)[part].max())
        off[number] = centroids_apart(image[part], peer[part]), np.abs(image - peer)[part].max()
    free = [number for number in range(len(off)) if number not in HIDDEN]
    half = _twin_image(OpenCVLens(gl.FOCAL_PX, gl.FOCAL_PX, gl.WIDTH / 2, gl.HEIGHT / 2))
    faults = {
        "GL's half pixel forgotten": np.abs(half - peer).max(),
        "y the wrong way up": np.abs(image[::-1] - peer).max(),
    }
    rows = [
        Row("in view: centroid, largest", float(off[free, 0].max()), "px", FREE_PX),
        Row("partly hidden: centroid, largest", float(off[HIDDEN, 0].max()), "px", HIDDEN_PX),
        Row("pixels, largest", float(off[:, 1].max()), "of full", PIXEL),
        *[Row(f"fault: {what}: pixels", float(off), "of full", PIXEL, control=True) for what, off in faults.items()],
    ]
    own_error = (
        f"{own[free, 0].max():.1e} px in view, {own[HIDDEN, 0].max():.1e} px partly hidden, {own[:, 1].max():.1e} of "
        "a full pixel (against exact outlines and the ray caster)"
    )
    return Check(title, compared, witness, own_error.replace("e-0", "e-"), tuple(rows))


def _peer_image(name: str, where: str) -> tuple[Array | None, str]:
    """Return the peer's image (H, W), or None and its last line of output."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "fine.npy"
        done = subprocess.run(
            [sys.executable, str(Path(gl.__file__)), name, str(out)],
            env={**os.environ, "MUJOCO_GL": where, "PYOPENGL_PLATFORM": where},
            capture_output=True,
            text=True,
            timeout=120,
        )
        if done.returncode != 0:
            return None, (done.stderr.strip().splitlines() or ["no message"])[-1]
        return gl.to_pixels(np.load(out), SIGMA), ""


def _targets() -> list[Target]:
    balls = [ball(np.array(centre), radius) for centre, radius in gl.BALLS]
    return balls + [disc(np.array(centre), np.array(normal), radius) for centre, normal, radius in gl.DISCS]


def _outlines() -> list[Array]:
    balls = [ball_outline(np.array(centre), radius) for centre, radius in gl.BALLS]
    discs = [disc_outline(np.array(centre), np.array(normal), radius) for centre, normal, radius in gl.DISCS]
    return [WITNESS.project(outline) for outline in balls + discs]


def _twin_image(lens: OpenCVLens) -> Array:
    """Return the twin's image of the same scene."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=gl.BOX[1], pos=gl.BOX[0])
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[*gl.CAPSULE[1:], 0], pos=gl.CAPSULE[0], euler=[90.0, 0.0, 0.0]
    )
    scene = Scene(spec.compile(), (), (), lambda t: np.zeros(0), 1.0)
    state, solid = scene.sampler().at(0.0), occluders_of(scene)
    return seen_by_twin(
        lens,
        SIZE,
        _targets(),
        occluders=solid,
        geoms_at=lambda t: (state.geom_xyz[solid.geom], state.geom_rotation[solid.geom]),
    )[0]


def _hidden_world(number: int) -> World:
    """Return the ray caster's inputs for a partly hidden marker."""
    if number == 0:
        centre, radius = gl.BALLS[0]
        return World(fixed(np.array(centre)), radius).add(mujoco.mjtGeom.mjGEOM_BOX, gl.BOX[1], fixed(gl.BOX[0]))
    centre, normal, radius = gl.DISCS[1]
    world = World(fixed(np.array(centre)), radius, np.array(normal) / np.linalg.norm(normal))
    along_y = fixed(Rotation.from_euler("x", 90, degrees=True).as_matrix())
    return world.add(mujoco.mjtGeom.mjGEOM_CAPSULE, [*gl.CAPSULE[1:], 0], fixed(gl.CAPSULE[0]), along_y)


def _around(outline: Array) -> tuple[slice, slice]:
    """Return the pixels about an outline (n, 2) [px], which have no light of another marker."""
    low, high = outline.min(axis=0) - 5, outline.max(axis=0) + 6
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
