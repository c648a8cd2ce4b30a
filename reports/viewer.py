"""A run for the Rerun viewer (.rrd): cameras, images, detections, tracks and truth on one timeline.

Only this module imports rerun, and only inside functions: everything else runs without it. Timelines:
"session" (time from session start) and "frame" (pulse number). Entities:

    world/working_space              its edges
    world/cameras/NAME               pose; .../image: pinhole, JPEG frames; .../image/detections: 2D points
    world/points                     reconstructed points with names, coloured by error or stated deviation
    world/trails                     the last half second of each
    plots/...                        errors [mm], counts: the same timelines
    legend                           meaning of the colours
    world/truth                      true positions of the markers
    world/skeleton/joints, bones     a person's joint centres, and lines between them
    world/true_skeleton/...          true positions of these
    world/objects/NAME               a body of a second scene: pose; .../partK: its shape; .../status

Rerun has pinhole cameras only. Images and detections are shown with their distortion, so that 3D points in a camera's
view are off by its distortion (they are exact in the 3D view).
"""

import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.files.whole_file import check_writable
from mosca.data.joint_motion import JointMotion
from mosca.data.rig import Camera, Rig, principal_distances_px, principal_point_px
from mosca.errors import InputError
from reports.bones import strips
from reports.viewer_colours import (
    LINE_SHARE,
    POINT_SHARE,
    TRAIL_S,
    TRUE_POINT,
    TRUE_SHARE,
    Trails,
    coloured,
    scale_top,
)

APPLICATION = "mosca"
JPEG_QUALITY = 75
"""Frames are for viewing here, not for measuring: JPEG takes a sixth of the bytes of PNG."""
CAMERA_SHARE = 0.12
"""Length of a camera's cone as a share of the scene's diagonal."""
MOST_BESIDE = 9
"""Most cameras that are shown side by side; more are shown one behind the other."""
PERSON_M = 2.0
"""Size of a scene without known cameras and working space: that of a person who stands in it."""


