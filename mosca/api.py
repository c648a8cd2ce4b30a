"""The public functions of ``mosca``: the stages of the pipeline with defaults that work, files as str or Path.

Each function is one call into the stage that ``mosca.pipeline`` runs; nothing is computed here.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mosca.calibration.session import EstimateSettings, Shown, calibrate_session
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.camera.projection import project as project_points
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import EVERYWHERE, MatchSettings
from mosca.correspondence.match import match as match_rays
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.detections import Detections
from mosca.data.files.rig_file import read_rig, write_rig
from mosca.data.files.target_file import PointsTarget, read_target_file
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.data.targets import ScaleBar
from mosca.data.tracks import Points, Tracks, table
from mosca.data.wands import LFrame
from mosca.detection.detect import DetectionSettings
from mosca.detection.detect import detect as detect_targets
from mosca.errors import CalibrationError, InputError
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from mosca.pipeline import PipelineSettings, run
from mosca.recording import open_recording
from mosca.tracking.tracker import Tracker, TrackSettings
from mosca.triangulation.triangulate import triangulate as triangulate_table

T = TypeVar("T", LFrame, ScaleBar)
File = str | Path
Volume = tuple[ArrayLike, ArrayLike]

__all__ = [
    "Calibration",
    "CalibrationError",
    "Camera",
    "DetectionSettings",
    "Detections",
    "FisheyeLens",
    "InputError",
    "MatchSettings",
    "MoscaLens",
    "OpenCVLens",
    "PipelineSettings",
    "Points",
    "Pose",
    "Rig",
    "TrackSettings",
    "Tracks",
    "Triangulated",
    "calibrate",
    "detect",
    "match",
    "open_recording",
    "project",
    "read_rig",
    "read_tracks",
    "reconstruct",
    "track",
    "triangulate",
    "write_rig",
    "write_tracks",
]


class Triangulated(NamedTuple):
    """Points from image points of known correspondence."""

    xyz: Array
    """(n, 3) world frame [m]; NaN where fewer than two cameras see the point."""
    covariance: Array
    """(n, 3, 3) covariance of the measurement [m^2]; that of the calibration is not in it."""
    residual_px: Array
    """(n,) rms reprojection error [px]."""


def detect(
    image: Array,
    camera: str = "camera",
    settings: DetectionSettings | None = None,
    *,
    bit_depth: int | None = None,
    background: Array | None = None,
) -> Detections:
    """Return the markers in one image, with sub-pixel centres and their covariance.

    Parameters
    ----------
    image : (H, W) uint8 or uint16
        Grey values; pixel (0, 0) is the centre of the top-left pixel.
    camera :
        Name that the detections carry; needed where several cameras are matched.
    settings :
        Thresholds, sizes and the kind of centre; default: a fitted blurred disc.
    bit_depth :
        Significant bits of a pixel; default: 8 for uint8, 16 for uint16.
    background : (H, W), as the image
        Static scene; subtracted first.

    Raises
    ------
    InputError
        For an image, a background or a bit depth that do not fit each other.
    """
    image = np.asarray(image)
    bits = 8 * image.dtype.itemsize if bit_depth is None else bit_depth
    return detect_targets(image, camera, settings or DetectionSettings(), bits, background)


def project(camera: Camera, xyz: ArrayLike) -> Array:
    """Return the pixels (n, 2) of world points ``xyz`` (n, 3) [m]; NaN where the lens does not image them."""
    return project_points(camera, np.asarray(xyz, dtype=float))


def triangulate(
    rig: Rig,
    images: Mapping[str, ArrayLike],
    sigma_px: float = 1.0,
    *,
    covariances_px2: Mapping[str, ArrayLike] | None = None,
) -> Triangulated:
    """Return the points whose images are known in each camera, with covariance.

    Parameters
    ----------
    rig :
        Calibrated cameras.
    images : camera name -> (n, 2)
        Pixel of point k in row k, NaN where a camera does not see it; cameras may be left out.
    sigma_px :
        Standard deviation of an image coordinate [px].
    covariances_px2 : camera name -> (n, 2, 2)
        Covariances of the pixels of each camera in ``images``, as detections state them, in place of ``sigma_px``.

    Raises
    ------
    InputError
        For a camera that the rig lacks, for tables of different lengths, and for a seen pixel whose covariance is
        not positive.
    """
    tables = {name: np.asarray(xy, dtype=float).reshape(-1, 2) for name, xy in images.items()}
    for name in tables:
        if name not in rig.names:
            raise InputError(f"triangulate: camera '{name}' given; the rig has {', '.join(rig.names)}")
    lengths = {len(xy) for xy in tables.values()}
    if len(lengths) > 1:
        given = ", ".join(f"{name} {len(xy)}" for name, xy in tables.items())
        raise InputError(f"triangulate: {given} rows given; the same number for each camera is wanted (NaN: unseen)")
    n = lengths.pop() if lengths else 0
    unseen = np.full((n, 2), np.nan)
    xy_px = np.stack([tables.get(name, unseen) for name in rig.names], axis=1)
    weights = None if covariances_px2 is None else _weights(rig, tables, covariances_px2)
    return Triangulated(*triangulate_table(rig, xy_px, sigma_px, weights))


def _weights(rig: Rig, tables: Mapping[str, Array], given: Mapping[str, ArrayLike]) -> Array:
    """Return the covariances (n, c, 2, 2) of the pixels (n, 2) of each camera; InputError where there is none."""
    n = len(next(iter(tables.values()), ()))
    made = np.tile(np.eye(2), (n, len(rig.names), 1, 1))
    for c, name in enumerate(rig.names):
        if name not in tables:
            continue
        one = np.asarray(given.get(name, ()), dtype=float)
        if one.shape != (n, 2, 2):
            raise InputError(f"triangulate: covariances of '{name}' {one.shape} given; {(n, 2, 2)} are wanted")
        seen = np.isfinite(tables[name]).all(axis=1)
        good = (one[:, 0, 0] > 0) & (np.linalg.det(one) > 0)
        if (seen & ~good).any():
            row = int(np.flatnonzero(seen & ~good)[0])
            raise InputError(f"triangulate: covariance of row {row} of '{name}' is not positive definite")
        made[seen, c] = one[seen]
    return made


def match(
    rig: Rig,
    detections: Mapping[str, Detections],
    settings: MatchSettings | None = None,
    *,
    volume: Volume | None = None,
) -> Points:
    """Return the points that the detections of one instant show, found by epipolar geometry.

    Parameters
    ----------
    rig :
        Calibrated cameras.
    detections : camera name -> Detections
        Of one exposure of all cameras.
    settings :
        Gates and smallest number of cameras.
    volume : (low (3,), high (3,)) [m, world]
        Where targets can be; default: everywhere.
    """
    settings = settings or MatchSettings()
    low, high = EVERYWHERE if volume is None else (np.asarray(edge, dtype=float) for edge in volume)
    rays = make_ray_table(rig, detections, settings.camera_sigma_px, settings.target)
    return match_rays(rays, Predicted.nothing(), settings, (low, high))


def track(instants: Iterable[tuple[int, Points]], settings: TrackSettings | None = None) -> Tracks:
    """Return tracks of points over time.

    Parameters
    ----------
    instants :
        (time of mid-exposure [ns], Points) of each frame set, in order of time.
    settings :
        Motion model and gates.
    """
    tracker = Tracker(settings or TrackSettings())
    samples = []
    for frame, (time_ns, points) in enumerate(instants):
        tracker.predict(time_ns * 1e-9)
        samples.append(tracker.update(points, frame, time_ns))
    return table(samples)


def reconstruct(
    recording: File,
    rig: Rig | File,
    settings: PipelineSettings | None = None,
    *,
    fps: float | None = None,
    backgrounds: Mapping[str, Array] | None = None,
) -> Tracks:
    """Return the tracks of a recording: detection, correspondence, triangulation and tracking of all its frames.

    Parameters
    ----------
    recording :
        Folder with ``recording.mcap``, or with a folder of numbered images or a video for each camera.
    rig :
        Calibrated cameras, or their file.
    settings :
        Of all stages.
    fps :
        Frame rate [1/s] where the recording has no times of its own.
    backgrounds : camera name -> (H, W)
        Static scene; subtracted from each image.

    Raises
    ------
    InputError
        Where the recording does not fit the rig.
    """
    cameras = rig if isinstance(rig, Rig) else read_rig(Path(rig))
    with open_recording(Path(recording), cameras, fps) as source:
        return table([step.samples for step in run(source, cameras, settings, backgrounds=backgrounds)])


def calibrate(
    recording: File,
    target: File,
    *,
    lens: Literal["mosca", "opencv", "fisheye"] | None = None,
    known: Rig | File | None = None,
    axes: tuple[File, File] | None = None,
    lengths: tuple[File, File] | None = None,
    fps: float | None = None,
    volume: Volume | None = None,
) -> Calibration:
    """Return the calibration of cameras from a recording of a target, checked: ``calibration.rig`` is the rig to use.

    Parameters
    ----------
    recording :
        Folder that shows the target in many poses.
    target :
        Target file (TOML): test field, board, wand or rigid body of markers.
    lens :
        Lens model to estimate; default: the one that predicts held-out views best.
    known :
        Earlier rig, or its file, which the new one is compared with.
    axes : (recording, target file)
        Those of the L-frame that sets the world axes.
    lengths : (recording, target file)
        Those of a certified scale bar that takes no part in the calibration.
    fps :
        Frame rate [1/s] where the recording has no times of its own; images of a target at rest need none.
    volume : (low (3,), high (3,)) [m, world]
        Volume that will be measured; default: where the target was.

    Raises
    ------
    CalibrationError
        Where the calibration must not be used.
    InputError
        Where files do not fit.
    """
    shown = read_target_file(Path(target))
    if isinstance(shown, PointsTarget):
        raise InputError(f"{target}: measured points need no recording; use 'mosca calibrate' for them")
    rig = known if known is None or isinstance(known, Rig) else read_rig(Path(known))
    box = None if volume is None else (tuple(np.asarray(volume[0], float)), tuple(np.asarray(volume[1], float)))
    calibration, _evidence = calibrate_session(
        Shown(shown, lambda given: open_recording(Path(recording), given, fps, times_matter=False)),
        EstimateSettings(LensChoice(lens or "mosca"), lens is None, volume=box),
        axes=None if axes is None else _shown(axes, LFrame, fps),
        lengths=None if lengths is None else _shown(lengths, ScaleBar, fps),
        known=rig,
        made_from=f"{recording} with {target}",
    )
    if calibration.refused:
        first = calibration.refused[0]
        raise CalibrationError(f"{recording}: {first.code}: {first.message}")
    return calibration


def _shown(files: tuple[File, File], kind: type[T], fps: float | None) -> Shown[T]:
    recording, path = Path(files[0]), Path(files[1])
    target = read_target_file(path)
    if not isinstance(target, kind):
        raise InputError(f"{path}: a {type(target).__name__} given; a {kind.__name__} is wanted")
    return Shown(target, lambda rig: open_recording(recording, rig, fps, times_matter=False))
