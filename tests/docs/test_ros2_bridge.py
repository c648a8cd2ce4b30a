"""The example that bridges NatNet to ROS 2: its messages, as rosbags' own definitions read them."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from natnet_clients import take_frames
from natnet_witness import parsed_frame

from hardware.streams.natnet.messages import FrameStamps, stamped, unstamped_frame

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"Time": "builtin_interfaces", "Header": "std_msgs", "TFMessage": "tf2_msgs"}
KINDS = (*PACKAGES, "Point", "Pose", "PoseStamped", "Quaternion", "Transform", "TransformStamped", "Vector3")


def bridge():
    spec = importlib.util.spec_from_file_location("ros2_bridge", ROOT / "docs" / "examples" / "ros2_bridge.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_frame_becomes_messages_that_serialise():
    pytest.importorskip("rosbags", reason="rosbags is not installed (pip install 'mosca-testbench[bench]')")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    names = {kind: f"{PACKAGES.get(kind, 'geometry_msgs')}/msg/{kind}" for kind in KINDS}
    msg = SimpleNamespace(**{kind: store.types[name] for kind, name in names.items()})
    frames = take_frames(seconds=0.05)
    one = list(frames)[3]
    data = stamped(unstamped_frame(one, (3, 1)), FrameStamps(70_000_000, 0, 0), (3, 1))
    found, _ = parsed_frame(data, (3, 1))
    poses, transforms = bridge().messages(found, {1: "drone", 2: "cup"}, 12_345_678_901, msg)
    assert list(poses) == ["/bodies/drone/pose", "/bodies/cup/pose"]
    for k, pose in enumerate(poses.values()):
        name = names["PoseStamped"]
        read = store.deserialize_cdr(store.serialize_cdr(pose, name), name)
        assert (read.header.stamp.sec, read.header.stamp.nanosec) == (12, 345_678_901)
        assert read.header.frame_id == "world"
        place, turn = read.pose.position, read.pose.orientation
        np.testing.assert_allclose([place.x, place.y, place.z], [k, 2.0, 3.0])
        np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], one.bodies["quaternion"][k], atol=1e-7)
    read = store.deserialize_cdr(store.serialize_cdr(transforms, names["TFMessage"]), names["TFMessage"])
    assert [t.child_frame_id for t in read.transforms] == ["drone", "cup"]
    assert read.transforms[1].transform.translation.x == 1.0


def test_the_shortest_way_sets_the_clock():
    clock = bridge().ServerClock()
    for ticks, delay_ns in ((1000, 900_000), (2000, 300_000), (3000, 700_000)):
        clock.heard(ticks, 10**18 + ticks * 100 + delay_ns)
    assert clock.day_ns(5000) == 10**18 + 500_000 + 300_000
