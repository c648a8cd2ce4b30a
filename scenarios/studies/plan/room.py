"""The planner's input from a plan file: points of the volume, mounts, obstacles and camera options."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import qmc

from mosca.accuracy.planning.cut_discs import WornMarkers
from mosca.accuracy.planning.field_calibration import FieldSession
from mosca.accuracy.planning.image_noise import PixelNoiseModel, information_table
from mosca.accuracy.planning.layout import CameraOption, MountingPlace
from mosca.accuracy.planning.obstacles import Obstacle, distances_to, obstacle_rows
from mosca.accuracy.planning.views import MarkerRoom
from mosca.data.arrays import Array
from mosca.data.rig import Pose
from mosca.data.rotations import rotation_from_vector
from mosca.errors import InputError
from scenarios.spec.plan import CameraModelSpec, ImagesSpec, PlanFile, RoomSpec
from twin.cameras.library import sensor

WALL_M = 0.02
"""Thickness of a room's walls, outside of its corners."""
FIELD_SHARE = 1.1
"""Edges of the calibration's field over those of the volume, as in a scenario's ``[calibration]``."""
FACING_COSINE = 0.3
"""Least cosine of the viewing angle of a coded target, which is read up to about 70 deg from its normal
(``docs/detection.md``: thinner ellipses are not decoded)."""


def bounding_box(plan: PlanFile) -> tuple[Array, Array]:
    """Return centre and edges (3,) [m] of the upright box around the volume."""
    given = plan.volume
    if given.size_m is not None:
        return np.array(given.center_m), np.array(given.size_m)
    corners = np.array(given.corners_m)
    low = np.array([*corners.min(axis=0), given.heights_m[0]])  # type: ignore[index]
    high = np.array([*corners.max(axis=0), given.heights_m[1]])  # type: ignore[index]
    return (low + high) / 2, high - low


def points_in(plan: PlanFile, count: int, seed: int) -> Array:
    """Return ``count`` points (n, 3) [m] of the volume outside obstacles, evenly spread (scrambled Halton points).

    InputError where obstacles fill the volume.
    """
    center, size = bounding_box(plan)
    bodies = obstacle_rows(obstacles_of(plan))
    draw = qmc.Halton(3, seed=seed)
    found = np.empty((0, 3))
    for _ in range(20):
        points = center + size * (draw.random(2 * count) - 0.5)
        if plan.volume.corners_m is not None:
            points = points[inside_polygon(np.array(plan.volume.corners_m), points[:, :2])]
        points = points[distances_to(bodies, points) > plan.volume.marker_diameter_m]
        found = np.concatenate([found, points])
        if len(found) >= count:
            return found[:count]
    raise InputError("[[obstacle]]: they leave less than a fortieth of [volume] free; make it larger or move them")


def inside_polygon(corners: Array, xy: Array) -> Array:
    """Return whether points (n, 2) lie inside a polygon (k, 2), by the even-odd rule (n,) bool."""
    x0, y0 = corners.T
    x1, y1 = np.roll(corners, -1, axis=0).T
    x, y = xy[:, :1], xy[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        crosses = ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return np.asarray(crosses.sum(axis=1) % 2 == 1)


def normals_of(plan: PlanFile) -> Array:
    """Return the directions (k, 3) in which a subject's markers face; none without a subject."""
    if plan.subject is None:
        return np.empty((0, 3))
    angle = 2 * np.pi * np.arange(plan.subject.directions) / plan.subject.directions
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])


def worn_markers_of(plan: PlanFile) -> WornMarkers | None:
    """Return the balls on the subject, which is as high as the volume; None without a subject."""
    if plan.subject is None:
        return None
    center, size = bounding_box(plan)
    low, high = center[2] - size[2] / 2, center[2] + size[2] / 2
    return WornMarkers(plan.volume.marker_diameter_m / 2, plan.subject.radius_m, float(low), float(high))


def room_of(plan: PlanFile, points: Array, normals: Array | None = None) -> MarkerRoom:
    """Return the room with these ``points`` (n, 3) of the volume; ``normals``: default, all of the subject."""
    tables = [information_table(_noise(one, plan.images)) for one in plan.camera]
    normals = normals_of(plan) if normals is None else normals
    rows = obstacle_rows(obstacles_of(plan))
    return MarkerRoom(points, normals, bounding_box(plan)[0], plan.volume.marker_diameter_m, rows, np.array(tables))


def options_of(plan: PlanFile, calibration_px: float = 0.0) -> tuple[CameraOption, ...]:
    """Return each camera with each of its lenses; ``calibration_px``: rms calibration error on each axis [px]."""
    images = plan.images
    extra = float(np.sqrt(images.body_px**2 + images.lens_px**2 + calibration_px**2))
    found = []
    for table, one in enumerate(plan.camera):
        width, height, pitch_mm = chip_of(one)
        found += [
            CameraOption(
                one.model, width, height, pitch_mm, focal, one.price, one.f_number, images.psf_sigma_px, extra, table
            )
            for focal in one.focal_lengths_mm
        ]
    return tuple(found)


def chip_of(one: CameraModelSpec) -> tuple[int, int, float]:
    """Return width and height [px] and pixel pitch [mm] of a camera."""
    if one.sensor is not None:
        chip = sensor(one.sensor)
        return chip.width, chip.height, chip.pixel_pitch_um * 1e-3
    assert one.size_px is not None
    assert one.pixel_pitch_mm is not None
    return (*one.size_px, one.pixel_pitch_mm)


