"""The twin beside the Mitsuba witness: one scene rendered by both, image by image and through the pipeline.

    python -m tests.oracle.twin_beside witness/scenes/balls_8px.toml --out runs/beside

The twin gets the scene's cameras, motions, exposure and sensor. How bright a target is follows from the lamps and the
tape as described; of the images only the witness's exposure is taken (photoelectrons per radiance). ``beside.csv``
has a row for each target, camera and frame, ``beside.json`` the figures with their limits.
"""

import argparse
import csv
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np

from mosca.data.rig import Camera, OpenCVLens, Pose
from tests.oracle.points import PointFigures, point_figures
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.emission import Glow
from twin.scenes.scene import Scene
from twin.scenes.world import FLAT_HALF_THICKNESS_M, add_flat_target, add_marker, compiled, new_stage
from twin.source import TwinSource
from witness.mitsuba.__main__ import cache_folder
from witness.mitsuba.cramer_rao import image_bounds, point_bounds, scale_e
from witness.mitsuba.film import Render, markers
from witness.mitsuba.recording import rendered, write_recording
from witness.mitsuba.scene import (
    FIRST_MID_S,
    LensCamera,
    MarkerBall,
    MarkerDisc,
    SensorValues,
    WitnessScene,
    quaternion,
)
from witness.mitsuba.scene_file import read_scene
from witness.mitsuba.surfaces import DARK_RAD, EVEN_RAD, LAMBERT, LOBE_RAD, RETRO_GAIN

Array = np.ndarray[Any, Any]
SHARPEST_PX = 0.1
"""The sharpest lens that the twin has; the witness's has no blur at all, as no real lens could."""
AT_M = 3.0
"""Distance at which the twin's marker signal is stated; any will do."""
PITCH_MM = 0.01
"""Any will do: only its ratio to the focal length counts."""
PLACE_PX, BIAS_PX = 0.02, 0.005
"""Limits of places of light: rms of a target, mean of a camera."""
SHARE = 0.1
"""Limit of all other differences, relative to the witness."""
DRAWS, DRAW_SEED = 4, 1000
"""Draws of noise over which the pipeline's figures are averaged: nees of one differs from the next's by 6 %."""
LEVELS = (0.0, 0.03, 0.25, 0.6, 2.0)
"""Shares of the scene's peak above the background between which noise is compared: background, edges, middles."""
LEAST_PIXELS = 500
"""Whose variance is known to 6 %."""


class Difference(NamedTuple):
    """A figure of both, their difference (relative, or as it is) and its limit."""

    name: str
    witness: float
    twin: float
    difference: float
    limit: float

    @property
    def met(self) -> bool:
        return abs(self.difference) <= self.limit


@dataclass(frozen=True)
class Fault:
    """What is wrong with the twin: a control."""

    principal_point_px: float = 0.0
    """By which the first camera's image is moved."""
    gain: float = 1.0
    """Factor on the counts of a photoelectron."""


def twin_of(scene: WitnessScene, electrons_per_radiance: float, fault: Fault | None = None) -> TwinSource:
    """Return the twin of a witness's scene; ValueError names what it cannot show."""
    fault = Fault() if fault is None else fault
    if scene.finish != "retro" or scene.light.panels or scene.room.floor or scene.room.walls:
        raise ValueError(f"{scene.name}: the twin shows retroreflective targets in a dark room")
    return TwinSource(
        _subject(scene),
        tuple(
            _camera(scene, c, electrons_per_radiance, fault.gain, fault.principal_point_px if not k else 0.0)
            for k, c in enumerate(scene.cameras)
        ),
        frame_rate_hz=scene.rate_hz,
        exposure_s=scene.exposure_s,
        pulses=scene.frames,
        seed=scene.seed,
    )


