"""A ROS 2 bag: a folder with an MCAP file, written with mcap-ros2-support, and the metadata that ROS 2 tools need.

Topics: ``/markers`` (PointCloud2), ``/bodies/NAME/pose`` (PoseWithCovarianceStamped), ``/tf`` (bodies and cameras in
the frame "world"), ``/cameras/NAME/camera_info`` and ``/cameras/NAME/image_raw``. Metres and radians (REP 103); a
camera's frame is the optical one, x to the right, y down, z forward (REP 103), as everywhere in this project. Stamps
are the middle of the exposure on the session's clock.
"""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses
from mosca.data.files.whole_file import whole_folder, write_text
from mosca.data.frames import Frame, mid_exposure_ns
from mosca.data.rig import Camera
from mosca.data.rotations import quaternion_from_rotation
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.rigs.lens_conversion import Notes, RigFileOptions, opencv_parts
from mosca.formats.ros2.definitions import MESSAGES, definition

WORLD = "world"
POINT = np.dtype(
    [("xyz", "<f4", 3), ("track", "<u4"), ("covariance", "<f4", 6), ("cameras", "<u4"), ("measured", "<u4")]
)
"""A marker: position [m], track, covariance xx, xy, xz, yy, yz, zz [m2], number of cameras, 1 where measured."""
_UINT32, _FLOAT32 = 6, 7
_UPPER = np.triu_indices(3)


class Bag:
    """Writer of the messages of one take; made by ``written_bag``."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._schemas = {name: writer.register_msgdef(name, definition(name)) for name in MESSAGES}
        self.counts: Counter[tuple[str, str]] = Counter()
        """Messages by topic and type."""
        self.span_ns = (0, 0)
        """First and last time of a message."""

    def add_markers(self, tracks: Tracks) -> None:
        """Write a point cloud for each frame set; withheld positions (NaN) are left out."""
        fields = _fields()
        tracks = tracks.select(np.flatnonzero(np.isfinite(tracks.xyz).all(axis=1)))
        for rows in _frames(tracks.frame):
            points = np.zeros(len(rows), POINT)
            points["xyz"], points["track"] = tracks.xyz[rows], tracks.track[rows]
            points["covariance"] = tracks.covariance[rows][:, _UPPER[0], _UPPER[1]]
            points["cameras"] = np.maximum(tracks.n_cameras[rows], 0)
            points["measured"] = tracks.status[rows] == "measured"
            time_ns = int(tracks.time_ns[rows[0]])
            cloud = {
                "header": _header(time_ns, WORLD),
                "height": 1,
                "width": len(rows),
                "fields": fields,
                "is_bigendian": False,
                "point_step": POINT.itemsize,
                "row_step": POINT.itemsize * len(rows),
                "data": points.tobytes(),
                "is_dense": True,
            }
            self._put("/markers", "sensor_msgs/msg/PointCloud2", cloud, time_ns)

    def add_bodies(self, poses: BodyPoses) -> None:
        """Write each pose with its covariance, and also as a transform; withheld poses are left out."""
        poses_there = np.flatnonzero(np.isfinite(poses.position).all(axis=1))
        for k in poses_there.tolist():
            time_ns, name = int(poses.time_ns[k]), str(poses.body[k])
            place, turn = _vector(poses.position[k]), _quaternion(poses.quaternion[k])
            pose = {"position": place, "orientation": turn}
            stated = {"pose": pose, "covariance": poses.covariance[k].ravel().tolist()}
            message = {"header": _header(time_ns, WORLD), "pose": stated}
            self._put(f"/bodies/{name}/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", message, time_ns)
            self._put_transform(time_ns, name, place, turn)

    def add_camera(self, camera: Camera, times_ns: Iterable[int], options: RigFileOptions) -> Notes:
        """Write a camera's properties and pose at each time; return notes on a lens that was fitted.

        InputError where the lens cannot be put in ROS's models within ``options.max_residual_px``.
        """
        matrix, coefficients, fisheye, notes = opencv_parts(camera, options)
        model = "equidistant" if fisheye else "plumb_bob" if len(coefficients) == 5 else "rational_polynomial"
        pose = camera.world_from_camera
        place, turn = _vector(pose.translation), _quaternion(quaternion_from_rotation(pose.rotation))
        properties = {
            "height": camera.height,
            "width": camera.width,
            "distortion_model": model,
            "d": list(map(float, coefficients)),
            "k": matrix.ravel().tolist(),
            "r": np.eye(3).ravel().tolist(),
            "p": np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
            "binning_x": 0,
            "binning_y": 0,
            "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
        }
        for time_ns in times_ns:
            message = {"header": _header(time_ns, camera.name), **properties}
            self._put(f"/cameras/{camera.name}/camera_info", "sensor_msgs/msg/CameraInfo", message, time_ns)
            self._put_transform(time_ns, camera.name, place, turn)
        return notes

    def add_image(self, frame: Frame) -> bool:
        """Write a frame's image; return whether it has one."""
        image, time_ns = frame.image, mid_exposure_ns(frame)
        if image is None:
            return False
        message = {
            "header": _header(time_ns, frame.camera),
            "height": image.shape[0],
            "width": image.shape[1],
            "encoding": "mono8" if image.dtype == np.uint8 else "mono16",
            "is_bigendian": 0,
            "step": image.shape[1] * image.dtype.itemsize,
            "data": np.ascontiguousarray(image, image.dtype.newbyteorder("<")).tobytes(),
        }
        self._put(f"/cameras/{frame.camera}/image_raw", "sensor_msgs/msg/Image", message, time_ns)
        return True

    def _put_transform(self, time_ns: int, child: str, place: Mapping[str, float], turn: Mapping[str, float]) -> None:
        transform = {"translation": place, "rotation": turn}
        one = {"header": _header(time_ns, WORLD), "child_frame_id": child, "transform": transform}
        self._put("/tf", "tf2_msgs/msg/TFMessage", {"transforms": [one]}, time_ns)

    def _put(self, topic: str, message: str, content: Mapping[str, Any], time_ns: int) -> None:
        log_ns = max(time_ns, 0)  # MCAP's times are unsigned
        self._writer.write_message(topic, self._schemas[message], content, log_time=log_ns)
        first, last = self.span_ns if self.counts else (log_ns, log_ns)
        self.span_ns = min(first, log_ns), max(last, log_ns)
        self.counts[topic, message] += 1


