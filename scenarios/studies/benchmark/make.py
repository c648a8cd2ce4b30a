"""Makes the data sets: those of the twin from scenario files, and those of Mitsuba without the twin.

Each set is drawn by its seed: noise, paths, and a rig whose cameras have slightly different poses each time. The
lenses are exactly OpenCV's: every entrant gets the true calibration, so that detection, correspondence and
triangulation are compared.
"""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mosca.camera.projection import convert_lens
from mosca.data.arrays import Array
from mosca.data.files.toml import read_toml
from mosca.data.files.whole_file import write_text
from mosca.data.rig import Camera, MoscaLens, OpenCVLens, Pose, Rig
from mosca.data.rotations import rotation_from_quaternion
from mosca.data.truth import Truth
from mosca.errors import InputError
from mosca.recording.image_folders import write_image_folders
from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.spec.scenario import load_scenario
from scenarios.studies.benchmark.folder import MadeSet, write_set
from scenarios.studies.benchmark.seeds import Passphrase

SETS = Path(__file__).with_name("sets")
QUICK = ("pair_10", "cloud_50")
"""The sets of ``--quick``."""
TURN_DEG, RAISE_M = 8.0, 0.1
"""Largest rotation of cameras about the volume, and largest rise, drawn by the seed."""
LIMITS = ("limits.completeness=0.5",)
"""Limit that a scenario must have; a data set is not judged by it."""
NO_MITSUBA = "the extra 'witness' is not installed: pip install 'mosca-testbench[witness]', and an LLVM library"


@dataclass(frozen=True)
class SetFile:
    """A data set's file."""

    path: Path

    @property
    def name(self) -> str:
        """Name of the set."""
        return self.path.stem

    @property
    def by_mitsuba(self) -> bool:
        """Whether Mitsuba renders it."""
        return self.path.parent.name == "mitsuba"


def set_files(names: Sequence[str] = (), quick: bool = False) -> list[SetFile]:
    """Return all sets, or those named, or the quick ones; InputError lists the known names."""
    there = [SetFile(path) for kind in ("twin", "mitsuba") for path in sorted((SETS / kind).glob("*.toml"))]
    known = [one.name for one in there]
    for name in names:
        if name not in known:
            raise InputError(f"--set {name}: no such data set; there are {', '.join(known)}")
    wanted = names or (QUICK if quick else known)
    return [one for one in there if one.name in wanted]


def missing(one: SetFile) -> str:
    """Return the reason why a set cannot be made here; "" where it can."""
    return NO_MITSUBA if one.by_mitsuba and find_spec("mitsuba") is None else ""


def make_set(one: SetFile, passphrase: Passphrase, data: Path, workers: int, frames: int | None = None) -> None:
    """Make a set below the folder ``data``, with the first ``frames`` frames; an existing set is replaced."""
    for folder in (data / one.name, data / "truth" / one.name):
        if folder.exists():
            shutil.rmtree(folder)
    seed = passphrase.seed(one.name)
    made = _by_mitsuba(one, seed, data, frames) if one.by_mitsuba else _by_twin(one, seed, data, workers, frames)
    write_set(made, data)


def write_readme(folder: Path, passphrase: Passphrase) -> None:
    """Write a description of the folder of exported sets."""
    write_text(
        folder / "README.md",
        "# Data sets of the mosca benchmark\n\n"
        f"Seeds: first 31 bits of SHA-256 of `{passphrase.text}/NAME` ({passphrase.told}).\n\n"
        "- `NAME/dataset.json`: frames, frame rate, exposure, the box in which markers are (`volume_m`), their size\n"
        "- `NAME/cameras.json`: the true cameras in OpenCV's terms: `x_camera = R x_world + t` [m], fx, fy, cx, cy,\n"
        "  k1, k2, p1, p2, k3; pixel (0, 0) is the middle of the top left one\n"
        "- `NAME/images/CAMERA/000000.png`: 8 bit; `NAME/images/frames.csv`: times of the exposures' starts\n"
        "- `NAME/calibration/points.csv`: known points [m] and their images [px], computed, with noise of 0.02 px\n"
        "- `truth/NAME/points.csv`: where markers were in the middle of each exposure [m]\n"
        "- `truth/NAME/images.csv`: where their centres are in the images [px], the visible share of their discs\n\n"
        "The format in full: docs/benchmark.md of the project.\n",
    )


def _drawn(seed: int, count: int) -> tuple[Array, Array]:
    """Return the rotation [deg] and the rise [m] of each of ``count`` cameras."""
    rng = np.random.default_rng([seed, 11])
    return rng.uniform(-TURN_DEG, TURN_DEG, count), rng.uniform(-RAISE_M, RAISE_M, count)


