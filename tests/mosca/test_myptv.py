"""Real images' points: MyPTV's example (R. Shnapp, MIT), three cameras before a water tank.

Witnesses: a direct linear transformation written out here, and the 3-D points that MyPTV computed with its own camera
model (Tsai and a polynomial) from the same image points.
"""

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from mosca.api import reconstruct
from mosca.calibration.single_camera.adjust import CameraAdjustment
from mosca.calibration.single_camera.from_points import calibrate_from_points
from mosca.camera.projection import project, rays
from mosca.clinic.diagnose import diagnose_frames
from mosca.data.detections import Detections
from mosca.data.files.rig_file import read_rig
from mosca.data.files.target_file import PointsTarget, read_target_file
from mosca.data.rig import Rig
from mosca.data.settings import TrackSettings
from mosca.detection.detect import DetectionSettings, detect
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.pipeline import PipelineSettings, run
from mosca.recording import open_recording
from mosca.tracking.motion_scale import MotionScale
from scenarios.commands.calibrate import CalibrateOptions, calibrate
from scenarios.commands.reconstruct import (
    reconstruct_recording,
    reconstruct_settings,
    reconstruct_spec,
    recorded_backgrounds,
)

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
EXAMPLE = DATA / "myptv_example" / "example"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not EXAMPLE.is_dir(), reason=f"no MyPTV example in {DATA} (set MOSCA_DATA)"),
]
CAMERAS = ("cam1", "cam2", "cam3")
EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
# MyPTV's own limits (params_file.yml, "matching"): region, and root mean square distance of rays from a point
ROI_M = np.array([0.0, 0.0, -0.025]), np.array([0.07, 0.07, 0.015])
MAX_ERR_MM = 0.25
# particles of 1 to 9 px, half of them less than 37 grey values above a background with 4.5 grey values of noise
DETECTION = DetectionSettings(thresholds="paper", contrast_dn=4, lowest_dn=4, minimum_size_px=0, read_noise_dn=4.5)
# measured: 0.162, 0.282, 0.294 (mosca), 0.260, 0.270, 0.267 (opencv), 0.325, 0.458, 0.360 (fisheye); the
# direct linear transformation 0.160, 0.283, 0.307. Margin 10 %.
MEDIAN_PX = {"mosca": (0.18, 0.31, 0.32), "opencv": (0.29, 0.30, 0.30), "fisheye": (0.36, 0.51, 0.40)}


def target(tmp_path: Path, lens: str) -> PointsTarget:
    cameras = "\n".join(f'[[camera]]\nname = "{name}"\nfile = "Calibration/{name}_cal_points"' for name in CAMERAS)
    path = tmp_path / "target.toml"
    path.write_text(f'kind = "points"\nunit = "mm"\nlens = "{lens}"\nsize_px = [1280, 1024]\n{cameras}\n')
    return read_target_file(path)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory) -> dict[str, tuple[Rig, tuple[CameraAdjustment, ...]]]:
    folder = tmp_path_factory.mktemp("myptv")
    return {lens: calibrate_from_points(EXAMPLE, target(folder, lens)) for lens in MEDIAN_PX}


def shipped() -> tuple[np.ndarray, np.ndarray]:
    """Return MyPTV's points (n, 3) [m] and the image points (n, 3 cameras, 2) that it made them of."""
    particles = np.loadtxt(EXAMPLE / "particles")
    images = np.empty((len(particles), 3, 2))
    for c, name in enumerate(CAMERAS):
        blobs = np.loadtxt(EXAMPLE / f"blobs_{name}")
        for i, particle in enumerate(particles):
            # the index counts within the frame; a blob's columns are row, column
            images[i, c] = blobs[blobs[:, 5] == particle[7]][int(particle[3 + c]), 1::-1]
    return particles[:, :3] / 1000, images


def triangulated(rig: Rig, images: np.ndarray) -> np.ndarray:
    """Least squares on the rays, weighted by what a pixel measures at each point."""
    bundles = [rays(camera, images[:, c]) for c, camera in enumerate(rig.cameras)]
    weights = np.ones((3, len(images)))
    for _ in range(4):
        normal, right = np.zeros((len(images), 3, 3)), np.zeros((len(images), 3))
        for bundle, weight in zip(bundles, weights, strict=True):
            rows = bundle.pixel_by_direction * weight[:, None, None]
            square = np.einsum("nki,nkj->nij", rows, rows)
            normal += square
            right += square @ bundle.origin
        points = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        weights = np.array([1 / ((points - b.origin) * b.direction).sum(axis=1) for b in bundles])
    return points


