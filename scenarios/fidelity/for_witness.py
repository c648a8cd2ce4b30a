"""A scenario rendered by the Mitsuba witness: ``python -m scenarios.fidelity.for_witness SCENARIO --out DIR``.

Written into DIR are a scene file of the witness, the rig (OpenCV's lens, fitted to the scenario's), the markers'
paths and, where something may hide markers, its surface as a mesh; then ``witness.mitsuba`` renders them. What a
scenario has by default of blur, shake, jitter and model gap is left out: the witness's cameras are its own, and its
markers are retroreflective under ring lights. What the scenario says and cannot be rendered is refused.
"""

import argparse
import csv
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh

from mosca.camera.projection import convert_lens
from mosca.data.arrays import Array
from mosca.data.files.rig_file import write_rig
from mosca.data.files.whole_file import write_text
from mosca.data.rig import Camera, MoscaLens, OpenCVLens, Rig, principal_distances_px
from mosca.errors import MoscaError
from scenarios.build.cameras import true_rig, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.spec.catalog import find
from scenarios.spec.scenario import Scenario, load_scenario
from twin.cameras.render.occluders import BOX, CAPSULE, CYLINDER, ELLIPSOID, MESH, SPHERE, occluders_of
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.emission import Glow
from twin.scenes.scene import Scene
from witness.mitsuba.__main__ import main as render
from witness.mitsuba.scene import FIRST_MID_S, Limb
from witness.mitsuba.surfaces import limb_mesh

CARRIED = {
    "errors": {"marker_signal", "full_well_e", "read_noise_e", "background_e", "bits"},
    "optics": {"lens", "focus_m", "f_number"},
    "sensor": {"name", "quantum_efficiency", "black_dn", "dsnu_e", "prnu", "hot_pixels", "hot_e"},
    "timing": set[str](),
    "mount": set[str](),
    "delivery": set[str](),
    "surroundings": set[str](),
    "glow": {"kind", "half_deg", "at_m", "even_deg", "ring_m", "lobe_deg", "lamp_half_deg"},
}
"""Keys that the witness renders or replaces by a law of its own; other keys of these tables are refused."""
TABLES = ("lamps", "fault", "continuous", "camera")
"""Tables that are refused as a whole."""
MOST_LENS_PX = 0.05
"""Largest difference of OpenCV's lens from the scenario's: about the misfit of a lens model in real images."""
STEP_S = 2e-3
"""Longest time between two positions of a marker; there are at least four in a frame period."""
SAMPLES = 4096
"""Samples of a pixel: the sensor's noise is smaller than in the witness's own scenes."""
CLOTH = 0.3
"""Reflectance of the surfaces that hide markers."""


def write_witness_scene(spec: Scenario, folder: Path, file: Path, samples: int = SAMPLES) -> None:
    """Write ``file``, a scene of the witness, and the files that it names; ``folder``: that of the scenario's files.

    ``samples``: those of a pixel at markers' edges, a power of two. ValueError names keys that the witness cannot
    render.
    """
    if samples.bit_count() != 1:
        raise ValueError(f"{samples} samples a pixel given; a power of two is wanted, {SAMPLES} by default")
    scene = build_scene(spec, folder)
    refused = _refused(spec, scene)
    if refused:
        raise ValueError(f"the witness cannot render {', '.join(refused)}")
    rig = true_rig(spec, folder)
    camera = virtual_cameras(spec, rig)[0]
    own, off_px = _opencv(rig)
    if off_px > MOST_LENS_PX:
        raise ValueError(f"the witness cannot render these lenses: OpenCV's is {off_px:.2g} px off")
    rigs, tracks, mesh = (file.with_name(f"{file.stem}_{name}") for name in ("rig.toml", "tracks.csv", "mesh.npz"))
    file.parent.mkdir(parents=True, exist_ok=True)
    write_rig(own, rigs)
    _write_tracks(spec, scene, tracks)
    lines = [
        f'title = "{spec.title}"',
        f"# OpenCV's lenses are {off_px:.4f} px off the scenario's at most, its shear left out",
        f'rig = "{rigs.name}"',
        f"frames = {spec.capture.pulses}\nrate_hz = {spec.capture.frame_rate_hz}",
        f"exposure_s = {spec.capture.exposure_s}\nseed = {spec.seed}",
        *_table("cameras", _aperture(camera)),
        *_table("sensor", _sensor(camera.sensor, camera.marker_signal)),
        *_table("tracks", {"file": tracks.name}),
        *_table("quality", {"window_samples": samples}),
    ]
    if _write_mesh(spec, scene, mesh):
        lines += _table("mesh", {"file": mesh.name, "reflectance": CLOTH})
    write_text(file, "\n".join(lines) + "\n")


