"""The Mitsuba scene of one instant: shapes, surfaces and lamps as Mitsuba's own plugins.

The retroreflective surface is defined here, since Mitsuba has none. Its luminance coefficient for a lamp at
observation angle a and entrance angle b is ``exp(-(a / LOBE)^2)`` times a falloff with b, which is even up to
EVEN_RAD and ends at DARK_RAD: the form of the curves that makers of glass-bead tape print (angles as in ASTM E810).
"""

import glob
import math
import os
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from witness.mitsuba.scene import Array, Bar, Chessboard, CodedPlate, Limb, MarkerBall, MarkerDisc, Mesh, WitnessScene
from witness.mitsuba.textures import BLACK, PLATE_RADII, board_texture, coded_texture, grain

VARIANT = "llvm_ad_mono"
LOBE_RAD = math.radians(1.2)
EVEN_RAD, DARK_RAD = math.radians(50.0), math.radians(87.0)
RETRO_GAIN = 300.0
"""Brightness of retroreflective tape over a white Lambert surface, on its axis."""
LAMBERT = 0.8
RING_SIDES = 48
LIMB_SIDES = 48
BAR_GREY = 0.02
WALL_TEXELS = 1024
MARKER = "marker_"


LEAST_LLVM = 16
"""Oldest usable version. Older ones end the process: they cannot compile the minimum of two floats for Dr.Jit."""


def load_mitsuba() -> Any:
    """Return Mitsuba with its variant set, and the surfaces of this file registered.

    ImportError without it, or without an LLVM library; where several are installed, the newest is used unless
    DRJIT_LIBLLVM_PATH names one.
    """
    import mitsuba as mi

    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        found = {
            int(version[1]): path
            for folder in ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib")
            for path in glob.glob(f"{folder}/libLLVM*.so*")
            if (version := re.search(r"libLLVM(?:-|\.so\.)(\d+)", path))
        }
        if max(found, default=0) < LEAST_LLVM:
            raise ImportError(f"Mitsuba needs LLVM {LEAST_LLVM} or newer (Debian: apt install libllvm19)")
        os.environ["DRJIT_LIBLLVM_PATH"] = found[max(found)]
    mi.set_variant(VARIANT)
    _register_retro()
    return mi


@cache
def _register_retro() -> None:
    import drjit as dr
    import mitsuba as mi

    class Retro(mi.BSDF):  # type: ignore[misc, name-defined, unused-ignore]
        """Retroreflective surface; only ``eval`` is used, since no bounce starts at it."""

        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            cos_in, cos_out = mi.Frame3f.cos_theta(wo), mi.Frame3f.cos_theta(si.wi)
            angle = dr.norm(wo - si.wi)
            entrance = dr.safe_acos(cos_in)
            rise = dr.clip((DARK_RAD - entrance) / (DARK_RAD - EVEN_RAD), 0, 1)
            falloff = rise * rise * (3 - 2 * rise)
            value = LAMBERT / np.pi * RETRO_GAIN * dr.exp(-dr.square(angle / LOBE_RAD)) * falloff
            return mi.Spectrum(dr.select((cos_in > 0) & (cos_out > 0) & active, value, 0))

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return mi.Float(0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            return dr.zeros(mi.BSDFSample3f), mi.Spectrum(0)

        def traverse(self, callback: Any) -> None:
            pass

        def to_string(self) -> str:
            return "Retro[]"

    mi.register_bsdf("witness_retro", Retro)


def mitsuba_scene(scene: WitnessScene, t: float, frame: int, moving: bool = True) -> Any:
    """Return Mitsuba's scene at ``t``; shapes whose id begins with MARKER are balls and discs.

    ``moving = False``: the room and its lamps alone. ``frame`` selects a mesh's vertices.
    """
    mi = load_mitsuba()
    content: dict[str, Any] = {"type": "scene"}
    if scene.finish == "retro":
        content["skin"] = {"type": "witness_retro"}
    else:
        content["skin"] = _diffuse(LAMBERT)
    content["dark"] = {"type": "twosided", "bsdf": _diffuse(BAR_GREY)}
    content |= _lamps(mi, scene) | _room(mi, scene)
    for b, body in enumerate(scene.bodies if moving else ()):
        rotation, position = body.motion.pose(t)
        for p, part in enumerate(body.parts):
            key = f"{b}_{p}"
            if isinstance(part, MarkerBall):
                centre = [float(x) for x in position + rotation @ part.at_m]
                content[MARKER + key] = {
                    "type": "sphere",
                    "center": centre,
                    "radius": part.diameter_m / 2,
                    "bsdf": {"type": "ref", "id": "skin"},
                }
            elif isinstance(part, MarkerDisc):
                content[MARKER + key] = {
                    "type": "disk",
                    "to_world": _facing(
                        mi, position + rotation @ part.at_m, rotation @ part.normal, part.diameter_m / 2
                    ),
                    "bsdf": {"type": "ref", "id": "skin"},
                }
            elif isinstance(part, Bar):
                ends = [[float(x) for x in position + rotation @ end] for end in (part.start_m, part.end_m)]
                content["bar_" + key] = {
                    "type": "cylinder",
                    "p0": ends[0],
                    "p1": ends[1],
                    "radius": part.diameter_m / 2,
                    "bsdf": {"type": "ref", "id": "dark"},
                }
            else:
                content["surface_" + key] = _surface(mi, part, rotation, position, frame)
    return mi.load_dict(content)


def _surface(
    mi: Any, part: Chessboard | CodedPlate | Limb | Mesh, rotation: Array, position: Array, frame: int
) -> Any:
    if isinstance(part, Chessboard):
        x, y = (n * part.square_m / 2 + part.margin_m for n in (part.columns, part.rows))
        return _textured(mi, rotation @ np.diag([x, y, 1.0]), position, _board_image(part))
    if isinstance(part, Limb):
        vertices, faces = limb_mesh(part)
        return _mesh(mi, vertices @ rotation.T + position, faces, _diffuse(part.reflectance))
    if isinstance(part, CodedPlate):
        z = rotation @ (np.array(part.normal) / np.linalg.norm(part.normal))
        x = rotation @ np.array(part.x_axis)
        x = x - z * (x @ z)
        x /= np.linalg.norm(x)
        half = PLATE_RADII * part.dot_radius_m / 2
        axes = np.column_stack([x * half, np.cross(z, x) * half, z])
        return _textured(mi, axes, position + rotation @ part.at_m, _coded_image(part))
    data = _mesh_file(part.file)
    vertices = data["vertices"][frame] @ rotation.T + position
    return _mesh(mi, vertices, data["faces"], {"type": "twosided", "bsdf": _diffuse(part.reflectance)})


@cache
def _board_image(board: Chessboard) -> Array:
    return board_texture(board)


@cache
def _coded_image(target: CodedPlate) -> Array:
    return coded_texture(target)


@cache
def _mesh_file(file: str) -> dict[str, Array]:
    with np.load(Path(file)) as data:
        return {name: data[name] for name in ("vertices", "faces")}


def _textured(mi: Any, axes: Array, centre: Array, image: Array) -> dict[str, Any]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, centre
    # a bitmap's first row is at v = 0: the rectangle's lower edge
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(image[::-1, :, None], dtype=np.float32)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "clamp",
    }
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix),
        "bsdf": {"type": "diffuse", "reflectance": texture},
    }