def _subject(scene: WitnessScene) -> Scene:
    spec, names = new_stage(floor=False), []
    for b, body in enumerate(scene.bodies):
        made = spec.worldbody.add_body(name=f"body{b}")
        made.add_joint(type=mujoco.mjtJoint.mjJNT_FREE)
        made.mass, made.inertia, made.explicitinertial = 1e-3, [1e-6, 1e-6, 1e-6], True
        for part in body.parts:
            if isinstance(part, MarkerBall):
                size = [part.diameter_m / 2, 0, 0]
                add_marker(made, part.name, mujoco.mjtGeom.mjGEOM_SPHERE, size, np.array(part.at_m), np.eye(3))
            elif isinstance(part, MarkerDisc):
                normal = np.array(part.normal) / np.linalg.norm(part.normal)
                # the twin's disc lies in the middle of its plate
                add_flat_target(
                    made, part.name, np.array(part.at_m) - FLAT_HALF_THICKNESS_M * normal, normal, part.diameter_m
                )
            else:
                raise ValueError(f"{scene.name}: the twin beside it shows balls and discs, no {type(part).__name__}")
            names.append(part.name)
    model, geoms = compiled(spec, names)
    ahead = FIRST_MID_S - scene.exposure_s / 2

    def configuration(t: float) -> Array:
        poses = [body.motion.pose(t + ahead) for body in scene.bodies]
        return np.concatenate([[*position, *quaternion(rotation)] for rotation, position in poses])

    glow = Glow(
        "retro",
        half_deg=float(np.rad2deg(EVEN_RAD + DARK_RAD) / 2),
        even_deg=float(np.rad2deg(EVEN_RAD)),
        at_m=AT_M,
        ring_m=float(np.hypot(scene.light.ring_inner_m, scene.light.ring_outer_m) / np.sqrt(2)),
        lobe_deg=float(np.rad2deg(LOBE_RAD)),
        lamp_half_deg=60.0,
    )
    duration = scene.frames / scene.rate_hz
    return Scene(model, tuple(names), geoms, configuration, duration, glows=dict.fromkeys(names, glow))


def _signal(scene: WitnessScene) -> float:
    """Return the radiance of a surface at AT_M: the coefficient of luminance over the ring light's solid angle."""
    lobe = [
        np.exp(-((radius / AT_M / LOBE_RAD) ** 2)) for radius in (scene.light.ring_inner_m, scene.light.ring_outer_m)
    ]
    return float(LAMBERT * RETRO_GAIN * scene.light.ring * LOBE_RAD**2 * (lobe[0] - lobe[1]))


def _camera(scene: WitnessScene, camera: LensCamera, scale: float, gain: float, moved_px: float) -> VirtualCamera:
    s, top = scene.sensor, 2.0 ** (scene.sensor.bits - 8)
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = camera.principal_px
    lens = OpenCVLens(*camera.focal_px, x + moved_px, y, k1, k2, p1, p2, k3)
    pose = Pose(camera.rotation, np.array(camera.position_m))
    focal_m = camera.focal_px[0] * PITCH_MM * 1e-3
    f_m = focal_m * camera.focus_m / (focal_m + camera.focus_m)
    optics = Optics(SHARPEST_PX, gap_px=0.0)
    if camera.aperture_m:
        optics = replace(
            optics, focus_m=camera.focus_m, f_mm=f_m * 1e3, f_number=f_m / camera.aperture_m, pixel_pitch_mm=PITCH_MM
        )
    k = s.gain_dn_per_e * gain
    sensor = Sensor(
        full_well_e=(2**s.bits - 1 - s.black_dn * top) / k,
        read_noise_e=s.read_dn * top / k,
        bits=s.bits,
        black_dn=s.black_dn,
        background_e=s.stray_e,
        dsnu_e=s.dsnu_dn * top / k,
        prnu=s.prnu,
        hot_pixels=s.hot_share,
        hot_e=s.hot_e / 2 or 1.0,
    )
    return VirtualCamera(
        Camera(camera.name, *camera.size, lens, pose),
        optics,
        Timing(jitter_s=0.0),
        Mount(body_px=0.0),
        sensor,
        _signal(scene) * scale / sensor.full_well_e,
    )


def twin_render(source: TwinSource, scene: WitnessScene, render: Render) -> tuple[Render, Array]:
    """Return the twin's noise-free light in the witness's windows, as a render in photoelectrons; and its means
    (F, C, H, W) [electrons].
    """
    means, maps = [], []
    for frame in range(scene.frames):
        expected = source.expected(frame)
        means.append([one.mean_e for one in expected])
        for _, c, _, x, y, w, h in render.place[render.place[:, 0] == frame]:
            part, one = np.s_[y : y + h, x : x + w], expected[c]
            # the witness's derivatives are by the target's place, with the same sign
            pieces = (one.mean_e - scene.sensor.stray_e, one.target_e, one.right_e, one.down_e)
            maps.append(np.stack([piece[part].ravel() for piece in pieces]))
    light, contrast, by_x, by_y = np.concatenate(maps, axis=1)
    own = replace(render, total=np.stack([light, light]), contrast=contrast, by_x=by_x, by_y=by_y)
    return own, np.array(means)


class Image(NamedTuple):
    """Of a target's light without noise: sum [e], brightest pixel [e], centroid [px], diameter of the even disc of
    the same second moments [px], and the ratio of the ellipse's axes.
    """

    light_e: float
    peak_e: float
    x_px: float
    y_px: float
    width_px: float
    roundness: float