def _table(name: str, values: dict[str, Any]) -> list[str]:
    return [f"[{name}]", *(f"{key} = {value!r}" for key, value in values.items())]


def _refused(spec: Scenario, scene: Scene) -> list[str]:
    found = [f"[{name}]" for name in TABLES if getattr(spec, name)]
    for name, carried in CARRIED.items():
        table = getattr(spec, name)
        for key in sorted((table.model_fields_set if table else set()) - carried):
            value = getattr(table, key)
            if value and value != type(table).model_fields[key].default:
                found.append(f"{name}.{key}")
    kind = spec.scene.kind
    if scene.figures:
        found.append(f"scene.kind = '{kind}': printed targets")
    glows = {scene.glows.get(name, Glow()).kind for name in scene.marker_names if name not in scene.figures}
    found += [f"markers of kind '{glow}'" for glow in sorted(glows - {"plain", "retro"})]
    return found


def _opencv(rig: Rig) -> tuple[Rig, float]:
    """Return the rig with OpenCV's lenses of five coefficients, and their largest error [px].

    Shear, the paper's affinity, is left out, since OpenCV's lens has none.
    """
    made, off = [], 0.0
    for camera in rig.cameras:
        lens = replace(camera.lens, a=0.0) if isinstance(camera.lens, MoscaLens) else camera.lens
        fit = convert_lens(lens, "opencv", camera.width, camera.height)
        assert isinstance(fit.lens, OpenCVLens)
        made.append(Camera(camera.name, camera.width, camera.height, fit.lens, camera.world_from_camera))
        off = max(off, fit.max_px)
    return Rig(tuple(made)), off


def _aperture(camera: VirtualCamera) -> dict[str, float]:
    """Return the thin lens whose blur circles are those of the scenario's optics."""
    optics = camera.optics
    if optics.focus_m is None:
        return {}
    f_m, focal_px = optics.f_mm * 1e-3, principal_distances_px(camera.camera.lens)[0]
    # the twin's blur: f^2 / N (d - s) / (d (s - f)) over the pitch; the witness's: focal_px aperture (1 / s - 1 / d)
    blur = f_m**2 / optics.f_number / (optics.pixel_pitch_mm * 1e-3) / (optics.focus_m - f_m)
    return {"aperture_m": blur * optics.focus_m / focal_px, "focus_m": optics.focus_m}


def _sensor(sensor: Sensor, marker_signal: float) -> dict[str, float]:
    """Return the witness's sensor; a marker's brightest pixels get the scenario's marker signal."""
    peak_e, k8 = marker_signal * sensor.full_well_e, sensor.gain_dn_per_e / 2.0 ** (sensor.bits - 8)
    return {
        "bits": sensor.bits,
        "peak_e": peak_e,
        "peak_dn": k8 * peak_e,
        "read_dn": k8 * sensor.read_noise_e,
        "black_dn": sensor.black_dn,
        "stray_e": sensor.background_e,
        "prnu": sensor.prnu,
        "dsnu_dn": k8 * sensor.dsnu_e,
        "hot_share": sensor.hot_pixels,
        "hot_e": 2 * sensor.hot_e,  # evenly spread from 0 in the witness: the same mean
        "full_well_e": sensor.full_well_e,
    }


