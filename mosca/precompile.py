"""Compile the pipeline's kernels before they are needed: ``python -m mosca.precompile``.

An argument selects some of them, so that processes can compile in parallel: ``look`` those of detection, ``points``
those of correspondence, triangulation and tracking, ``windows`` those of cut targets. ``look_twice`` compiles those
of detection in images of 8 and of 16 bits: in one process they share the functions that do not depend on the type of
the pixels, which are half of them. ``calibration`` compiles those of a session with coded targets, for their images
and the adjustment. ``people`` compiles those of a person's pose and joints, which the pipeline does not need.
"""

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from mosca.calibration.session import EstimateSettings, calibrate_sightings
from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.coded_targets.detect import find_coded
from mosca.correspondence.match import MatchSettings, match_counted
from mosca.correspondence.shared_turns import Shared, without_turns
from mosca.data.arrays import Array, read_only, read_only_image
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.data.rays import COLUMNS as RAY_COLUMNS
from mosca.data.rig import Camera, MoscaLens, Pose, Rig
from mosca.data.sightings import Sightings
from mosca.data.target_codes import SECTORS, code_bits
from mosca.data.targets import CodedTarget, PlacedTarget, TestField
from mosca.detection.cut_targets.expected import expected_images
from mosca.detection.cut_targets.kinds import kinds_of
from mosca.detection.cut_targets.window_fits import OfPoints, OfTracks, fit_windows
from mosca.detection.cut_targets.windows import LEARNED, Windows, windows_of
from mosca.detection.detect import DetectionSettings
from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS
from mosca.detection.scheduler import FrameSetDetector
from mosca.diagnostics.camera_health import Health
from mosca.pipeline import PipelineSettings, run
from mosca.skeleton.joints import JointReader, SegmentAxes
from mosca.skeleton.model import HUMAN, Kinematics, read_skeleton_model
from mosca.skeleton.pose import solve_pose
from mosca.skeleton.pose_kernels import information_of
from mosca.tracking.tracker import Tracker, TrackSettings

WIDTH, HEIGHT, RATE_HZ, PULSES = 96, 72, 100.0, 8
LABELS = ("LASI", "RASI", "LPSI", "RPSI", "LTHI", "RTHI", "LTIB", "RTIB")
POINTS = np.array([[0.1, 0.0, 0.1], [-0.1, 0.1, 0.0], [0.0, -0.1, -0.1]])