class RerunLog:
    """An .rrd file that grows step by step: use it in a ``with`` block, or call ``close``.

    ``working_space``: (center (3,), size (3,)) of its box in the world [m], or None. Raises InputError
    where rerun is not installed or ``path``'s folder does not exist.
    """

    def __init__(self, path: Path, rig: Rig, working_space: tuple[Array, Array] | None = None) -> None:
        if not path.parent.is_dir():
            raise InputError(f"{path}: no folder {path.parent} to write it in; make it first")
        self._rr = _rerun()
        self._rig = rig
        # An id of its own: the viewer merges files with the same id.
        self._stream = self._rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4(), send_properties=False)
        self._stream.set_log_time_enabled(False)
        self._stream.save(path, default_blueprint=_blueprint(rig))
        self._closed = False
        self._diagonal = _diagonal(rig, working_space)
        self._trails = Trails()
        self._sigma_top_mm: float | None = None
        self._log_still("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        if working_space is not None:
            center, size = (np.asarray(v, dtype=np.float64) for v in working_space)
            box = self._rr.Boxes3D(
                centers=[center], sizes=[size], colors=[(230, 159, 0)], fill_mode="majorwireframe",
                radii=LINE_SHARE * self._diagonal,
            )  # fmt: skip
            self._log_still("world/working_space", box)
        for camera in rig.cameras:
            self._log_camera(camera)

    def log_step(
        self,
        frame: int,
        time_ns: int,
        images: Mapping[str, Array] | None = None,
        detections: Mapping[str, Detections] | None = None,
        points_xyz: Array | None = None,
        track_ids: Array | None = None,
        sigma_m: Array | None = None,
    ) -> None:
        """Log one pulse. ``points_xyz`` (n, 3) world [m], ``track_ids`` (n,) their identities.

        ``sigma_m`` (n,): their stated standard deviations in 3D, by which they are coloured; else each track has its
        colour. Values that are None or absent leave the last view unchanged; empty arrays clear it.
        """
        self.set_time(frame, time_ns)
        for name, image in (images or {}).items():
            self._stream.log(f"{_entity(self._rig.camera(name))}/image", self._compressed(image))
        for name, found in (detections or {}).items():
            points = self._rr.Points2D(
                found.xy_px, radii=np.maximum(found.diameter_px / 2, 2.0), colors=[(255, 157, 46)]
            )
            self._stream.log(f"{_entity(self._rig.camera(name))}/image/detections", points)
            self.log_plots({f"detections/{name}": len(found)})
        if points_xyz is not None:
            ids = np.arange(len(points_xyz)) if track_ids is None else np.asarray(track_ids)
            names = [f"track {one}" for one in ids.tolist()]
            self.log_points(frame, time_ns, points_xyz, ids, self._colours(ids, sigma_m), names)
            self.log_plots({"points/measured": len(points_xyz)})
            if sigma_m is not None and len(sigma_m):
                self.log_plots({"sigma/rms": 1e3 * float(np.sqrt(np.mean(np.square(sigma_m))))})

    def log_points(
        self, frame: int, time_ns: int, xyz: Array, ids: Array, colours: Array, names: Sequence[str]
    ) -> None:
        """Log all points of one pulse (n, 3) [m] with their tracks (n,), colours (n, 3) uint8, names, and trails."""
        self.set_time(frame, time_ns)
        radius = POINT_SHARE * self._diagonal
        points = self._rr.Points3D(xyz, radii=radius, colors=colours, labels=list(names))
        values = [self._rr.AnyValues(track=np.asarray(ids, dtype=np.int64))] if len(xyz) else []
        self._stream.log("world/points", points, *values)
        paths = self._trails.step(time_ns, xyz, ids)
        lines = self._rr.LineStrips3D(paths, radii=LINE_SHARE * self._diagonal, colors=colours)
        self._stream.log("world/trails", lines)

    def log_plots(self, values: Mapping[str, float]) -> None:
        """Log figures at the instant set last: path below ``plots`` (names are escaped here) -> value."""
        for path, value in values.items():
            kind, _, name = path.partition("/")
            self._stream.log(f"plots/{kind}/{self._rr.escape_entity_path_part(name)}", self._rr.Scalars(value))

    def log_scale(self, what: str, top_mm: float, truth: bool) -> None:
        """Log the scale of colours, 0 to ``top_mm`` of ``what``; ``truth``: true points and ghosts are shown."""
        text = f"**Colour of a point:** {what}, from 0 (dark violet) over {top_mm / 2:g} mm (green) to {top_mm:g} mm "
        text += "and more (yellow)." + ("" if truth else " No truth is known here.")
        if truth:
            text += (
                "\n\n**Pink:** a measured point that belongs to no marker. **Grey:** where a marker really was, and "
            )
            text += "no point covers it."
        text += f"\n\n**Lines behind points:** the last {TRAIL_S:g} s of each track; cut where it was not measured."
        self._log_still("legend", self._rr.TextDocument(text, media_type="text/markdown"))

    def log_truth(self, frame: int, time_ns: int, xyz: Array) -> None:
        """Log the true positions of markers (m, 3) at one pulse; rows of NaN are left out."""
        self.set_time(frame, time_ns)
        there = np.asarray(xyz)[np.isfinite(xyz).all(axis=1)]
        points = self._rr.Points3D(there, radii=TRUE_SHARE * self._diagonal, colors=[TRUE_POINT])
        self._stream.log("world/truth", points)

    def log_skeleton(self, frame: int, time_ns: int, joints: JointMotion | None, true: bool = False) -> None:
        """Log a person's joint centres and bones at one pulse, the first instant of ``joints``; None clears them.

        ``true``: whether these are the true ones, drawn in grey.
        """
        self.set_time(frame, time_ns)
        entity, colour = ("true_skeleton", (120, 130, 140)) if true else ("skeleton", (0, 158, 115))
        centre = np.empty((0, 3)) if joints is None else joints.centre[0]
        names = () if joints is None else joints.joints
        known = np.flatnonzero(np.isfinite(centre).all(axis=1))
        there = [names[k] for k in known]
        points = self._rr.Points3D(centre[known], radii=0.012, colors=[colour], labels=there, show_labels=False)
        self._stream.log(f"world/{entity}/joints", points)
        lines = self._rr.LineStrips3D(strips(names, centre), radii=0.006, colors=[colour])
        self._stream.log(f"world/{entity}/bones", lines)

    def log_object_mesh(self, name: str, number: int, vertices: Array, triangles: Array, colour: Array) -> None:
        """Log a part of a virtual object: (v, 3) in its own frame [m], (f, 3), colour (4,) from 0 to 1."""
        normals = _vertex_normals(vertices, triangles)
        mesh = self._rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=triangles, vertex_normals=normals,
            albedo_factor=(255 * np.asarray(colour)).astype(np.uint8),
        )  # fmt: skip
        self._log_still(f"{_object_entity(name)}/part{number}", mesh)

    def log_objects(self, time_ns: int, placed: Mapping[str, tuple[Array, Array]], status: Mapping[str, str]) -> None:
        """Log the poses of virtual objects at one display: rotation (3, 3) and position (3,) [m] in the world.

        ``status``: status in words of the objects that follow a body.
        """
        self._stream.reset_time()
        self._stream.set_time("session", duration=np.timedelta64(int(time_ns), "ns"))
        for name, (rotation, position) in placed.items():
            self._stream.log(_object_entity(name), self._rr.Transform3D(translation=position, mat3x3=rotation))
        for name, words in status.items():
            self._stream.log(f"{_object_entity(name)}/status", self._rr.TextLog(words))

    def close(self) -> None:
        """Write remaining data and finish the file; may be called twice."""
        if not self._closed:
            self._closed = True
            self._stream.disconnect()

    def __enter__(self) -> "RerunLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def set_time(self, frame: int, time_ns: int) -> None:
        """Set the instant of the next logged data: the pulse, and its time from session start [ns]."""
        self._stream.set_time("session", duration=np.timedelta64(int(time_ns), "ns"))
        self._stream.set_time("frame", sequence=int(frame))

    def _log_still(self, entity: str, what: Any) -> None:
        self._stream.log(entity, what, static=True)

    def _log_camera(self, camera: Camera) -> None:
        pose = camera.world_from_camera
        transform = self._rr.Transform3D(translation=pose.translation, mat3x3=pose.rotation)
        self._log_still(_entity(camera), transform)
        (fx, fy), (cx, cy) = principal_distances_px(camera.lens), principal_point_px(camera.lens)
        # Rerun has pixel centres at +0.5, this project at 0.
        pinhole = self._rr.Pinhole(
            focal_length=[fx, fy],
            principal_point=[cx + 0.5, cy + 0.5],
            resolution=[camera.width, camera.height],
            camera_xyz=self._rr.ViewCoordinates.RDF,
            image_plane_distance=CAMERA_SHARE * self._diagonal,
        )
        self._log_still(f"{_entity(camera)}/image", pinhole)

    def _colours(self, ids: Array, sigma_m: Array | None) -> Array:
        """Return colours (n, 3) by deviation, on the scale of the first points with deviations; else by track."""
        if sigma_m is None:
            return _track_colours(ids)
        if self._sigma_top_mm is None and len(sigma_m):
            self._sigma_top_mm = scale_top(2e3 * np.asarray(sigma_m))
            self.log_scale("stated standard deviation, 3D", self._sigma_top_mm, False)
        return coloured(1e3 * np.asarray(sigma_m), self._sigma_top_mm or 1.0)

    def _compressed(self, image: Array) -> Any:
        return self._rr.Image(_eight_bits(image)).compress(jpeg_quality=JPEG_QUALITY)


