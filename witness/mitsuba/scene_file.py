"""Scene files: TOML tables that this module turns into a ``WitnessScene``.

::

    frames = 30
    rate_hz = 100.0
    exposure_s = 0.0002
    finish = "retro"                         # of balls and discs; or "lambert"
    seed = 3
    [cameras]                                # on a circle; the same rig for the same table
    radius_m = 3.2
    heights_m = [1.8, 2.6, 2.0, 2.8]
    focal_px = 640.0
    rig = "rig.toml"                         # instead: a recording's rig; [cameras] has aperture_m and focus_m then
    [cloud]                                  # any of these: cloud, wand, l_frame, board, field, mesh, limb, tracks
    count = 40
    diameter_m = 0.1
    shape = "ball"                           # or "disc"
    half_size_m = [0.9, 0.9, 0.6]
    amplitude_m = 0.1
    speed_mps = 0.4
    [tracks]
    file = "tracks.csv"                      # markers at given times, see tracks.py
    [light] [room] [sensor] [quality]        # fields of the dataclasses of the same name

A key that is not known is an error.
"""

import hashlib
import tomllib
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from witness.mitsuba.projection import in_image, project
from witness.mitsuba.scene import (
    FIRST_MID_S,
    Array,
    Bar,
    Body,
    Chessboard,
    CodedPlate,
    LensCamera,
    Limb,
    MarkerBall,
    MarkerDisc,
    Mesh,
    Part,
    Quality,
    Room,
    SceneLamps,
    SensorValues,
    Swing,
    WitnessScene,
    quaternion,
)
from witness.mitsuba.tracks import read_cameras, tracked

CAMERAS: dict[str, Any] = {
    "radius_m": 3.2,
    "heights_m": [1.8, 2.6, 2.0, 2.8],
    "azimuths_deg": [20.0, 110.0, 200.0, 290.0],
    "look_at_m": [0.0, 0.0, 0.0],
    "size": [656, 491],
    "focal_px": 640.0,
    "distortion": [-0.12, 0.08, 4e-4, -3e-4, -0.02],
    "aperture_m": 0.0,
    "focus_m": 3.8,
    "seed": 5,
}
CLOUD: dict[str, Any] = {
    "count": 40,
    "diameter_m": 0.1,
    "shape": "ball",
    "half_size_m": [0.9, 0.9, 0.6],
    "amplitude_m": 0.1,
    "speed_mps": 0.4,
    "gap_m": 0.03,
    "seen_by": 3,
}
CARRIED: dict[str, Any] = {
    "centre_m": [0.0, 0.0, 0.0],
    "amplitude_m": [0.0, 0.0, 0.0],
    "frequency_hz": [0.0, 0.0, 0.0],
    "phase_rad": [0.0, 0.0, 0.0],
    "base_wxyz": [1.0, 0.0, 0.0, 0.0],
    "turn_rad": [0.0, 0.0, 0.0],
    "turn_frequency_hz": [0.0, 0.0, 0.0],
    "turn_phase_rad": [0.0, 0.0, 0.0],
    "hold_s": 0.0,
}
TRIES = 200_000
ABOUT = {"lens": 0.02, "principal_px": 6.0, "k1": 0.02}
"""Differences of the cameras' lenses from the table, rms: relative focal length, principal point, k1."""


