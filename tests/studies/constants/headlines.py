"""Short takes and their headline figures: the twin's, another renderer's and a real camera's images.

Everything is read into memory once; afterwards ``figures`` needs some seconds.
"""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from mosca.calibration.session import EstimateSettings, Shown, calibrate_session
from mosca.calibration.single_camera.from_points import calibrate_from_points
from mosca.data.arrays import Array, read_only_image
from mosca.data.files.target_file import PointsTarget, read_target_file
from mosca.data.frames import CameraInfo, Frame, FrameSource
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.tracks import table
from mosca.data.truth import Truth
from mosca.pipeline import PipelineSettings, run
from mosca.recording import open_recording
from scenarios.build.cameras import true_rig, virtual_cameras
from scenarios.commands.reconstruct import reconstruct_settings, reconstruct_spec
from scenarios.score.tracks import metrics, pair
from scenarios.session.estimated import against_truth, at_rest, session_source
from scenarios.session.scenes import axes_session, target_session
from scenarios.spec.scenario import load_scenario
from scenarios.studies.benchmark.folder import read_about, read_set_truth
from scenarios.studies.benchmark.make import make_set, missing, set_files
from scenarios.studies.benchmark.seeds import published, tuning

ROOT = Path(__file__).resolve().parents[3]
DATA = Path(os.environ.get("MOSCA_DATA", ROOT.parent / "shared" / "data"))
SETS = {"cloud_50": 40, "actor": 60, "dense_200": 20, "large_20px": 40, "mitsuba_floor": 12, "mitsuba_motion": 12}
"""Data sets of the benchmark, of its last published round, and how many frame sets of each."""
CALIBRATE = ("mosca/calibration", "mosca/coded_targets", "mosca/camera")
RECONSTRUCT = ("mosca/detection", "mosca/correspondence", "mosca/tracking", "mosca/triangulation", "mosca/camera",
               "mosca/diagnostics", "mosca/synchronisation")  # fmt: skip
SCORES = ("completeness", "coverage95", "ghosts_per_frame", "identity_switches")
USUAL = 0.99
"""Share of the samples, those with the smallest errors, of which rms and nees are taken: single images that are half
hidden decide otherwise (rms of mitsuba_motion: 0.055 mm or 0.22 mm by whether one is found). What is left out is
counted by ``contradicted``."""
CONTRADICTED = float(chi2.isf(1e-6, 3))
SESSIONS = {
    "field": ("space_1m", ("cameras.count=4", "cameras.height_m=[0.5, 1.0, 0.4, 1.1]", "calibration.stands=6",
                           "calibration.frames=1", "calibration.markers=80")),
    "wand": ("wand_1m", ("cameras.count=4", "cameras.height_m=[0.5, 1.0, 0.4, 1.1]", "calibration.frames=120",
                         "calibration.lengths=false")),
}  # fmt: skip
"""Calibration sessions of the twin: a scenario and changes that make it short."""
MYPTV = DATA / "myptv_example" / "example"
MYPTV_CAMERAS = ("cam1", "cam2", "cam3")
NEAR_M = 2e-4
"""A point of MyPTV's is recovered within this."""

Figures = dict[str, float]


class Replay:
    """Frames from memory."""

    def __init__(self, cameras: tuple[CameraInfo, ...], frames: tuple[Frame, ...]) -> None:
        self.cameras, self.frames = cameras, frames

    @classmethod
    def of(cls, source: FrameSource, frame_sets: int) -> "Replay":
        """Read the first frame sets of a source."""
        with source:
            return cls(source.cameras, tuple(f for f in source if f.index < frame_sets))

    def __iter__(self) -> Iterator[Frame]:
        yield from self.frames

    def close(self) -> None:
        """Nothing to close."""

    def __enter__(self) -> "Replay":
        return self

    def __exit__(self, *exc: object) -> None:
        pass


@dataclass(frozen=True)
class Headline:
    """A take, and what gives its figures."""

    name: str
    outside: bool
    """Whether its images are not of the project's own twin."""
    figures: Callable[[], Figures]
    packages: tuple[str, ...]
    """Those whose constants it is to show: what calibrates alone needs no tracks, and the other way round."""

    def shows(self, keys: Sequence[str]) -> bool:
        """Whether any of the constants is of these packages."""
        return any(key.startswith(self.packages) for key in keys)


def headlines(data: Path, names: tuple[str, ...] = ()) -> list[Headline]:
    """Return the takes (all, or those named), made below ``data`` where they are not there yet.

    Those whose images cannot be made here, for want of Mitsuba or of MyPTV's files, are left out, which is printed.
    """
    found = []
    for one in set_files(tuple(SETS)):
        if names and one.name not in names:
            continue
        if not (data / one.name / "dataset.json").is_file():
            if missing(one):
                print(f"left out: {one.name}: {missing(one)}")
                continue
            make_set(one, published() or tuning(), data, workers=2)
        found.append(Headline(one.name, one.by_mitsuba, _of_set(data, one.name), RECONSTRUCT))
    for name in SESSIONS:
        if not names or name in names:
            found.append(Headline(name, False, _of_session(name), CALIBRATE))
    if not names or "myptv" in names:
        if MYPTV.is_dir():
            found.append(Headline("myptv", True, _of_myptv(data), (*RECONSTRUCT, *CALIBRATE)))
        else:
            print(f"left out: myptv: no example in {DATA} (set MOSCA_DATA)")
    return found