def check_rrd(path: Path | None) -> None:
    """Raise InputError where ``path`` is no .rrd file that can be written, or rerun is missing; None is allowed."""
    if path is None:
        return
    if path.suffix.lower() != ".rrd":
        raise InputError(f"{path}: suffix '{path.suffix}' given; a recording for the Rerun viewer is an .rrd file")
    check_writable(path)
    _rerun()


def _rerun() -> Any:
    try:
        import rerun
    except ModuleNotFoundError:
        raise InputError("--rrd: rerun is not installed; run: pip install rerun-sdk") from None
    return rerun


def _blueprint(rig: Rig) -> Any:
    """Return the viewer's layout: the world above plots and legend, beside the cameras."""
    from rerun import blueprint

    images = [blueprint.Spatial2DView(origin=f"{_entity(camera)}/image", name=camera.name) for camera in rig.cameras]
    world = blueprint.Spatial3DView(origin="world", name="world")
    plots = [
        blueprint.TimeSeriesView(origin=f"plots/{kind}", name=name)
        for kind, name in (
            ("error", "error [mm]"), ("markers", "error of each marker [mm]"), ("sigma", "stated deviation [mm]"),
            ("points", "points"), ("detections", "detections by camera"),
        )
    ]  # fmt: skip
    below = blueprint.Horizontal(
        blueprint.Tabs(*plots), blueprint.TextDocumentView(origin="legend", name="colours"), column_shares=[3, 1]
    )
    left = blueprint.Vertical(world, below, row_shares=[3, 1])
    views = blueprint.Grid(*images) if len(images) <= MOST_BESIDE else blueprint.Tabs(*images)
    return blueprint.Blueprint(
        blueprint.Horizontal(left, views, column_shares=[3, 2]) if images else left, collapse_panels=True
    )