def image_of(contrast: Array, window: Array) -> Image:
    """Return the figures of a window's light, its pixels in a row; ``window``: x, y, w, h."""
    x0, y0, w, h = window
    y, x = np.mgrid[y0 : y0 + h, x0 : x0 + w]
    light = contrast.reshape(h, w).astype(float)
    whole = light.sum()
    cx, cy = (light * x).sum() / whole, (light * y).sum() / whole
    moments = np.cov(np.stack([x.ravel(), y.ravel()]), aweights=np.maximum(light, 0).ravel(), ddof=0)
    small, large = np.linalg.eigvalsh(moments)
    return Image(whole, light.max(), cx, cy, 4 * np.sqrt((small + large) / 2), np.sqrt(small / large))


def noise(images: Callable[[int], Array], means: Array, sensor: SensorValues) -> tuple[float, Array]:
    """Return the background [DN] and how the noise's variance [DN^2] goes with the light: LEVELS' intervals.

    ``means`` (F, C, H, W) are the expected photoelectrons of ``images``.
    """
    black_dn, edges = (
        sensor.black_dn * 2.0 ** (sensor.bits - 8),
        sensor.stray_e + sensor.peak_e * np.array(LEVELS[1:]),
    )
    off, level, dark = [], [], []
    for frame, mean in enumerate(means):
        counts = images(frame)
        dark.append(counts[mean < edges[0]].mean())
        off.append((counts - black_dn - sensor.gain_dn_per_e * mean).ravel())
        level.append(np.digitize(mean.ravel(), edges))
    rest, which = np.concatenate(off), np.concatenate(level)
    variance = [rest[which == k].var() if (which == k).sum() > LEAST_PIXELS else np.nan for k in range(len(edges))]
    return float(np.mean(dark)), np.array(variance)


def _read(folder: Path, scene: WitnessScene, frame: int) -> Array:
    files = [folder / camera.name / f"{frame:06d}.png" for camera in scene.cameras]
    return np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]).astype(float)


