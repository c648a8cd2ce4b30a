"""A recording folder of a rendered scene, in files of common formats: images, times, rig, truth.

``cam1/000000.png`` ..., ``frames.csv`` (frame, camera, time_ns of the exposure's start, exposure_ns, status),
``rig.toml`` (OpenCV lenses and poses), ``truth.csv`` (label, time_ns of mid-exposure, x, y, z), ``target.toml`` where
the scene has a calibration target, ``witness.npz`` (its keys are in ``README.md`` beside it).
"""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from witness.mitsuba.cramer_rao import image_bounds, point_bounds, render_noise_share, scale_e
from witness.mitsuba.film import Film, Render, markers
from witness.mitsuba.projection import project
from witness.mitsuba.scene import Array, Chessboard, CodedPlate, LensCamera, MarkerBall, WitnessScene
from witness.mitsuba.sensor import VirtualSensor

KEYS = {
    "names": "(M) names of balls and discs",
    "diameter_m": "(M)",
    "time_ns": "(F) mid-exposure",
    "xyz": "(F, M, 3) centres at mid-exposure [m]",
    "mean_xyz": "(F, M, 3) centres averaged over the exposure [m]",
    "normal": "(F, M, 3) of discs; 0 for balls",
    "centre_px": "(F, C, M, 2) pinhole projection of mean_xyz through the lens [px]",
    "light_px": "(F, C, M, 2) place of light: centroid of the target's noise-free light above its background [px]",
    "area_px2": "(F, C, M) of the target's image",
    "peak_e": "(F, C, M) brightest pixel of the target's window, photoelectrons without noise",
    "visible": "(F, C, M) share of its disc that is not hidden and lies in the image",
    "bound_px2": "(F, C, M, 2, 2) Cramer-Rao bound of the image's place: size and shape known, amplitude and "
    "background not; temporal noise of photons, dark signal, rounding; NaN near another target, an edge, an obstacle",
    "bound_m2": "(F, M, 3, 3) the same of points, through the true rig, from two such images or more",
    "render_noise_px": "(F, C, M, 2) one draw of the rendering's own error of the place",
    "render_noise_share": "by how much that raises the places' rms over the bound",
    "e_per_radiance": "photoelectrons per unit of the render",
    "gain_dn_per_e": "counts of a photoelectron",
    "body_rotation": "(F, B, 3, 3) world_from_body at mid-exposure",
    "body_position": "(F, B, 3) [m]",
    "cameras": "(C) names",
    "draw": "number of the draw of noise",
    "render_key": "digest of scene and code: the name of the kept render",
}


def rendered(scene: WitnessScene, cache: Path, progress: Any = None) -> tuple[Render, bool]:
    """Return the noise-free images, and whether they were taken from ``cache``."""
    path = cache / f"{scene.render_key()}.npz"
    if path.is_file():
        return Render.load(path), True
    render = Film(scene).render(progress)
    cache.mkdir(parents=True, exist_ok=True)
    render.save(path)
    return render, False


def truth(scene: WitnessScene, render: Render, draw: int) -> dict[str, Any]:
    """Return the contents of ``witness.npz``."""
    made = markers(scene)
    scale = scale_e(scene, render)
    bounds, moved = image_bounds(scene, render, scale)
    peak = np.zeros(render.visible.shape)
    for k, (frame, camera, marker, *_) in enumerate(render.place):
        if marker >= 0:
            peak[frame, camera, marker] = scale * render.total[:, render.start[k] : render.start[k + 1]].mean(0).max()
    poses = [[body.motion.pose(scene.mid_exposure_s(f)) for body in scene.bodies] for f in range(scene.frames)]
    return {
        "names": np.array(made.names),
        "diameter_m": made.diameter_m,
        "time_ns": np.array([_mid_ns(scene, f) for f in range(scene.frames)]),
        "xyz": made.xyz,
        "mean_xyz": made.mean_xyz,
        "normal": made.normal,
        "centre_px": np.stack([project(c, made.mean_xyz) for c in scene.cameras], 1),
        "light_px": render.light_px,
        "area_px2": render.area_px2,
        "peak_e": peak,
        "visible": render.visible,
        "bound_px2": bounds,
        "bound_m2": point_bounds(scene, made, bounds),
        "render_noise_px": moved,
        "render_noise_share": render_noise_share(bounds, moved),
        "e_per_radiance": scale,
        "gain_dn_per_e": scene.sensor.gain_dn_per_e,
        "body_rotation": np.array([[pose[0] for pose in row] for row in poses]),
        "body_position": np.array([[pose[1] for pose in row] for row in poses]),
        "cameras": np.array([c.name for c in scene.cameras]),
        "draw": draw,
        "render_key": scene.render_key(),
    }