def mounts_of(plan: PlanFile) -> tuple[MountingPlace, ...]:
    """Return all possible positions of cameras."""
    found = [
        MountingPlace(np.array(one.from_m), np.array(one.to_m) - np.array(one.from_m), np.zeros(3))
        for one in plan.rail
    ]
    for wall in plan.wall:
        found.append(_upright(np.array(wall.from_m), np.array(wall.to_m), wall.heights_m))
    if plan.room is not None and plan.room.mount_heights_m is not None:
        gap, corners = plan.room.gap_m, np.array(plan.room.corners_m)
        for start, end, inward in _edges(plan.room):
            along = (end - start) / np.linalg.norm(end - start)
            if np.linalg.norm(end - start) > 4 * gap:
                one, other = start + gap * (inward + along), end + gap * (inward - along)
                if inside_polygon(corners, np.array([one, other])).all():
                    found.append(_upright(one, other, plan.room.mount_heights_m))
    if not found:
        raise InputError("room.corners_m: no wall is longer than four times room.gap_m; make the room larger")
    return tuple(found)


def keep_out_of(plan: PlanFile) -> Array:
    """Return the bodies (b, 9) in which no camera may stand: obstacles, and the box around the volume."""
    center, size = bounding_box(plan)
    bodies = [Obstacle(one.kind, one.center_m, one.size_m, one.yaw_deg) for one in plan.obstacle]
    return obstacle_rows([*bodies, Obstacle("box", tuple(center), tuple(size))])


def session_of(plan: PlanFile, places: Array, seed: int) -> FieldSession:
    """Return the calibration session of the scenario, as far as it is known beforehand: marks spread over the sides
    of a field, drawn stands; ``places`` (c, 3): positions of the cameras [m].
    """
    given, draw = plan.calibration, np.random.default_rng(seed)
    center, size = bounding_box(plan)
    size = FIELD_SHARE * size
    marks = size * (draw.random((given.markers, 3)) - 0.5)
    outward = np.column_stack([marks[:, 0] / size[0], marks[:, 1] / size[1], np.zeros(len(marks))])
    outward[::3] = [0.0, 0.0, 1.0]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    stands, seen = [Pose(np.eye(3), center)], []
    for _ in range(given.stands - 1):
        axis = draw.standard_normal(3) * [1, 1, 0]
        lean = axis / np.linalg.norm(axis) * np.deg2rad(given.tilt_deg) * draw.random()
        spin = np.array([0.0, 0.0, draw.uniform(0, 2 * np.pi)])
        rotation = rotation_from_vector(lean) @ rotation_from_vector(spin)
        stands.append(Pose(rotation, center + given.shift * size * (draw.random(3) - 0.5) * 2))
    for place in places:
        away = [place - one.transform(marks) for one in stands]
        seen.append(
            [((v * (outward @ one.rotation.T)).sum(axis=1) > FACING_COSINE * np.linalg.norm(v, axis=1)) for v, one in
             zip(away, stands, strict=True)]
        )  # fmt: skip
    frames = (max(given.frames, given.world_frames), *[given.frames] * (given.stands - 1))
    images = plan.images
    return FieldSession(
        marks, tuple(stands), frames, np.array(seen), images.body_px, images.lens_px, images.body_px,
        given.known_to * float(size.max()),
    )  # fmt: skip


def obstacles_of(plan: PlanFile) -> list[Obstacle]:
    """Return the bodies that hide markers: obstacles, and the walls of a room that is not convex."""
    found = [Obstacle(one.kind, one.center_m, one.size_m, one.yaw_deg) for one in plan.obstacle]
    room = plan.room
    if room is None or is_convex(np.array(room.corners_m)):
        return found
    for start, end, inward in _edges(room):
        middle = (start + end) / 2 - inward * WALL_M / 2
        along = end - start
        size = (float(np.linalg.norm(along)), WALL_M, room.height_m)
        yaw = float(np.degrees(np.arctan2(along[1], along[0])))
        found.append(Obstacle("box", (middle[0], middle[1], room.height_m / 2), size, yaw))
    return found


def is_convex(corners: Array) -> bool:
    """Return whether a polygon (k, 2) is convex."""
    ahead = np.roll(corners, -1, axis=0) - corners
    after = np.roll(ahead, -1, axis=0)
    turns = ahead[:, 0] * after[:, 1] - ahead[:, 1] * after[:, 0]
    return bool((turns >= -1e-9).all() or (turns <= 1e-9).all())


def _edges(room: RoomSpec) -> list[tuple[Array, Array, Array]]:
    """Return start, end and inward unit normal (2,) of each wall."""
    corners = np.array(room.corners_m, dtype=float)
    x, y = corners.T
    area = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    if area == 0:
        raise InputError("room.corners_m: they enclose no area; give them in order")
    if area < 0:
        corners = corners[::-1]
    edges = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / np.linalg.norm(end - start)
        edges.append((start, end, np.array([-along[1], along[0]])))
    return edges


def _upright(start: Array, end: Array, heights: Sequence[float]) -> MountingPlace:
    low, high = heights
    return MountingPlace(np.array([*start, low]), np.array([*(end - start), 0.0]), np.array([0.0, 0.0, high - low]))


def _noise(one: CameraModelSpec, images: ImagesSpec) -> PixelNoiseModel:
    well, read, bits = one.full_well_e, one.read_noise_e, one.bits
    if one.sensor is not None:
        chip = sensor(one.sensor)
        well, read, bits = chip.full_well_e, chip.read_noise_e, chip.bits
    return PixelNoiseModel(images.marker_signal * well, images.background_e, read, well / (2**bits - 1))
