"""Image points that were detected elsewhere -> detections of each camera, with or without names."""

import numpy as np

from mosca.continuous.association.associate import Associated, AssociationSettings, check_long_enough
from mosca.continuous.association.coarse_sync import common_clock, tied_clocks
from mosca.continuous.association.frame_detections import FEWEST_FRAMES, CameraDetections, FrameCount
from mosca.continuous.model.observations import TimedObservations, no_carriers
from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.formats.image_points import ImagePointTable

LEAST_PX = 1e-3
"""Standard deviation of image points where none is stated [px]: their whole error is then learned from residuals."""
DIAMETER_PX = 1.0
"""Diameter assumed for image points [px]: a table has none."""


def seen_in_table(table: ImagePointTable, rig: Rig) -> tuple[tuple[CameraDetections, ...], tuple[Array, ...]]:
    """Return the detections of the rig's cameras from a table, and the names (n,) of each camera's image points.

    InputError for a camera that is missing in the rig or in the table, or that has too few frames.
    """
    given = set(table.camera.tolist())
    for name in sorted(given - set(rig.names)):
        raise InputError(f"{table.path}: camera '{name}' is not in the rig, which has {', '.join(rig.names)}")
    found, names = [], []
    for camera in rig.cameras:
        own = np.flatnonzero(table.camera == camera.name)
        frame_ns, start = np.unique(table.time_ns[own], return_index=True)
        if len(frame_ns) < FEWEST_FRAMES:
            raise InputError(
                f"{table.path}: camera '{camera.name}' has {len(frame_ns)} frames with points, {FEWEST_FRAMES} are "
                "needed; give more, or leave the camera out of the rig file"
            )
        sigma = np.where(np.isfinite(table.sigma_px[own]), table.sigma_px[own], LEAST_PX)
        each = np.ones(len(own))
        rate_hz = 1e9 / float(np.median(np.diff(frame_ns)))
        found.append(
            CameraDetections(
                CameraInfo(camera.name, camera.width, camera.height, 8, rate_hz),
                frame_ns,
                np.append(start, len(own)),
                table.xy_px[own],
                sigma[:, None, None] ** 2 * np.eye(2),
                DIAMETER_PX * each,
                each,
                each,
                np.zeros(len(own), np.uint8),
            )
        )
        names.append(table.point[own])
    return tuple(found), tuple(names)


def gather_named(
    seen: tuple[CameraDetections, ...], names: tuple[Array, ...], rig: Rig, settings: AssociationSettings
) -> Associated:
    """Return image points with given names as observations on a common clock, without starting curves.

    ``names``: (n,) for each camera's image points. InputError: see ``associate``.
    """
    for one in seen:
        check_long_enough(one)
    points, numbers = np.unique(np.concatenate(names), return_inverse=True)
    of = np.split(numbers, np.cumsum([len(one) for one in names])[:-1])
    own = settings.clocks == "own"
    ties = tied_clocks(seen, of, rig, settings.search_s) if own else common_clock(seen)
    sigma_px = np.full(len(seen), settings.pipeline.match.camera_sigma_px)
    parts = [
        (np.full(len(p), c), p, one.frame, tie.common_s(one.time_s(tie.origin_ns)), one.xy_px, one.covariance_px2)
        for c, (one, tie, p) in enumerate(zip(seen, ties, of, strict=True))
    ]
    camera, point, exposure, time_s, xy, covariance = (np.concatenate(part) for part in zip(*parts, strict=True))
    label = tuple(str(name) for name in points)
    whole = covariance + sigma_px[camera, None, None] ** 2 * np.eye(2)
    found = TimedObservations(rig.names, label, camera, point, exposure, time_s, xy, whole, **no_carriers(label))
    row = np.concatenate([np.arange(len(p)) for p in of])
    count = FrameCount({one.info.name: len(one.frame_ns) for one in seen})
    return Associated(found, row, None, ties, seen, sigma_px, count, own)