def direct_linear(xy: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Abdel-Aziz and Karara's eleven parameters by linear least squares; returns the residuals (n,) [px]."""
    x = (points - points.mean(axis=0)) / points.std()
    u = (xy - xy.mean(axis=0)) / xy.std()
    ones, none = np.ones((len(x), 1)), np.zeros((len(x), 4))
    design = np.vstack([np.hstack([x, ones, none, -u[:, :1] * x]), np.hstack([none, x, ones, -u[:, 1:] * x])])
    p = np.linalg.lstsq(design, u.T.ravel(), rcond=None)[0]
    below = x @ p[8:] + 1
    predicted = np.column_stack([(x @ p[:3] + p[3]) / below, (x @ p[4:7] + p[7]) / below])
    return np.linalg.norm(predicted - u, axis=1) * xy.std()


def test_the_clinic_says_that_three_frames_tell_nothing(calibrated, tmp_path):
    for name in CAMERAS:
        (tmp_path / name).symlink_to(EXAMPLE / f"Images_{name}")
    rig, _ = calibrated["mosca"]
    with open_recording(tmp_path, rig, 10.0) as source:
        report = diagnose_frames(source, rig)
    assert report.causes == ()
    assert "followed over enough of the 3 frame sets" in report.not_judged[0]


@pytest.mark.parametrize("lens", list(MEDIAN_PX))
def test_each_lens_model_calibrates_the_three_cameras(calibrated, lens):
    _, adjustments = calibrated[lens]
    for adjustment, limit in zip(adjustments, MEDIAN_PX[lens], strict=True):
        assert np.median(np.linalg.norm(adjustment.residuals_px, axis=1)) < limit
        # at most 7 of 432 points are blunders (up to 2.9 px off)
        assert len(adjustment.rejected) <= 8
        # the cameras are about half a metre before the 68 mm target, on its positive Z side
        assert 0.45 < adjustment.camera.world_from_camera.translation[2] < 0.7


def test_no_worse_than_a_direct_linear_transformation(calibrated):
    for name, adjustment in zip(CAMERAS, calibrated["mosca"][1], strict=True):
        values = np.loadtxt(EXAMPLE / "Calibration" / f"{name}_cal_points")
        linear = np.median(direct_linear(values[:, :2], values[:, 2:]))
        assert np.median(np.linalg.norm(adjustment.residuals_px, axis=1)) < 1.02 * linear


@pytest.mark.parametrize("lens", list(MEDIAN_PX))
def test_the_published_points_come_back(calibrated, lens):
    rig, _ = calibrated[lens]
    published, images = shipped()
    points = triangulated(rig, images)
    # inside the calibrated box (Z -12..0 mm) as they are; measured: 0.029, 0.035, 0.081 mm median
    inside = (published[:, 2] > -0.014) & (published[:, 2] < 0.002)
    assert inside.sum() == 23
    assert np.median(np.linalg.norm(points - published, axis=1)[inside]) < 1e-4
    # outside it every model extrapolates differently: one affine map joins them. Measured: 97.4 to 100 %
    # within 0.2 mm (the three others lie 50 mm behind the target), median 0.052 to 0.070 mm
    design = np.column_stack([points, np.ones(len(points))])
    mapped = design @ np.linalg.lstsq(design, published, rcond=None)[0]
    distance = np.linalg.norm(mapped - published, axis=1)
    assert np.mean(distance < 2e-4) >= 0.96
    assert np.median(distance) < 8e-5


def test_a_plane_left_out_is_predicted(tmp_path):
    """Calibrated on two planes of the target, the middle one is predicted as well as it fits."""
    values = np.loadtxt(EXAMPLE / "Calibration" / "cam1_cal_points")
    middle = values[:, 4] == -6
    np.savetxt(tmp_path / "points", values[~middle])
    plan = target(tmp_path, "mosca")
    one = plan.model_copy(update={"camera": (plan.camera[0].model_copy(update={"file": "points"}),)})
    rig, _ = calibrate_from_points(tmp_path, one)
    error = project(rig.cameras[0], values[middle, 2:] / 1000) - values[middle, :2]
    # measured 0.182 px; 0.162 px when the plane takes part
    assert np.median(np.linalg.norm(error, axis=1)) < 0.21


def detections(frame: int) -> dict[str, Detections]:
    """Detect in the images of a frame, with the darkest value of each pixel as static background."""
    found = {}
    for name in CAMERAS:
        images = [
            cv2.imread(str(EXAMPLE / f"Images_{name}" / f"{k:02}.tif"), cv2.IMREAD_UNCHANGED) for k in (1, 2, 3)
        ]
        found[name] = detect(images[frame], name, DETECTION, background=np.minimum.reduce(images))
    return found


@pytest.mark.parametrize("frame", [0, 1, 2])
def test_the_published_blobs_are_detected(frame):
    for name, found in detections(frame).items():
        blobs = np.loadtxt(EXAMPLE / f"blobs_{name}")
        published = blobs[blobs[:, 5] == frame][:, 1::-1]
        distance = cKDTree(found.xy_px).query(published)[0]
        # measured: 0.95 to 0.99 within 1 px, median 0.13 px, about 250 detections for about 72 blobs (the others
        # lie outside MyPTV's region of interest, or are fainter than its limit)
        assert np.mean(distance < 1.0) > 0.93
        assert np.median(distance) < 0.2
        assert len(found) < 350


@dataclass(frozen=True)
class Mark:
    """A particle in a frame's three images (3, 2) [px]: recovered, missing (theirs alone), extra (ours alone)."""

    frame: int
    kind: Literal["recovered", "missing", "extra"]
    images: np.ndarray


@dataclass(frozen=True)
class Comparison:
    """Our points beside MyPTV's 117: each of its particles and each of our points is in exactly one class.

    ``raw_mm``, ``affine_mm`` (recovered,): distances before and after one affine map of our points to theirs;
    ``in_file``: recovered particles that the tracks file holds. ``marks``: where they all are.
    """

    published: Counter[str]
    own: Counter[str]
    raw_mm: np.ndarray
    affine_mm: np.ndarray
    in_file: int
    marks: tuple["Mark", ...]

    def lines(self) -> list[str]:
        n = self.published.total()
        told = [f"published particles {n}, own points {self.own.total()}, in the tracks file {self.in_file}"]
        told += [f"published, {k}: {v} ({100 * v / n:.1f} %)" for k, v in self.published.most_common()]
        told += [f"own, {k}: {v}" for k, v in self.own.most_common()]
        for name, d in (("raw", self.raw_mm), ("affine", self.affine_mm)):
            told.append(
                f"{name}: median {np.median(d):.3f} mm, p95 {np.percentile(d, 95):.3f} mm, "
                f"{100 * np.sum(d < 0.2) / n:.1f} % of all published within 0.2 mm"
            )
        return told


def published_class(near: list[np.ndarray], members: np.ndarray) -> str:
    """Class of a published triple that we lack.

    ``near`` (3 cameras) sets of our detections within 1 px, ``members`` (n, 3) detections of our points.
    """
    blind = [name for name, found in zip(CAMERAS, near, strict=True) if not len(found)]
    if blind:
        return f"no detection in {', '.join(blind)}"
    used = any(np.isin(members[:, c], near[c]).any() for c in range(3))
    return "detected, matched with another blob" if used else "detected, not matched"


def own_class(point: np.ndarray, blobs: list[int], of_triples: list[set[int]], error_mm: float) -> str:
    """Class of a point of ours that MyPTV lacks; ``blobs`` its published blob in each camera, or -1."""
    if not ((point >= ROI_M[0]) & (point <= ROI_M[1])).all():
        return "outside their region"
    if -1 in blobs:
        return f"inside, {blobs.count(-1)} of 3 detections without a published blob"
    if any(blob in taken for blob, taken in zip(blobs, of_triples, strict=True)):
        return "inside, of published blobs, one of them in another particle"
    return f"inside, of published blobs, {'beyond' if error_mm > MAX_ERR_MM else 'within'} their max_err"


def compare(folder: Path) -> Comparison:
    """Calibrate and reconstruct with the example files, as the command line does, and compare all frames."""
    rig_file, out, settings_file = (folder / "rig.toml", folder / "tracks.csv", EXAMPLES / "myptv_settings.toml")
    options = CalibrateOptions(EXAMPLE, EXAMPLES / "myptv_target.toml", rig_file)
    calibrate(options, lambda done, total: None)
    reconstruct_recording(EXAMPLE, rig_file, out, 50.0, settings_file, ())
    tracks, rig, spec = read_tracks_csv(out), read_rig(rig_file), reconstruct_spec(settings_file)
    # the same once more, to see which detections the points are made of
    backgrounds = recorded_backgrounds(EXAMPLE, rig, 50.0, spec.background)
    with open_recording(EXAMPLE, rig, 50.0) as source:
        steps = list(run(source, rig, reconstruct_settings(spec), None, backgrounds))
    published, images = shipped()
    frames = np.loadtxt(EXAMPLE / "particles")[:, 7]
    theirs, ours, in_file = Counter[str](), Counter[str](), 0
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    marks: list[Mark] = []
    for step in steps:
        frame, rows = step.frame_set.pulse, np.flatnonzero(frames == step.frame_set.pulse)
        members, found = step.points.rays, [step.detections[name].xy_px for name in CAMERAS]
        assert (members >= 0).all()  # minimum_cameras = 3
        own_images = np.stack([found[c][members[:, c]] for c in range(3)], axis=1)
        apart = np.linalg.norm(own_images[None] - images[rows][:, None], axis=3).max(axis=2)
        partner = np.where(apart.min(axis=1) < 1.0, apart.argmin(axis=1), -1)
        kept = {tuple(xyz) for xyz in np.round(tracks.xyz[tracks.frame == frame], 9)}
        for row, own in zip(rows, partner, strict=True):
            marks.append(Mark(frame, "recovered" if own >= 0 else "missing", images[row]))
            if own >= 0:
                theirs["recovered"] += 1
                pairs.append((step.points.xyz[own], published[row]))
                in_file += tuple(np.round(step.points.xyz[own], 9)) in kept
            else:
                near = [np.flatnonzero(np.linalg.norm(found[c] - images[row, c], axis=1) < 1) for c in range(3)]
                theirs[published_class(near, members)] += 1
        blobs = [np.loadtxt(EXAMPLE / f"blobs_{name}") for name in CAMERAS]
        trees = [cKDTree(b[b[:, 5] == frame][:, 1::-1]) for b in blobs]
        taken = [set(trees[c].query(images[rows, c])[1].tolist()) for c in range(3)]
        for n, point in enumerate(step.points.xyz):
            if n in partner:
                ours["recovers a published one"] += 1
                continue
            marks.append(Mark(frame, "extra", own_images[n]))
            nearest = [trees[c].query(own_images[n, c]) for c in range(3)]
            blob = [int(k) if distance < 1.0 else -1 for distance, k in nearest]
            ours[own_class(point, blob, taken, ray_error_mm(rig, own_images[n], point))] += 1
    own, other = (np.array(side) for side in zip(*pairs, strict=True))
    design = np.column_stack([own, np.ones(len(own))])
    mapped = design @ np.linalg.lstsq(design, other, rcond=None)[0]
    raw, affine = (1000 * np.linalg.norm(xyz - other, axis=1) for xyz in (own, mapped))
    return Comparison(theirs, ours, raw, affine, in_file, tuple(marks))


COLOURS = {"recovered": (90, 200, 90), "missing": (60, 60, 255), "extra": (0, 190, 255)}
"""Green, red and orange, as OpenCV orders colours."""


def draw(comparison: Comparison, out: Path) -> list[Path]:
    """Write a picture a frame, the three views side by side with every particle that both, they or we alone found."""
    with open_recording(EXAMPLE, read_rig(out / "rig.toml"), 50.0) as source:
        frames = list(source)
    written = []
    for number in sorted({mark.frame for mark in comparison.marks}):
        views = []
        for c, name in enumerate(CAMERAS):
            image = [f.image for f in frames if f.camera == name][number]
            view = cv2.cvtColor(cv2.convertScaleAbs(image, alpha=2.5), cv2.COLOR_GRAY2BGR)
            for mark in comparison.marks:
                if mark.frame == number:
                    at = (round(16 * mark.images[c, 0]), round(16 * mark.images[c, 1]))
                    cv2.circle(view, at, 16 * 8, COLOURS[mark.kind], 2, cv2.LINE_AA, 4)
            cv2.putText(view, name, (20, 50), cv2.FONT_HERSHEY_SIMPLEX, 1.5, (255, 255, 255), 2, cv2.LINE_AA)
            views.append(view)
        written.append(out / f"frame{number}.png")
        cv2.imwrite(str(written[-1]), np.hstack(views))
    return written


def ray_error_mm(rig: Rig, images: np.ndarray, point: np.ndarray) -> float:
    """Root mean square distance of a point's rays (images (3, 2)) from it, which MyPTV limits."""
    away = []
    for camera, xy in zip(rig.cameras, images, strict=True):
        ray = rays(camera, xy[None])
        away.append(np.linalg.norm(np.cross(point - ray.origin, ray.direction[0])))
    return float(1000 * np.sqrt(np.mean(np.square(away))))


def test_from_images_to_the_published_points(tmp_path):
    """The production path: calibrate, background, detect, match, track, file."""
    result = compare(tmp_path)
    print("", *result.lines(), sep="\n")  # seen with pytest -s
    n = result.published.total()
    assert n == 117
    assert result.published["recovered"] >= 0.95 * n
    assert result.in_file >= 0.95 * n
    # a particle that was not recovered is not within 0.2 mm
    assert np.sum(result.affine_mm < 0.2) >= 0.95 * n
    # as they are: the two camera models extrapolate differently behind and before the target
    assert np.median(result.raw_mm) < 0.15
    assert np.sum(result.raw_mm < 0.2) >= 0.7 * n
    assert result.own["recovers a published one"] == result.published["recovered"]
    pictures = draw(result, tmp_path)
    print(*pictures, sep="\n")
    assert len(pictures) == 3
    shown = Counter(mark.kind for mark in result.marks)
    assert shown["missing"] == n - result.published["recovered"]
    assert shown["extra"] == result.own.total() - result.published["recovered"]


def steps_mm(tracks):
    """How far each track goes from frame to frame."""
    ordered = tracks.select(np.lexsort((tracks.frame, tracks.track)))
    return 1000 * np.linalg.norm(np.diff(ordered.xyz, axis=0), axis=1)[np.diff(ordered.track) == 0]


def test_tracks_without_a_settings_file(calibrated):
    """Default settings: nothing is said of the tank, of sizes or of how many frames there are."""
    rig, _ = calibrated["mosca"]
    tracks = reconstruct(EXAMPLE, rig, fps=50)
    published, frames = shipped()[0], np.loadtxt(EXAMPLE / "particles")[:, 7]
    away = np.linalg.norm(published - tracks.xyz[:, None], axis=2)
    away = np.where(frames == tracks.frame[:, None], away, np.inf).min(axis=1)
    # measured: 20 tracks, each in all three frames; 33 samples are published particles, the others are particles
    # outside MyPTV's region or that it lacks
    assert len(np.unique(tracks.track)) >= 18
    assert len(tracks) == 3 * len(np.unique(tracks.track))
    assert np.sum(away < 5e-4) >= 30
    # d_max of MyPTV's params_file.yml, "tracking"
    assert steps_mm(tracks).max() < 1.0
    # control: with the lengths of a room of 2.5 m, tracks jump to other particles
    person = PipelineSettings(track=TrackSettings(**MotionScale()._asdict()))
    assert steps_mm(reconstruct(EXAMPLE, rig, person, fps=50)).max() > 10


def test_swapped_cameras_do_not_give_the_published_points(calibrated):
    """Control: with two cameras' image points exchanged, nothing comes near."""
    rig, _ = calibrated["opencv"]
    published, images = shipped()
    points = triangulated(rig, images[:, [1, 0, 2]])
    assert np.mean(np.linalg.norm(points - published, axis=1) < 2e-4) < 0.05
