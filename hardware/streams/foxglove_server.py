"""A websocket server for Foxglove: a point cloud, poses, names in the scene, transforms and joint angles.

The protocol and its messages are those of the package ``foxglove``. Each client has a queue of ``backlog`` messages
whose oldest make room for new ones. Stamps are the middle of the exposure in time of day.
"""

import threading
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from hardware.streams.stream_server import Outgoing, StreamServer
from hardware.streams.values import TRACKED, StreamedBody, StreamedSkeleton, StreamFrame, StreamModel, StreamNames
from mosca.data.arrays import Array
from mosca.errors import InputError

WORLD = "world"
POINT = np.dtype([("position", "<f4", 3), ("id", "<u4"), ("params", "<u4")])
MARKER_M = 0.02
"""Size of a marker's sphere in the scene: the real size is not streamed."""
BODY_M = 0.05
RETURNS_S = 10.0
"""Longest time for which a restart tries to get its port again, since the SDK releases it with a delay."""


@dataclass(frozen=True)
class FoxgloveSettings:
    """Where it serves; port 0: a free one. ``backlog``: messages that may wait for a client."""

    address: str = "127.0.0.1"
    port: int = 8765
    name: str = "mosca"
    up: str = "z"
    backlog: int = 1024


def foxglove() -> Any:
    """Return the package foxglove-sdk; InputError in one line where it is not there."""
    try:
        import foxglove as found
        import foxglove.channels
        import foxglove.messages
        import foxglove.websocket
    except ImportError as error:
        raise InputError(f"--stream foxglove: {error}; pip install 'mosca-testbench[foxglove]'") from None
    return found