def write_recording(scene: WitnessScene, render: Render, out: Path, draw: int = 0) -> dict[str, Any]:
    """Write the folder ``out`` and return the contents of ``witness.npz``; ``draw`` selects the noise.

    A folder of an earlier draw is replaced.
    """
    values = truth(scene, render, draw)
    sensors = [VirtualSensor(scene.sensor, camera.size, (scene.seed, c)) for c, camera in enumerate(scene.cameras)]
    if (out / "witness.npz").is_file():
        shutil.rmtree(out)
    rows = ["frame,camera,time_ns,exposure_ns,status"]
    for camera in scene.cameras:
        (out / camera.name).mkdir(parents=True, exist_ok=True)
    for frame in range(scene.frames):
        images = render.images(frame) * values["e_per_radiance"]
        for c, camera in enumerate(scene.cameras):
            counts = sensors[c].counts(images[c], (scene.seed, c, frame, draw))
            file = out / camera.name / f"{frame:06d}.png"
            if not cv2.imwrite(str(file), counts):
                raise OSError(f"{file}: could not be written")
            start = _mid_ns(scene, frame) - round(scene.exposure_s * 5e8)
            rows.append(f"{frame},{camera.name},{start},{round(scene.exposure_s * 1e9)},ok")
    (out / "frames.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (out / "rig.toml").write_text("\n".join(_camera_table(c) for c in scene.cameras), encoding="utf-8")
    _write_truth(scene, values, out / "truth.csv")
    target = _target_table(scene)
    if target:
        (out / "target.toml").write_text(target, encoding="utf-8")
    np.savez_compressed(out / "witness.npz", **values)
    keys = "".join(f"- `{key}`: {meaning}\n" for key, meaning in KEYS.items())
    (out / "README.md").write_text(
        f"# {scene.name}\n\nRendered by Mitsuba 3 (`python -m witness.mitsuba`). `witness.npz` (F frames, C cameras, "
        f"M markers, B bodies):\n\n{keys}",
        encoding="utf-8",
    )
    return values


def _mid_ns(scene: WitnessScene, frame: int) -> int:
    return round(scene.mid_exposure_s(frame) * 1e9)


def _write_truth(scene: WitnessScene, values: dict[str, Any], path: Path) -> None:
    rows = ["label,time_ns,x,y,z"]
    for frame in range(scene.frames):
        for name, (x, y, z) in zip(values["names"], values["xyz"][frame], strict=True):
            rows.append(f"{name},{values['time_ns'][frame]},{x:.9f},{y:.9f},{z:.9f}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def _camera_table(camera: LensCamera) -> str:
    k1, k2, p1, p2, k3 = camera.distortion
    lens = {
        "fx_px": camera.focal_px[0],
        "fy_px": camera.focal_px[1],
        "cx_px": camera.principal_px[0],
        "cy_px": camera.principal_px[1],
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
        "k3": k3,
    }
    rows = "".join(f"{key} = {_number(value)}\n" for key, value in lens.items())
    return (
        f'[[camera]]\nname = "{camera.name}"\nsize = [{camera.size[0]}, {camera.size[1]}]\n\n'
        f'[camera.lens]\nmodel = "opencv"\n{rows}\n[camera.pose]\nposition_m = {_list(camera.position_m)}\n'
        f"rotation_wxyz = {_list(camera.rotation_wxyz)}\n"
    )


def _target_table(scene: WitnessScene) -> str:
    """Return the description of the calibration target; "" where there is none."""
    if len(scene.bodies) != 1:
        return ""
    parts = scene.bodies[0].parts
    first = parts[0]
    if isinstance(first, Chessboard):
        return (
            f'kind = "board"\ncolumns = {first.columns}\nrows = {first.rows}\nsquare_m = {first.square_m!r}\n'
            f"margin_m = {first.margin_m!r}\n"
        )
    if isinstance(first, CodedPlate):
        rows = [f'kind = "field"\ndot_radius_m = {first.dot_radius_m!r}\n']
        for part in parts:
            assert isinstance(part, CodedPlate)
            rows.append(
                f"[[target]]\nnumber = {part.name.split('/')[1]}\nposition_m = {_list(part.at_m)}\n"
                f"normal = {_list(part.normal)}\nx_axis = {_list(part.x_axis)}\n"
            )
        return "\n".join(rows)
    balls = [part for part in parts if isinstance(part, MarkerBall)]
    if len(balls) < 2:
        return ""
    if balls[0].name.startswith("wand/"):
        along = [ball.at_m[0] - balls[0].at_m[0] for ball in balls]
        return f'kind = "wand"\nalong_m = {_list(along)}\ndiameter_m = {balls[0].diameter_m!r}\n'
    rotation, position = scene.bodies[0].motion.pose(scene.mid_exposure_s(0))
    rows = [f'kind = "l_frame"\ndiameter_m = {balls[0].diameter_m!r}\n']
    for ball in balls:
        rows.append(f'[[marker]]\nname = "{ball.name}"\nposition_m = {_list(position + rotation @ ball.at_m)}\n')
    return "\n".join(rows)


def _list(values: Any) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _number(value: float) -> str:
    return repr(round(float(value), 12))


__all__ = ["Array", "rendered", "truth", "write_recording"]
