"""The scenario that simulates a planned rig: markers in its volume, obstacles, a calibration from images."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import tomli_w

from mosca.data.arrays import Array
from mosca.data.files.rig_file import write_rig
from mosca.data.files.whole_file import write_text
from scenarios.spec.plan import PlanFile
from scenarios.studies.plan.plan import Plan
from scenarios.studies.plan.room import bounding_box, normals_of, obstacles_of, points_in

RIG_FILE, SCENARIO_FILE, MODEL_FILE, MOTION_FILE = "rig.toml", "scenario.toml", "room.xml", "motion.csv"
FREE_MARKERS = 60
"""Number of markers without a subject: points of the volume."""
SWAY_M, SWAY_HZ = 0.03, 0.5
"""Amplitude and frequency of the free markers on each axis: at most 0.1 m/s."""
LEVELS = 4
"""Number of rings of markers on a subject."""
SPEED_MPS = 0.5
"""Speed of a subject on its way through the volume."""
FREE_RATE_HZ, SUBJECT_RATE_HZ = 60.0, 30.0
RESERVE = 1.25
"""Limit of position_rms over its prediction: a study of drawn rooms has the differences (docs/planner.md)."""
STEP_S = 0.02


@dataclass(frozen=True, eq=False)
class Subjects:
    """Markers and their motion in the scenario."""

    names: tuple[str, ...]
    at: Array
    """(m, 3) positions on the body [m]."""
    normals: Array
    """(m, 3); zero for markers that their own body does not hide."""
    times_s: Array
    path: Array
    """(t, 3) positions of the body [m]."""
    duration_s: float
    rate_hz: float


def write_scenario(plan: Plan, folder: Path) -> None:
    """Write rig, model, motion and scenario of the best plan into ``folder``."""
    spec = plan.spec
    write_rig(plan.best.rig, folder / RIG_FILE)
    subjects = subjects_of(spec)
    write_text(folder / MODEL_FILE, _model(spec, subjects))
    rows = ["time,x,y,z", *(f"{t:.3f},{x:.6f},{y:.6f},{z:.6f}" for t, (x, y, z) in zip(
        subjects.times_s, subjects.path, strict=True))]  # fmt: skip
    write_text(folder / MOTION_FILE, "\n".join(rows) + "\n")
    write_text(folder / SCENARIO_FILE, tomli_w.dumps(_document(plan, subjects)))


def subjects_of(spec: PlanFile) -> Subjects:
    """Return the markers: free ones that sway about points of the volume, or rings on a body that crosses it."""
    if spec.subject is None:
        points = points_in(spec, FREE_MARKERS, spec.seed + 2000)
        duration, times = 0.5, np.arange(-0.1, 0.7, STEP_S)
        phase = 2 * np.pi * SWAY_HZ * times[:, None] + np.array([0.0, 2.0, 4.0])
        names = tuple(f"m{k + 1}" for k in range(len(points)))
        return Subjects(
            names, points, np.zeros((len(points), 3)), times, SWAY_M * np.sin(phase), duration, FREE_RATE_HZ
        )
    radius = spec.subject.radius_m
    center, size = bounding_box(spec)
    normals = normals_of(spec)
    heights = center[2] + size[2] * ((np.arange(LEVELS) + 0.5) / LEVELS - 0.5)
    # a ball is seated on the surface: its centre is one radius in front of it
    reach = radius + spec.volume.marker_diameter_m / 2
    at = np.array([[*(reach * normal[:2]), height] for height in heights for normal in normals])
    stops = _stops(spec, reach)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(stops, axis=0), axis=1))])
    duration = max(0.5, float(length[-1]) / SPEED_MPS)
    times = np.arange(-0.1, duration + 0.2, STEP_S)
    along = np.clip(times / duration, 0, 1) * length[-1]
    path = np.column_stack([*(np.interp(along, length, stops[:, axis]) for axis in (0, 1)), np.zeros(len(times))])
    names = tuple(f"m{k + 1}" for k in range(len(at)))
    return Subjects(names, at, np.tile(normals, (LEVELS, 1)), times, path, duration, SUBJECT_RATE_HZ)


def _stops(spec: PlanFile, reach: float) -> Array:
    """Return the stops (s, 2) [m] of the subject's axis: corners of a Z in the volume, with its markers inside."""
    center, size = bounding_box(spec)
    half = np.maximum(size[:2] / 2 - reach, 0.0)
    return np.asarray(center[:2] + half * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]))