def _diagonal(rig: Rig, working_space: tuple[Array, Array] | None) -> float:
    """Return the size of the scene [m]: diagonal of the working space, else half that of the cameras' positions."""
    if working_space is not None:
        return float(np.linalg.norm(working_space[1]))
    at = np.array([camera.world_from_camera.translation for camera in rig.cameras]).reshape(-1, 3)
    span = float(np.linalg.norm(np.ptp(at, axis=0))) / 2 if len(at) > 1 else 0.0
    return span or PERSON_M


def _entity(camera: Camera) -> str:
    from rerun import escape_entity_path_part

    return f"world/cameras/{escape_entity_path_part(camera.name)}"


def _object_entity(name: str) -> str:
    from rerun import escape_entity_path_part

    return f"world/objects/{escape_entity_path_part(name)}"


def _vertex_normals(vertices: Array, triangles: Array) -> Array:
    """Return unit normals (v, 3): means of the triangles around each vertex, weighted by area."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.zeros_like(vertices, dtype=np.float64)
    for k in range(3):
        np.add.at(normals, triangles[:, k], np.cross(b - a, c - a))
    result: Array = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return result


def _eight_bits(image: Array) -> Array:
    """Return ``image`` (H, W) as uint8; 16-bit images are divided by the power of two that their maximum requires."""
    if image.dtype == np.uint8:
        return image
    return (image >> max(0, int(image.max()).bit_length() - 8)).astype(np.uint8)


def _track_colours(ids: Array) -> Array:
    """Return a colour (n, 3) uint8 for each identity: hues a golden angle apart, so neighbours differ."""
    hue = (np.asarray(ids, dtype=np.float64) * 0.61803398875) % 1.0
    waves = 0.5 + 0.5 * np.cos(2 * np.pi * (hue[:, None] - np.array([0.0, 1 / 3, 2 / 3])))
    result: Array = (60 + 190 * waves).astype(np.uint8)
    return result