def _by_twin(one: SetFile, seed: int, data: Path, workers: int, frames: int | None) -> MadeSet:
    plain = load_scenario(one.path, LIMITS)
    cameras = plain.cameras
    assert cameras.azimuth_deg is not None
    assert isinstance(cameras.height_m, tuple)
    turned, raised = _drawn(seed, cameras.count)
    changes = [
        *LIMITS,
        f"seed={seed}",
        "model_gap='none'",
        f"cameras.azimuth_deg={(np.array(cameras.azimuth_deg) + turned).tolist()}",
        f"cameras.height_m={(np.array(cameras.height_m) + raised).tolist()}",
    ]
    if frames is not None:
        changes.append(f"capture.duration_s={frames / plain.capture.frame_rate_hz}")
    spec = load_scenario(one.path, tuple(changes))
    rig = Rig(tuple(map(_with_opencv_lens, true_rig(spec, one.path.parent).cameras)))
    scene = build_scene(spec, one.path.parent)
    source = twin_source(spec, scene, virtual_cameras(spec, rig), workers)
    write_image_folders(source, data / one.name / "images")
    centre, size = np.array(spec.working_space.center_m), np.array(spec.working_space.size_m)
    low, high = centre - size / 2, centre + size / 2
    diameter = float(2 * np.median([scene.model.geom_size[g, 0] for g in scene.marker_geoms]))
    return MadeSet(
        one.name, spec.title, "mosca's twin", seed, rig, source.truth(), spec.capture.frame_rate_hz,
        spec.capture.exposure_s, (_corner(low), _corner(high)), diameter,
    )  # fmt: skip


def _with_opencv_lens(camera: Camera) -> Camera:
    """Return the camera with the OpenCV lens that is nearest to its own; it films through this lens."""
    assert isinstance(camera.lens, MoscaLens)
    fit = convert_lens(replace(camera.lens, a=0.0), "opencv", camera.width, camera.height)
    return replace(camera, lens=fit.lens)


def _by_mitsuba(one: SetFile, seed: int, data: Path, frames: int | None) -> MadeSet:
    from witness.mitsuba.recording import rendered, write_recording
    from witness.mitsuba.scene_file import CAMERAS, scene_of

    table = read_toml(one.path)
    title = str(table.pop("title"))
    azimuths, heights = table["cameras"]["azimuths_deg"], CAMERAS["heights_m"]
    turned, raised = _drawn(seed, len(azimuths))
    table["cameras"] |= {
        "azimuths_deg": (np.array(azimuths) + turned).tolist(),
        "heights_m": (np.array(heights) + raised).tolist(),
        "seed": seed,
    }
    table["seed"] = seed
    if frames is not None:
        table["frames"] = min(frames, table["frames"])
    try:
        scene = scene_of(table, one.name, one.path.parent)
        render, _ = rendered(scene, data / "renders")
    except (ImportError, ValueError) as error:
        raise InputError(f"{one.path}: {error}") from None
    with tempfile.TemporaryDirectory(dir=data) as folder:
        values = write_recording(scene, render, Path(folder) / one.name)
        images = data / one.name / "images"
        images.mkdir(parents=True)
        for camera in scene.cameras:
            shutil.move(Path(folder) / one.name / camera.name, images / camera.name)
    rig = Rig(tuple(map(_camera_of, scene.cameras)))
    truth = _truth_of(values, rig)
    low, high = truth.xyz.min(axis=(0, 1)) - 0.1, truth.xyz.max(axis=(0, 1)) + 0.1
    # round numbers: the box is public, the truth is not
    volume = _corner(np.floor(low * 5) / 5), _corner(np.ceil(high * 5) / 5)
    diameter = float(np.median(values["diameter_m"]))
    return MadeSet(one.name, title, "Mitsuba 3", seed, rig, truth, scene.rate_hz, scene.exposure_s, volume, diameter)


def _camera_of(given: Any) -> Camera:
    k1, k2, p1, p2, k3 = given.distortion
    (fx, fy), (cx, cy), (width, height) = given.focal_px, given.principal_px, given.size
    lens = OpenCVLens(fx, fy, cx, cy, k1, k2, p1, p2, k3)
    pose = Pose(rotation_from_quaternion(np.array(given.rotation_wxyz)), np.array(given.position_m))
    return Camera(given.name, width, height, lens, pose)


def _truth_of(values: dict[str, Any], rig: Rig) -> Truth:
    """Return the witness's truth; (frames, cameras, markers) becomes (frames, markers, cameras)."""
    visible = np.swapaxes(values["visible"], 1, 2)
    away = np.linalg.norm(values["xyz"][:, :, None] - [c.world_from_camera.translation for c in rig.cameras], axis=3)
    focal = np.array([c.lens.fx_px for c in rig.cameras if isinstance(c.lens, OpenCVLens)])
    return Truth(
        time_ns=values["time_ns"],
        names=tuple(str(name) for name in values["names"]),
        xyz=values["xyz"],
        visible=visible,
        cameras=rig.names,
        image_xy_px=np.swapaxes(values["centre_px"], 1, 2),
        diameter_px=focal * np.asarray(values["diameter_m"])[:, None] / away,
        exposure_mid_ns=np.repeat(np.asarray(values["time_ns"])[:, None], len(rig.cameras), axis=1),
    )


def _corner(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 6) for value in values)
    return x, y, z