def _model(spec: PlanFile, subjects: Subjects) -> str:
    """Return the MuJoCo model: fixed obstacles, and a body with the markers on three slides."""
    root = ElementTree.Element("mujoco", model="plan")
    world = ElementTree.SubElement(root, "worldbody")
    for k, one in enumerate(obstacles_of(spec)):
        half = [edge / 2 for edge in one.size_m]
        sizes = half if one.kind == "box" else [half[0], half[2]]
        ElementTree.SubElement(
            world, "geom", name=f"obstacle{k + 1}", type=one.kind, pos=_text(one.center_m), size=_text(sizes),
            euler=_text((0, 0, one.yaw_deg)),
        )  # fmt: skip
    body = ElementTree.SubElement(world, "body", name="subject")
    for axis, direction in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1")):
        ElementTree.SubElement(body, "joint", name=axis, type="slide", axis=direction)
    if spec.subject is not None:
        center, size = bounding_box(spec)
        ElementTree.SubElement(
            body, "geom", name="trunk", type="cylinder", pos=_text((0, 0, center[2])),
            size=_text((spec.subject.radius_m, size[2] / 2)), mass="70",
        )  # fmt: skip
    for name, at in zip(subjects.names, subjects.at, strict=True):
        radius = _text([spec.volume.marker_diameter_m / 2])
        ElementTree.SubElement(body, "geom", name=name, type="sphere", pos=_text(at), size=radius, mass="0.001")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _document(plan: Plan, subjects: Subjects) -> dict[str, Any]:
    """Return the scenario file's content."""
    spec, best = plan.spec, plan.best
    center, size = bounding_box(spec)
    finite = best.predicted.sigma_m[np.isfinite(best.predicted.sigma_m)]
    images, calibration = spec.images, spec.calibration
    document: dict[str, Any] = {
        "title": f"The planned rig: {spec.title}",
        "description": "Written by mosca plan. Limit: the predicted rms error of a point, with a quarter in reserve.",
        "tier": "full",
        "seed": spec.seed,
        "working_space": {"center_m": center.tolist(), "size_m": (size + SLACK_M).tolist()},
        "capture": {"duration_s": round(subjects.duration_s, 3), "frame_rate_hz": subjects.rate_hz},
        "scene": {"kind": "own", "model": MODEL_FILE, "markers": "geoms:m*", "motion": MOTION_FILE},
        "cameras": {"rig": RIG_FILE},
        "errors": {
            "body_px": images.body_px,
            "psf_sigma_px": images.psf_sigma_px,
            "marker_signal": images.marker_signal,
            "background_e": images.background_e,
        },
        "calibration": calibration.model_dump(),
        "premises": {"marker_px": 1.0, "views": 1.0},
        "limits": {"position_rms": float(RESERVE * np.sqrt(np.mean(finite**2)))},
        "camera": [],
    }
    models = {one.model: one for one in spec.camera}
    for k, camera in enumerate(best.rig.cameras):
        option = plan.options[best.layout.option[k]]
        model = models[option.model]
        one: dict[str, Any] = {"name": camera.name}
        if model.sensor is not None:
            one["sensor"] = {"name": model.sensor}
        else:
            one["errors"] = model.model_dump(include={"full_well_e", "read_noise_e", "bits"})
        if option.f_number is not None:
            away = float(np.linalg.norm(camera.world_from_camera.translation - center))
            one["optics"] = {"f_number": option.f_number, "focus_m": away}
        document["camera"].append(one)
    return document


SLACK_M = 0.02
"""Margin of the scenario's working space around the volume: the scenario has its own check that cameras stand
outside, and markers' balls reach beyond their centres."""


def _text(values: Any) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)