class _Blobs:
    """Three points seen by three cameras, as soft blobs."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.cameras = tuple(CameraInfo(c.name, c.width, c.height, 8, RATE_HZ) for c in rig.cameras)

    def __iter__(self) -> Iterator[Frame]:
        for pulse in range(PULSES):
            for camera in self.rig.cameras:
                image = _blobs(project(camera, POINTS))
                yield Frame(camera.name, pulse, round(pulse * 1e9 / RATE_HZ), 1_000_000, image)

    def close(self) -> None:
        pass

    def __enter__(self) -> "_Blobs":
        return self

    def __exit__(self, *exc: object) -> None:
        pass


def warm_up() -> int:
    """Run the whole pipeline once over a few small frames; returns how many points it found."""
    low, high = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    return sum(len(step.points) for step in run(_Blobs(_rig()), _rig(), PipelineSettings(volume=(low, high))))


def look(bit_depth: int = 8) -> int:
    """Detect in one small frame set of a bit depth; returns how many targets were found."""
    source, dtype = _Blobs(_rig()), np.uint8 if bit_depth == 8 else np.uint16
    frames = {}
    for frame in islice(source, len(source.cameras)):
        assert frame.image is not None
        image = np.left_shift(frame.image.astype(dtype), bit_depth - 8)
        frames[frame.camera] = replace(frame, image=image)
    at = FrameSetDetector(DetectionSettings(), dict.fromkeys(frames, bit_depth))
    return sum(len(found) for found in at.detect(FrameSet(0, 0, frames), NO_STATISTICS)[0].values())


def look_twice() -> int:
    """Detect in frame sets of 8 and of 12 bits; returns how many targets were found."""
    return look() + look(12)


def points() -> int:
    """Match and track simulated detections of a few sets, health included; returns how many samples there were."""
    rig, tracker, samples = _rig(), Tracker(TrackSettings()), 0
    health = Health(rig)
    room = (np.full(3, -1.0), np.full(3, 1.0))
    shared = Shared(np.full(3, 0.01), np.full(3, 0.01), np.zeros((3, 2)))
    for pulse in range(PULSES):
        n = len(POINTS)
        found = {
            c.name: Detections(
                c.name, project(c, POINTS), np.tile(1e-4 * np.eye(2), (n, 1, 1)), np.full(n, 4.0), np.full(n, 100.0),
                np.ones(n),
            )
            for c in rig.cameras
        }  # fmt: skip
        predicted = tracker.predict(pulse / RATE_HZ)
        bundle = make_ray_table(rig, found, 0.05, "auto")
        matched = match_counted(bundle, predicted, MatchSettings(), room, 0.0)
        made, _ = without_turns(matched.points, matched.trusts, bundle, shared)
        frame_set = FrameSet(pulse, round(pulse * 1e9 / RATE_HZ), {})
        samples += len(tracker.update(made, pulse, frame_set.time_ns))
        health.attend(rig, frame_set, found, made, bundle)
    return samples


def windows() -> int:
    """Fit an empty list of windows, as for points that are cut; returns how many there were.

    The fits come first: meanwhile another process compiles the functions shared with ``points``.
    """
    rig = _rig()
    many = len(rig.cameras)
    xyz = read_only(np.zeros((0, 3)), (0, 3), "xyz")
    rays_of = read_only(np.zeros((0, many)), (0, many), "rays", np.int64)
    rays = np.zeros((0, RAY_COLUMNS)), np.zeros(many + 1, np.int64), np.zeros((0, 2))
    number, pair, of_points = np.zeros(0, np.int64), np.zeros((0, 2), np.int64), np.zeros((0, many))
    learned = np.ones((many, LEARNED))
    none = Windows(number, number, number, pair, pair, np.zeros((0, 2)), np.zeros(0))
    expected = OfTracks(np.zeros((0, 3)), np.zeros((many, 0, 2)), np.zeros((many, 0)), np.zeros((many, 0)), 0.1)
    fits = fit_windows(np.ones((0, 3, 3)), none, learned, rays, OfPoints(xyz, rays_of, of_points), expected)
    table = make_ray_table(rig, {c.name: Detections.none(c.name) for c in rig.cameras}, 0.05, "auto")
    windows_of(np.zeros((0, many), np.uint8), (rays_of, of_points, of_points), rays, learned, table.cameras)
    kinds_of(rays_of, xyz, table.rays, table.start, table.views, 0.1)
    expected_images(np.zeros((0, 3)), np.zeros((0, 3, 3)), table.cameras, table.views, np.ones(3), 0.1)
    return len(fits)


def calibration() -> int:
    """Find a coded target in its image and calibrate three cameras from a field; returns how many points it took."""
    mark = CodedTarget.of_dot(7, 0.002)
    find_coded(_coded(mark, 0.0005), "cam1")
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.2, 0.2, (60, 3))
    field = TestField(tuple(PlacedTarget(str(k), mark, place) for k, place in enumerate(places)))
    rig = _rig()
    xy = [project(camera, places) + rng.normal(0.0, 0.05, (len(places), 2)) for camera in rig.cameras]
    cameras, n = len(rig.cameras), len(rig.cameras) * len(places)
    sightings = Sightings(
        tuple(c.name for c in rig.cameras), np.full((cameras, 2), (WIDTH, HEIGHT)), 1,
        np.repeat(np.arange(cameras), len(places)), np.zeros(n, dtype=np.int64),
        np.tile(np.arange(len(places)), cameras), np.concatenate(xy), np.tile(0.0025 * np.eye(2), (n, 1, 1)),
        np.full(n, 0.5),
    )  # fmt: skip
    return int(calibrate_sightings(sightings, field, EstimateSettings()).used.sum())


def people() -> int:
    """Find the pose and the joints of the model of a person at rest; returns how many joints it has."""
    model = read_skeleton_model(HUMAN, LABELS)
    kinematics = Kinematics(model)
    kinematics.pose(kinematics.mj.qpos0)
    xyz, m = kinematics.markers(), len(model.labels)
    information_of(xyz, np.zeros((m, 3, 3)), np.full(m, 0.01), information := np.empty((m, 3, 3)))
    solution = solve_pose(kinematics, kinematics.mj.qpos0, xyz, information)
    reader = JointReader(kinematics, SegmentAxes({}, {}), 1e-6 * np.eye(len(model.parameters)), np.full(m, 0.01))
    return len(reader.read(solution)[0])


def _rig() -> Rig:
    lens = MoscaLens(0.9, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, 0.0099, 0.0099)
    cameras = []
    for k, angle in enumerate((0.0, 2.0, 4.0)):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.array([-np.sin(angle), np.cos(angle), 0.0])
        rotation = np.column_stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(f"cam{k + 1}", WIDTH, HEIGHT, lens, Pose(rotation, -forward)))
    return Rig(tuple(cameras))


def _blobs(xy_px: Array) -> Array:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    away2 = (x[..., None] - xy_px[:, 0]) ** 2 + (y[..., None] - xy_px[:, 1]) ** 2
    result: Array = np.rint(4 + 150 * np.exp(-away2 / 4.0).sum(axis=-1)).astype(np.uint8)
    return result


def _coded(target: CodedTarget, pixel_m: float) -> Array:
    """Draw a coded target from the front, without blur (H, W); read-only, as the images of a source are."""
    half = round(0.7 * target.plate_m / pixel_m)
    y, x = pixel_m * np.mgrid[-half : half + 1, -half : half + 1]
    radius, sector = np.hypot(x, y), np.floor(np.arctan2(-y, x) / (2 * np.pi) * SECTORS).astype(int)
    ring = (
        (target.ring_inner_m < radius) & (radius < target.ring_outer_m) & np.array(code_bits(target.number))[sector]
    )
    return read_only_image(np.where(ring | (radius < target.dot_radius_m), 200, 20).astype(np.uint8))


if __name__ == "__main__":
    if hasattr(os, "nice"):
        os.nice(5)  # the process that waits for this has more to compile itself
    parts = {f.__name__: f for f in (look, look_twice, points, windows, calibration, people)}
    parts.get("".join(sys.argv[1:]), warm_up)()