def read_scene(path: Path) -> WitnessScene:
    """Return the scene of a file; ValueError names file and key."""
    with path.open("rb") as file:
        table = tomllib.load(file)
    try:
        return scene_of(table, path.stem, path.parent)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def scene_of(table: dict[str, Any], name: str, folder: Path) -> WitnessScene:
    """Return the scene of tables; ``folder``: that of the files named in it."""
    table = dict(table)
    table.pop("title", None)
    cameras = _cameras_of(table, folder)
    made: dict[str, Any] = {
        key: kind(**_tuples(_known(table.pop(key, {}), kind, key)))
        for key, kind in (("light", SceneLamps), ("room", Room), ("sensor", SensorValues), ("quality", Quality))
    }
    frames, rate, seed = int(table.pop("frames")), float(table.pop("rate_hz")), int(table.pop("seed", 1))
    exposure, finish = float(table.pop("exposure_s")), table.pop("finish", "retro")
    if finish not in ("lambert", "retro"):
        raise ValueError(f"finish = {finish!r}; allowed: 'lambert', 'retro'")
    bodies: list[Body] = []
    if "cloud" in table:
        bodies += _cloud(_filled(table.pop("cloud"), CLOUD, "cloud"), cameras, frames, rate, seed)
    if "tracks" in table:
        given = dict(table.pop("tracks"))
        last_s = FIRST_MID_S + (frames - 1) / rate + exposure / 2
        bodies += tracked(folder / given.pop("file"), FIRST_MID_S - exposure / 2, last_s)
        if given:
            raise ValueError(f"[tracks]: unknown keys {sorted(given)}")
    for key, parts in (("wand", _wand), ("l_frame", _l_frame), ("board", _board), ("field", _field), ("mesh", _mesh)):
        if key in table:
            given = dict(table.pop(key))
            motion = Swing(**{k: _tuple(given.pop(k, CARRIED[k])) for k in CARRIED})
            bodies.append(Body(motion, tuple(parts(given, folder))))
            if given:
                raise ValueError(f"[{key}]: unknown keys {sorted(given)}")
    for number, given in enumerate(table.pop("limb", [])):
        limb = dict(given)
        motion = Swing(**{k: _tuple(limb.pop(k, CARRIED[k])) for k in CARRIED})
        bodies.append(Body(motion, tuple(_limb(limb, number))))
        if limb:
            raise ValueError(f"[[limb]]: unknown keys {sorted(limb)}")
    if table:
        raise ValueError(f"unknown keys {sorted(table)}")
    return WitnessScene(name, cameras, tuple(bodies), frames, rate, exposure, finish, seed=seed, **made)


def _cameras_of(table: dict[str, Any], folder: Path) -> tuple[LensCamera, ...]:
    """Return the cameras of ``table``, from which the keys ``cameras`` and ``rig`` are removed."""
    given, rig = table.pop("cameras", {}), table.pop("rig", None)
    if rig is None:
        return _cameras(_filled(given, CAMERAS, "cameras"))
    lens = {key: CAMERAS[key] for key in ("aperture_m", "focus_m")}
    return read_cameras(folder / rig, **_filled(given, lens, "cameras"))


def _cameras(table: dict[str, Any]) -> tuple[LensCamera, ...]:
    random = np.random.default_rng(table["seed"])
    look_at, made = np.array(table["look_at_m"]), []
    for k, (azimuth, height) in enumerate(zip(table["azimuths_deg"], table["heights_m"], strict=True)):
        angle = np.deg2rad(azimuth)
        place = look_at + [table["radius_m"] * np.cos(angle), table["radius_m"] * np.sin(angle), height]
        forward = (look_at - place) / np.linalg.norm(look_at - place)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.column_stack([right, np.cross(forward, right), forward])
        focal = table["focal_px"] * (1 + ABOUT["lens"] * random.standard_normal())
        principal = (np.array(table["size"]) - 1) / 2 + ABOUT["principal_px"] * random.standard_normal(2)
        k1, *rest = table["distortion"]
        distortion = (k1 + ABOUT["k1"] * random.standard_normal(), *rest)
        made.append(
            LensCamera(
                f"cam{k + 1}",
                tuple(table["size"]),
                (round(float(focal), 4), round(float(focal) * 1.001, 4)),
                tuple(np.round(principal, 4).tolist()),
                distortion,
                tuple(np.round(place, 6).tolist()),
                quaternion(rotation),
                table["aperture_m"],
                table["focus_m"],
            )
        )
    return tuple(made)