class FoxgloveServer(StreamServer):
    """Serves ``/markers``, ``/bodies``, ``/scene``, ``/tf``, ``/joint_angles`` and ``/frame``.

    Raises InputError where foxglove-sdk is missing or the port is not available.
    """

    def __init__(self, model: StreamModel, names: StreamNames, settings: FoxgloveSettings | None = None) -> None:
        super().__init__()
        self.settings = settings or FoxgloveSettings()
        self._label_of = {number: label for label, number in names.numbers.items()}
        self._angles = names.angles
        self._name_of = {one.number: one.name for one in model if isinstance(one, StreamedBody)}
        for skeleton in (one for one in model if isinstance(one, StreamedSkeleton)):
            self._name_of |= {skeleton.number << 16 | bone.number: bone.name for bone in skeleton.bones}
        self._sdk = foxglove()
        self._day_minus_host_ns = time.time_ns() - time.monotonic_ns()
        self._port = self.settings.port
        self._server: Any = None
        self._was_open = False
        self.listener = _Listener()
        self.start()

    @property
    def port(self) -> int:
        """The port that it listens at."""
        return self._port

    def where(self) -> str:
        """Return the address, units and axes as a line."""
        return f"Foxglove at ws://{self.settings.address}:{self._port}: metres, {self.settings.up} up"

    def connected(self) -> int:
        """Return how many clients subscribed to something."""
        return self.listener.clients()

    def start(self) -> None:
        """Open the port."""
        sdk, where = self._sdk, self.settings
        self._context = sdk.Context()
        until = time.monotonic() + (RETURNS_S if self._was_open else 0.0)
        while True:
            try:
                self._server = sdk.start_server(
                    name=where.name,
                    host=where.address,
                    port=self._port,
                    context=self._context,
                    server_listener=self.listener,
                    message_backlog_size=where.backlog,
                )
                break
            except Exception as error:  # the SDK's own types, which it does not promise
                if time.monotonic() > until:
                    raise InputError(
                        f"{where.address}:{self._port}: {error}; give an address of this machine and a free port"
                    ) from None
                time.sleep(0.01)
        self._was_open = True
        self._port = self._server.port
        made, own = sdk.channels, {"context": self._context}
        self._markers = made.PointCloudChannel("/markers", **own)
        self._bodies = made.PosesInFrameChannel("/bodies", **own)
        self._scene = made.SceneUpdateChannel("/scene", **own)
        self._tf = made.FrameTransformsChannel("/tf", **own)
        self._values = sdk.Channel("/joint_angles", message_encoding="json", **own)
        self._number = sdk.Channel("/frame", message_encoding="json", **own)

    def shut(self, why: str = "server restarted") -> None:
        """Close the port; may be called twice."""
        server, self._server = self._server, None
        if server is not None:
            server.stop()
            self.listener.forget()

    def deliver(self, outgoing: Outgoing) -> None:
        """Hand a frame's messages to the SDK, which queues them for each client."""
        if self.lost or self._server is None:
            return
        self.frames += 1
        frame, log_ns = outgoing.frame, outgoing.mid_ns + self._day_minus_host_ns
        stamp = self._sdk.messages.Timestamp(sec=log_ns // 10**9, nsec=log_ns % 10**9)
        bones = [bones for _, bones in frame.skeletons]
        poses = np.concatenate([frame.bodies, *bones]) if bones else frame.bodies
        poses = poses[(poses["params"] & TRACKED) != 0]
        self._markers.log(self._cloud(frame, stamp), log_time=log_ns)
        self._bodies.log(
            self._sdk.messages.PosesInFrame(
                timestamp=stamp,
                frame_id=WORLD,
                poses=[self._pose(one["position"], one["quaternion"]) for one in poses],
            ),
            log_time=log_ns,
        )
        self._scene.log(self._entities(frame, poses, stamp), log_time=log_ns)
        self._tf.log(self._transforms(poses, stamp), log_time=log_ns)
        if len(frame.angles):
            pairs = zip(self._angles, frame.angles.tolist(), strict=True)
            self._values.log({name: value for name, value in pairs if value == value}, log_time=log_ns)
        times = {"frame": frame.number, "take_s": frame.timestamp_s, "mid_exposure_ns": log_ns}
        self._number.log(times, log_time=log_ns)

    def lines(self) -> list[str]:
        """Return frames and subscriptions; the SDK does not report what a slow client lost."""
        return [f"Foxglove: {self.frames} frames, {self.listener.told()}"]

    def _cloud(self, frame: StreamFrame, stamp: Any) -> Any:
        sdk = self._sdk.messages
        points: Array = np.zeros(len(frame.markers), POINT)
        for name in ("position", "id", "params"):
            points[name] = frame.markers[name]
        kinds = sdk.PackedElementFieldNumericType
        fields = [sdk.PackedElementField(name=axis, offset=4 * k, type=kinds.Float32) for k, axis in enumerate("xyz")]
        for k, name in enumerate(("id", "params")):
            fields.append(sdk.PackedElementField(name=name, offset=12 + 4 * k, type=kinds.Uint32))
        return sdk.PointCloud(
            timestamp=stamp,
            frame_id=WORLD,
            pose=self._pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
            point_stride=POINT.itemsize,
            fields=fields,
            data=points.tobytes(),
        )

    def _parts(self, position: Any, xyzw: Any) -> tuple[Any, Any]:
        sdk = self._sdk.messages
        x, y, z = (float(value) for value in position)
        a, b, c, d = (float(value) for value in xyzw)
        return sdk.Vector3(x=x, y=y, z=z), sdk.Quaternion(x=a, y=b, z=c, w=d)

    def _pose(self, position: Any, xyzw: Any) -> Any:
        place, turn = self._parts(position, xyzw)
        return self._sdk.messages.Pose(position=place, orientation=turn)

    def _entities(self, frame: StreamFrame, poses: Array, stamp: Any) -> Any:
        """Return one entity: a sphere a marker and a cube a body, each with its name."""
        sdk = self._sdk.messages
        balls, cubes, texts = [], [], []
        for one in frame.markers:
            pose = self._pose(one["position"], (0.0, 0.0, 0.0, 1.0))
            size, white = sdk.Vector3(x=MARKER_M, y=MARKER_M, z=MARKER_M), sdk.Color(r=1.0, g=1.0, b=1.0, a=1.0)
            balls.append(sdk.SpherePrimitive(pose=pose, size=size, color=white))
            label = self._label_of.get(int(one["id"]))
            if label:
                texts.append(self._text(pose, label))
        for one in poses:
            pose = self._pose(one["position"], one["quaternion"])
            size, blue = sdk.Vector3(x=BODY_M, y=BODY_M, z=BODY_M), sdk.Color(r=0.2, g=0.5, b=1.0, a=0.6)
            cubes.append(sdk.CubePrimitive(pose=pose, size=size, color=blue))
            texts.append(self._text(pose, self._name_of[int(one["id"])]))
        entity = sdk.SceneEntity(
            timestamp=stamp, frame_id=WORLD, id="capture", spheres=balls, cubes=cubes, texts=texts
        )
        return sdk.SceneUpdate(entities=[entity])

    def _text(self, pose: Any, text: str) -> Any:
        sdk = self._sdk.messages
        grey = sdk.Color(r=0.8, g=0.8, b=0.8, a=1.0)
        return sdk.TextPrimitive(
            pose=pose, billboard=True, font_size=12.0, scale_invariant=True, color=grey, text=text
        )

    def _transforms(self, poses: Array, stamp: Any) -> Any:
        sdk = self._sdk.messages
        made = []
        for one in poses:
            place, turn = self._parts(one["position"], one["quaternion"])
            made.append(
                sdk.FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=WORLD,
                    child_frame_id=self._name_of[int(one["id"])],
                    translation=place,
                    rotation=turn,
                )
            )
        return sdk.FrameTransforms(transforms=made)


class _Listener:
    """Counts clients by their subscriptions; called from the SDK's threads."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._subscribed: Counter[int] = Counter()
        self._seen: set[int] = set()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """A client subscribed to a channel."""
        with self._guard:
            self._subscribed[client.id] += 1
            self._seen.add(client.id)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """A client has left a channel."""
        with self._guard:
            self._subscribed[client.id] -= 1

    def clients(self) -> int:
        """Return how many clients are subscribed to something."""
        with self._guard:
            return sum(count > 0 for count in self._subscribed.values())

    def forget(self) -> None:
        """Forget who is subscribed: the server is gone."""
        with self._guard:
            self._subscribed.clear()

    def told(self) -> str:
        """Return how many clients there were."""
        return f"{len(self._seen)} clients subscribed"