def _of_set(data: Path, name: str) -> Callable[[], Figures]:
    about, rig, frames = read_about(data / name / "dataset.json"), _rig(data / name), SETS[name]
    source = Replay.of(open_recording(data / name / "images", rig, None), frames)
    truth = _first(read_set_truth(data / "truth" / name), frames)
    space_m = float(np.max(np.subtract(about.volume_m[1], about.volume_m[0])))

    def figures() -> Figures:
        tracks = table([step.samples for step in run(source, rig)])
        matched = pair(tracks, truth, space_m)
        scores = metrics(matched, space_m)
        found = {score: float(scores[score].value) for score in SCORES if score in scores}
        usual = int(np.ceil(USUAL * len(matched.nees)))
        if usual:
            found["position_rms_99"] = float(np.sqrt(np.mean(np.sort(matched.distance_m)[:usual] ** 2)))
            found["nees_99"] = float(np.mean(np.sort(matched.nees)[:usual]))
            found["contradicted"] = float(np.mean(matched.nees > CONTRADICTED))
        return found

    return figures


def _first(truth: Truth, frames: int) -> Truth:
    names = ("time_ns", "xyz", "visible", "image_xy_px", "diameter_px", "exposure_mid_ns")
    return replace(truth, **{name: np.asarray(getattr(truth, name))[:frames] for name in names})


def _rig(folder: Path) -> Rig:
    """Return the cameras of ``cameras.json`` of a data set."""
    cameras = []
    for one in json.loads((folder / "cameras.json").read_text())["cameras"]:
        lens = OpenCVLens(
            one["fx"], one["fy"], one["cx"], one["cy"], one["k1"], one["k2"], one["p1"], one["p2"], one["k3"]
        )
        rotation, shift = np.array(one["R"]), np.array(one["t"])
        pose = Pose(rotation.T, -rotation.T @ shift)
        cameras.append(Camera(one["name"], one["width"], one["height"], lens, pose))
    return Rig(tuple(cameras))


def _of_session(name: str) -> Callable[[], Figures]:
    scenario, changes = SESSIONS[name]
    path = ROOT / "scenarios" / "library" / "calibration" / f"{scenario}.toml"
    spec = load_scenario(path, changes)
    assert spec.calibration is not None
    cameras = at_rest(virtual_cameras(spec, true_rig(spec, path.parent)))
    sessions = [target_session(spec, spec.calibration)]
    if spec.calibration.target == "wand":
        sessions.append(axes_session(spec))
    center, size = np.array(spec.working_space.center_m), np.array(spec.working_space.size_m)
    volume = ((center - size / 2).tolist(), (center + size / 2).tolist())
    shown: list[Shown[Any]] = []
    for number, session in enumerate(sessions):
        source = Replay.of(session_source(spec, session, cameras, 2, number), session.pulses)
        shown.append(Shown(session.target, lambda _, source=source: source))

    def figures() -> Figures:
        calibration, _ = calibrate_session(
            shown[0], EstimateSettings(volume=volume), axes=shown[1] if shown[1:] else None
        )
        ray_px, volume_m = against_truth(calibration.rig, cameras, center, size)
        used, offered = calibration.used, calibration.used.size
        return {
            "ray_rms_px": float(np.sqrt(np.mean(ray_px**2))),
            "volume_rms": float(np.sqrt(np.mean(volume_m**2))),
            "images": float(offered),
            "used_share": float(np.mean(used)),
        }

    return figures


def _of_myptv(data: Path) -> Callable[[], Figures]:
    """MyPTV's example: real cameras before a water tank, calibrated from its points, its particles recovered."""
    rows = "\n".join(f'[[camera]]\nname = "{c}"\nfile = "Calibration/{c}_cal_points"' for c in MYPTV_CAMERAS)
    data.mkdir(parents=True, exist_ok=True)
    path = data / "myptv_target.toml"
    path.write_text(f'kind = "points"\nunit = "mm"\nlens = "mosca"\nsize_px = [1280, 1024]\n{rows}\n')
    target = read_target_file(path)
    assert isinstance(target, PointsTarget)
    settings = reconstruct_settings(reconstruct_spec(ROOT / "docs" / "examples" / "myptv_settings.toml"))
    images = {
        name: [
            read_only_image(cv2.imread(str(MYPTV / f"Images_{name}" / f"{k:02}.tif"), cv2.IMREAD_UNCHANGED))
            for k in (1, 2, 3)
        ]
        for name in MYPTV_CAMERAS
    }
    backgrounds = {name: np.minimum.reduce(three) for name, three in images.items()}
    published = np.loadtxt(MYPTV / "particles")

    def figures() -> Figures:
        rig, adjustments = calibrate_from_points(MYPTV, target)
        off = [np.median(np.linalg.norm(one.residuals_px, axis=1)) for one in adjustments]
        xyz = _reconstructed(rig, images, backgrounds, settings)
        if not all(map(len, xyz)):
            return {"residual_px": float(np.mean(off)), "recovered": 0.0}
        nearest = np.concatenate(
            [cKDTree(xyz[f]).query(published[published[:, 7] == f, :3] / 1000)[0] for f in range(3)]
        )
        return {
            "residual_px": float(np.mean(off)),
            "recovered": float(np.mean(nearest < NEAR_M)),
            "median_m": float(np.median(nearest[nearest < NEAR_M])),
            "points": float(sum(map(len, xyz))),
        }

    return figures


def _reconstructed(
    rig: Rig, images: dict[str, list[Array]], backgrounds: dict[str, Array], settings: PipelineSettings
) -> list[Array]:
    infos = tuple(CameraInfo(c.name, c.width, c.height, 8, 50.0) for c in rig.cameras)
    frames = [Frame(name, k, 20_000_000 * k, 0, images[name][k]) for k in range(3) for name in images]
    extra: dict[str, Any] = {"backgrounds": backgrounds}
    return [np.asarray(step.points.xyz) for step in run(Replay(infos, tuple(frames)), rig, settings, **extra)]