@contextmanager
def written_bag(path: Path) -> Iterator[Bag]:
    """Yield a bag that appears as the folder ``path`` when the body ends without an error.

    InputError where mcap-ros2-support is not installed, or ``path`` is there already or cannot be written.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError:
        raise InputError("mcap-ros2-support is not installed: pip install 'mosca-testbench[ros]'") from None
    with whole_folder(path) as part:
        name = f"{path.name}_0.mcap"
        with (part / name).open("wb") as file:
            writer = Writer(file)
            bag = Bag(writer)
            yield bag
            writer.finish()
        write_text(part / "metadata.yaml", _metadata(bag, name))


def _metadata(bag: Bag, name: str) -> str:
    """Return the text of metadata.yaml, version 5 of its form; JSON is YAML, too."""
    first, last = bag.span_ns
    span = {"duration": {"nanoseconds": last - first}, "starting_time": {"nanoseconds_since_epoch": first}}
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": message,
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": count,
        }
        for (topic, message), count in sorted(bag.counts.items())
    ]
    total = bag.counts.total()
    content = {
        "version": 5,
        "storage_identifier": "mcap",
        **span,
        "message_count": total,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [name],
        "files": [{"path": name, **span, "message_count": total}],
    }
    return json.dumps({"rosbag2_bagfile_information": content}, indent=2) + "\n"


def _frames(numbers: Array) -> Iterator[Array]:
    """Yield the rows of each frame; ``numbers`` (n,) rise."""
    for rows in np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(numbers)) + 1):
        if len(rows):
            yield rows


def _fields() -> list[dict[str, Any]]:
    """Return the point cloud's fields as ROS states them: x, y, z and further ones, each by name and offset."""
    assert POINT.fields is not None
    out = []
    for name, (kind, start) in ((name, entry[:2]) for name, entry in POINT.fields.items()):
        base, count = (kind.subdtype[0], kind.shape[0]) if kind.subdtype else (kind, 1)
        datatype = _FLOAT32 if base == np.dtype("<f4") else _UINT32
        parts = (
            [(axis, start + 4 * k, 1) for k, axis in enumerate("xyz")] if name == "xyz" else [(name, start, count)]
        )
        out += [{"name": n, "offset": o, "datatype": datatype, "count": c} for n, o, c in parts]
    return out


def _header(time_ns: int, frame: str) -> dict[str, Any]:
    sec, nanosec = divmod(time_ns, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def _vector(xyz: Array) -> dict[str, float]:
    return dict(zip("xyz", map(float, xyz), strict=True))


def _quaternion(wxyz: Array) -> dict[str, float]:
    return dict(zip("wxyz", map(float, wxyz), strict=True))