def _cloud(table: dict[str, Any], cameras: tuple[LensCamera, ...], frames: int, rate: float, seed: int) -> list[Body]:
    """Return markers at random positions that never meet and are always in the view of ``seen_by`` cameras."""
    random = np.random.default_rng([seed, 1])
    half, reach = np.array(table["half_size_m"]), float(table["amplitude_m"])
    apart = table["diameter_m"] + table["gap_m"]
    times = 0.1 + np.arange(frames) / rate
    bodies: list[Body] = []
    tracks: list[Array] = []
    for _ in range(TRIES):
        if len(bodies) == table["count"]:
            return bodies
        frequency = table["speed_mps"] / (2 * np.pi * max(reach, 1e-9)) / np.sqrt(1.5) * random.uniform(0.7, 1.3, 3)
        motion = Swing(
            _tuple((half * random.uniform(-1, 1, 3)).round(6)),
            (reach,) * 3,
            _tuple(frequency.round(6)),
            _tuple(random.uniform(0, 2 * np.pi, 3).round(6)),
        )
        track = np.array([motion.pose(t)[1] for t in times])
        if any(np.linalg.norm(track - other, axis=1).min() < apart for other in tracks):
            continue
        seen = sum(
            bool(in_image(c, project(c, track), 4 + c.focal_px[0] * table["diameter_m"] / 4).all()) for c in cameras
        )
        normal = np.array([*random.uniform(-0.35, 0.35, 2), 1.0])
        if seen >= table["seen_by"]:
            name, size = f"m{len(bodies) + 1:02d}", table["diameter_m"]
            part: Part = MarkerBall(name, (0.0, 0.0, 0.0), size)
            if table["shape"] == "disc":
                part = MarkerDisc(name, (0.0, 0.0, 0.0), _tuple(normal.round(6)), size)
            bodies.append(Body(motion, (part,)))
            tracks.append(track)
    raise ValueError(
        f"[cloud]: only {len(bodies)} of {table['count']} markers found a place; take fewer or smaller ones"
    )


def _wand(given: dict[str, Any], _: Path) -> list[Part]:
    along, size = given.pop("along_m"), given.pop("diameter_m")
    middle = (along[0] + along[-1]) / 2
    parts: list[Part] = [MarkerBall(f"wand/{k + 1}", (x - middle, 0.0, 0.0), size) for k, x in enumerate(along)]
    bar = given.pop("bar_m", 0.0)
    if bar:
        ends = [x - middle for x in along]
        parts += [Bar((a + size / 2, 0.0, 0.0), (b - size / 2, 0.0, 0.0), bar) for a, b in pairwise(ends)]
    return parts


def _limb(given: dict[str, Any], number: int) -> list[Part]:
    """Return a limb and the balls that lie on its side, spread by the golden angle."""
    start, end = np.array(given.pop("start_m")), np.array(given.pop("end_m"))
    thick, size = given.pop("diameter_m"), given.pop("ball_diameter_m")
    parts: list[Part] = [Limb(_tuple(start), _tuple(end), thick, given.pop("reflectance", 0.3))]
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    count = given.pop("balls")
    for k in range(count):
        turn = k * np.pi * (3 - np.sqrt(5)) + number
        out = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
        at = start + (end - start) * (k + 0.5) / count + out * (thick + size) / 2
        parts.append(MarkerBall(f"limb{number}/{k + 1}", _tuple(at.round(6)), size))
    return parts


def _l_frame(given: dict[str, Any], _: Path) -> list[Part]:
    size = given.pop("diameter_m")
    return [MarkerBall(one["name"], _tuple(one["position_m"]), size) for one in given.pop("marker")]


def _board(given: dict[str, Any], _: Path) -> list[Part]:
    return [Chessboard(given.pop("columns"), given.pop("rows"), given.pop("square_m"), given.pop("margin_m"))]


def _field(given: dict[str, Any], _: Path) -> list[Part]:
    radius = given.pop("dot_radius_m")
    return [
        CodedPlate(
            f"coded/{one['number']}",
            _tuple(one["position_m"]),
            _tuple(one.get("normal", (0.0, 0.0, 1.0))),
            _tuple(one.get("x_axis", (1.0, 0.0, 0.0))),
            radius,
            tuple(bit == "1" for bit in one["sectors"]),
        )
        for one in given.pop("target")
    ]


def _mesh(given: dict[str, Any], folder: Path) -> list[Part]:
    file = folder / given.pop("file")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return [Mesh(str(file), digest, given.pop("reflectance", 0.3))]


def _known(table: dict[str, Any], kind: Any, name: str) -> dict[str, Any]:
    unknown = set(table) - {f.name for f in fields(kind)}
    if unknown:
        raise ValueError(f"[{name}]: unknown keys {sorted(unknown)}")
    return table


def _filled(table: dict[str, Any], defaults: dict[str, Any], name: str) -> dict[str, Any]:
    unknown = set(table) - set(defaults)
    if unknown:
        raise ValueError(f"[{name}]: unknown keys {sorted(unknown)}; allowed: {sorted(defaults)}")
    return defaults | table


def _tuples(table: dict[str, Any]) -> dict[str, Any]:
    return {key: _tuple(value) if isinstance(value, list) else value for key, value in table.items()}


def _tuple(value: Any) -> Any:
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(_tuple(x) for x in value)
    return float(value) if isinstance(value, np.floating) else value