def _lamps(mi: Any, scene: WitnessScene) -> dict[str, Any]:
    light, lamps = scene.light, {}
    if light.ring > 0:
        for camera in scene.cameras:
            angle = np.arange(RING_SIDES) * 2 * np.pi / RING_SIDES
            circle = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
            vertices = np.concatenate([circle * light.ring_inner_m, circle * light.ring_outer_m])
            vertices = vertices @ camera.rotation.T + camera.position_m
            side, n = np.arange(RING_SIDES), RING_SIDES
            after = (side + 1) % n
            faces = np.concatenate(
                [np.column_stack([side, side + n, after + n]), np.column_stack([side, after + n, after])]
            )
            lamps["ring_" + camera.name] = _mesh(mi, vertices, faces, _diffuse(0.0), light.ring)
    for k, (x, y, z, edge, radiance) in enumerate(light.panels):
        lamps[f"panel_{k}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([x, y, z]).rotate([1, 0, 0], 180).scale(edge / 2),
            "bsdf": _diffuse(0.0),
            "emitter": {"type": "area", "radiance": {"type": "uniform", "value": radiance}},
        }
    return lamps


def _room(mi: Any, scene: WitnessScene) -> dict[str, Any]:
    room, shapes = scene.room, {}
    half, low, high = room.half_width_m, room.floor_z_m, room.floor_z_m + room.height_m
    grain_texels = room.grain_m / (2 * half) * WALL_TEXELS
    if room.floor > 0:
        image = grain(room.floor, room.contrast, WALL_TEXELS, grain_texels, scene.seed + 11)
        shapes["floor"] = _textured(mi, np.diag([half, half, 1.0]), np.array([0.0, 0.0, low]), image)
    if room.walls > 0:
        for k in range(4):
            across, along = ((1, 0), (0, 1), (-1, 0), (0, -1))[k]
            axes = np.column_stack([[-along * half, across * half, 0], [0, 0, (high - low) / 2], [across, along, 0]])
            image = grain(room.walls, room.contrast, WALL_TEXELS, grain_texels, scene.seed + 20 + k)
            shapes[f"wall_{k}"] = _textured(
                mi, axes, np.array([-across * half, -along * half, (high + low) / 2]), image
            )
    return shapes


def _facing(mi: Any, centre: Array, normal: Array, radius: float) -> Any:
    z = normal / np.linalg.norm(normal)
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([x * radius, np.cross(z, x) * radius, z])
    matrix[:3, 3] = centre
    return mi.ScalarTransform4f(matrix)


def _mesh(mi: Any, vertices: Array, faces: Array, bsdf: dict[str, Any], radiance: float = 0.0) -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    if radiance > 0:
        props["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "uniform", "value": radiance}})
    mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=False, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    params["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    params.update()
    return mesh


def limb_mesh(limb: Limb) -> tuple[Array, Array]:
    """Return vertices (n, 3) in the body's frame and faces (m, 3) of a limb, seen from outside counter-clockwise."""
    start, end = np.array(limb.start_m), np.array(limb.end_m)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    radius, n = limb.diameter_m / 2, LIMB_SIDES
    # rings from pole to pole; the two middle ones are the ends of the cylinder
    latitude = np.linspace(-np.pi / 2, np.pi / 2, n // 2)
    centre = np.where(latitude[:, None] < 0, start, end) + radius * np.sin(latitude)[:, None] * axis
    turn = np.arange(n) * 2 * np.pi / n
    around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    vertices = centre[:, None] + radius * np.cos(latitude)[:, None, None] * around
    ring, k = np.meshgrid(np.arange(len(latitude) - 1), np.arange(n), indexing="ij")
    a, b = ring * n + k, ring * n + (k + 1) % n
    faces = np.stack([np.stack([a, b, b + n], -1), np.stack([a, b + n, a + n], -1)])
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def _diffuse(reflectance: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "uniform", "value": float(reflectance)}}


__all__ = ["BLACK", "MARKER", "load_mitsuba", "mitsuba_scene"]