def beside(
    scene: WitnessScene, out: Path, cache: Path, fault: Fault | None = None, draws: int = DRAWS
) -> list[Difference]:
    """Write both recordings and what differs into ``out``; return the figures."""
    render, _ = rendered(scene, cache)
    scale = scale_e(scene, render)
    values = write_recording(scene, render, out / "witness")
    twin = partial(twin_of, electrons_per_radiance=scale, fault=fault)
    # noise-free light knows no sensor's pattern, in the witness as here
    even = replace(scene, sensor=replace(scene.sensor, prnu=0.0, dsnu_dn=0.0, hot_share=0.0))
    own, means = twin_render(twin(even), scene, render)
    bounds = image_bounds(scene, own, 1.0)[0]
    bounds[~np.isfinite(values["bound_px2"])] = np.nan
    of_twin = {**values, "bound_px2": bounds, "bound_m2": point_bounds(scene, markers(scene), bounds)}
    points = []
    for draw in range(draws):
        write_recording(scene, render, out / "witness", draw)
        _write_twin(twin(replace(scene, seed=scene.seed + DRAW_SEED * draw)), out)
        points.append([point_figures(out / "witness", values), point_figures(out / "twin", of_twin)])
    sides, rows = [], []
    for k, (frame, camera, marker, *window) in enumerate(render.place):
        part = slice(render.start[k], render.start[k + 1])
        if marker >= 0 and np.isfinite(bounds[frame, camera, marker]).all():
            pair = image_of(scale * render.contrast[part], window), image_of(own.contrast[part], window)
            sides.append(pair)
            rows.append([frame, scene.cameras[camera].name, values["names"][marker], *pair[0], *pair[1]])
    with (out / "beside.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        names = [f"{side}_{name}" for side in ("witness", "twin") for name in Image._fields]
        table.writerow(["frame", "camera", "marker", *names])
        table.writerows(rows)
    made = _image_differences(np.array(sides), np.array([row[1] for row in rows]))
    made += _noise_differences(scene, out, render, scale, means)
    made += [
        relative(f"bound of {what}, median [{unit}]", _sigma(values[key]) * k, _sigma(of_twin[key]) * k)
        for what, key, unit, k in (("images", "bound_px2", "px", 1.0), ("points", "bound_m2", "mm", 1e3))
    ]
    made += _point_differences(np.array(points))
    report = [{**one._asdict(), "met": bool(one.met)} for one in made]
    (out / "beside.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return made


def relative(name: str, witness: float, twin: float, limit: float = SHARE) -> Difference:
    """Return how much larger the twin's figure is, relative to the witness's."""
    return Difference(name, float(witness), float(twin), float(twin / witness - 1), limit)


def absolute(name: str, witness: float, twin: float, limit: float) -> Difference:
    """Return how much larger the twin's figure is."""
    return Difference(name, float(witness), float(twin), float(twin - witness), limit)


def _image_differences(sides: Array, camera: Array) -> list[Difference]:
    """Return what differs in the images (n, 2 sides, figures) of ``camera`` (n) names."""
    at = {name: k for k, name in enumerate(Image._fields)}
    off = sides[:, 1, at["x_px"] : at["y_px"] + 1] - sides[:, 0, at["x_px"] : at["y_px"] + 1]
    bias = np.array([off[camera == name].mean(0) for name in np.unique(camera)])
    made = [
        absolute("place of light, rms of a target [px]", 0, np.sqrt((off**2).sum(1).mean()), PLACE_PX),
        absolute("place of light, mean of the worst camera [px]", 0, np.linalg.norm(bias, axis=1).max(), BIAS_PX),
    ]
    for name in ("light_e", "peak_e", "width_px", "roundness"):
        pair = sides[:, :, at[name]]
        share = pair[:, 1] / pair[:, 0]
        made.append(relative(f"{name}, median", *np.median(pair, axis=0)))
        made.append(absolute(f"{name}, targets' ratios to one another, rms", 0, share.std() / share.mean(), SHARE))
    return made


def _noise_differences(
    scene: WitnessScene, out: Path, render: Render, scale: float, twin_means: Array
) -> list[Difference]:
    """Return what differs in background and noise."""
    means = scene.sensor.stray_e + scale * np.array([render.images(f) for f in range(scene.frames)])
    sides = [
        noise(partial(_read, out / name, scene), expected, scene.sensor)
        for name, expected in (("witness", means), ("twin", twin_means))
    ]
    made = [relative("background [DN]", sides[0][0], sides[1][0])]
    for low, high, *pair in zip(LEVELS[:-1], LEVELS[1:], *(one[1] for one in sides), strict=True):
        if np.isfinite(pair).all():
            made.append(relative(f"variance at {low:g} to {high:g} of the peak [DN^2]", *pair))
    return made


def _point_differences(points: Array) -> list[Difference]:
    """Return what differs in the points (draws, 2 sides, figures): means over the draws.

    To the limits come two standard errors of the difference, from the draws' scatter.
    """
    made = []
    for name, pair in zip(PointFigures._fields, np.moveaxis(points, 2, 0), strict=True):
        share = pair[:, 1] / pair[:, 0].mean() - pair[:, 0] / pair[:, 0].mean()
        error = share.std(ddof=1) / np.sqrt(len(share)) if len(share) > 1 else 0.0
        made.append(relative(f"points: {name}", *pair.mean(0), SHARE + 2 * float(error)))
    return made


def _sigma(bound: Array) -> float:
    return float(np.sqrt(np.nanmedian(bound.trace(axis1=-2, axis2=-1))))


def _write_twin(source: TwinSource, out: Path) -> None:
    """Write the twin's images as the witness's recording has them: same times, same rig."""
    if (out / "twin").exists():
        shutil.rmtree(out / "twin")
    shutil.copytree(out / "witness", out / "twin", ignore=shutil.ignore_patterns("witness.npz", "README.md"))
    for frame in source:
        cv2.imwrite(str(out / "twin" / frame.camera / f"{frame.index:06d}.png"), frame.image)


def table(made: list[Difference]) -> str:
    """Return the figures as lines of text."""
    lines = [f"{'':52s}{'witness':>10s}{'twin':>10s}{'differs':>10s}{'limit':>8s}"]
    for one in made:
        name, witness, twin, off, limit = one
        lines.append(f"{name:52s}{witness:10.4g}{twin:10.4g}{off:+10.4f}{limit:8.3g}{'' if one.met else '  exceeds'}")
    return "\n".join(lines)


def main() -> int:
    """Print what differs, scene by scene; 1 where a limit is exceeded, 2 for a scene that cannot be shown."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle.twin_beside", description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE.toml")
    parser.add_argument("--out", required=True, type=Path, help="a folder NAME is made in it for each scene")
    parser.add_argument("--cache", type=Path, default=cache_folder(), help="where noise-free renders are kept")
    parser.add_argument("--principal-point", type=float, default=0.0, help="control: moves the first camera's [px]")
    parser.add_argument("--gain", type=float, default=1.0, help="control: factor on the twin's gain")
    given = parser.parse_args()
    exceeded = False
    for path in given.scenes:
        try:
            scene = read_scene(path)
            twin_of(scene, 1.0)
        except (OSError, ValueError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        made = beside(scene, given.out / scene.name, given.cache, Fault(given.principal_point, given.gain))
        print(f"{scene.name}\n{table(made)}", flush=True)
        exceeded |= not all(one.met for one in made)
    return int(exceeded)


if __name__ == "__main__":
    sys.exit(main())