def _write_tracks(spec: Scenario, scene: Scene, file: Path) -> None:
    """Write the paths of the markers; the middle of the first exposure is at FIRST_MID_S."""
    capture, sampler = spec.capture, scene.sampler()
    step = min(STEP_S, 0.25 / capture.frame_rate_hz)
    last = (capture.pulses - 1) / capture.frame_rate_hz + capture.exposure_s
    times = -step + step * np.arange(int(np.ceil(last / step)) + 3)
    states = [sampler.at(float(t)) for t in times]
    model = scene.model
    with file.open("w", newline="", encoding="utf-8") as out:
        table = csv.writer(out, lineterminator="\n")
        table.writerow(["label", "time_ns", "x", "y", "z", "diameter_m", "nx", "ny", "nz"])
        for m, (name, geom) in enumerate(zip(scene.marker_names, scene.marker_geoms, strict=True)):
            flat = model.geom_type[geom] != SPHERE
            for t, state in zip(times, states, strict=True):
                time_ns = round((t + FIRST_MID_S - capture.exposure_s / 2) * 1e9)
                place = [f"{x:.12f}" for x in state.marker_xyz[m]]
                normal = [f"{x:.12f}" for x in state.marker_axis[m]] if flat else ["", "", ""]
                table.writerow([name, time_ns, *place, repr(float(2 * model.geom_size[geom, 0])), *normal])


def _write_mesh(spec: Scenario, scene: Scene, file: Path) -> bool:
    """Write the surface of geoms that may hide markers, at each mid-exposure; return False where there are none."""
    may_hide = occluders_of(scene)
    geoms = [*may_hide.geom[may_hide.marker < 0], *may_hide.mesh_geom]
    if not geoms:
        return False
    shapes, sampler, capture = [_surface(scene.model, int(g)) for g in geoms], scene.sampler(), spec.capture
    frames = []
    for pulse in range(capture.pulses):
        state = sampler.at(pulse / capture.frame_rate_hz + capture.exposure_s / 2)
        frames.append(
            np.concatenate(
                [v @ state.geom_rotation[g].T + state.geom_xyz[g] for g, (v, _) in zip(geoms, shapes, strict=True)]
            )
        )
    first = np.cumsum([0, *(len(v) for v, _ in shapes)])
    faces = np.concatenate([f + at for at, (_, f) in zip(first, shapes, strict=False)])
    np.savez_compressed(file, vertices=np.array(frames), faces=faces)
    return True


def _surface(model: mujoco.MjModel, geom: int) -> tuple[Array, Array]:
    """Return vertices (n, 3) in the geom's frame [m] and faces (m, 3)."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == CAPSULE:
        half = float(size[1])
        return limb_mesh(Limb((0.0, 0.0, -half), (0.0, 0.0, half), 2 * float(size[0]), CLOTH))
    if kind == MESH:
        k = int(model.geom_dataid[geom])
        v, f = model.mesh_vertadr[k], model.mesh_faceadr[k]
        return model.mesh_vert[v : v + model.mesh_vertnum[k]], model.mesh_face[f : f + model.mesh_facenum[k]]
    if kind == BOX:
        made = trimesh.creation.box(extents=2 * size)
    elif kind == CYLINDER:
        made = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=48)
    else:
        made = trimesh.creation.icosphere(subdivisions=4)
        made.apply_scale(size if kind == ELLIPSOID else size[0])
    return np.asarray(made.vertices), np.asarray(made.faces)


def main(arguments: list[str] | None = None) -> int:
    """Write a scenario's scene and render it; return 2 where that is impossible."""
    parser = argparse.ArgumentParser(prog="python -m scenarios.fidelity.for_witness", description=__doc__)
    parser.add_argument("scenario", help="file or name of a built-in scenario")
    parser.add_argument(
        "--out", required=True, type=Path, help="folder for the scene; the recording is a folder in it"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="capture.duration_s=0.1")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="a pixel at markers' edges, a power of two")
    parser.add_argument("--scene-only", action="store_true", help="write the scene, render nothing")
    given = parser.parse_args(arguments)
    try:
        path = find(given.scenario)
        file = given.out / f"{path.stem}.toml"
        write_witness_scene(load_scenario(path, tuple(given.set)), path.parent, file, given.samples)
    except (MoscaError, OSError, ValueError) as error:
        print(f"error: {given.scenario}: {error}", file=sys.stderr)
        return 2
    return 0 if given.scene_only else render([str(file), "--out", str(given.out)])


if __name__ == "__main__":
    sys.exit(main())
