"""A ROS 2 bag is read by rosbags, another library with message definitions of its own: equal to what was written."""

import cv2
import numpy as np
import pytest

from mosca.camera.projection import project
from mosca.data.bodies import BodyPoses
from mosca.data.frames import Frame
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose
from mosca.data.rotations import quaternion_from_rotation, rotation_from_vector
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.rigs.lens_conversion import RigFileOptions
from mosca.formats.ros2.bag import written_bag
from mosca.formats.ros2.definitions import MESSAGES, definition

TURN = rotation_from_vector(np.array([0.3, -0.2, 2.0]))
RNG = np.random.default_rng(3)
MATRIX = RNG.normal(size=(6, 6))


def take():
    frame = np.repeat([10, 11, 12], 2)
    xyz = RNG.normal(size=(6, 3))
    xyz[3] = np.nan
    spread = RNG.normal(size=(6, 3, 3)) * 1e-3
    return Tracks(
        frame,
        frame * 10_000_000 - 105_000_000,
        np.tile([4, 70_000], 3),
        np.array(["a", ""] * 3),
        xyz,
        spread @ spread.transpose(0, 2, 1),
        np.full(6, 3),
        np.full(6, 0.1),
        np.array(["measured", "filled"] * 3),
    )


def poses():
    return BodyPoses(
        np.array([10, 11]),
        np.array([7, 1_234_567_890_123]),
        np.array(["cup", "cup"]),
        np.tile(quaternion_from_rotation(TURN), (2, 1)),
        np.array([[1.0, 2.0, 3.0], [np.nan] * 3]),
        np.tile(MATRIX @ MATRIX.T, (2, 1, 1)),
        np.array([4, 0]),
        np.array([1e-4, np.nan]),
        np.array(["measured", "withheld"]),
    )


def camera(lens, name="left"):
    return Camera(name, 640, 480, lens, Pose(TURN, np.array([0.5, -1.0, 2.0])))


@pytest.fixture
def read(tmp_path):
    """Return what rosbags reads in a bag that a function wrote: topic -> [(log time, message)]."""
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed (pip install 'mosca-testbench[ros]')")
    pytest.importorskip("rosbags", reason="rosbags is not installed (pip install 'mosca-testbench[bench]')")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    def reading(write):
        path = tmp_path / "take"
        with written_bag(path) as bag:
            write(bag)
        found: dict = {}
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, time_ns, data in reader.messages():
                found.setdefault(connection.topic, []).append((time_ns, reader.deserialize(data, connection.msgtype)))
            assert reader.message_count == sum(map(len, found.values()))
        return found

    return reading


def stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def test_markers_are_point_clouds(read):
    tracks = take()
    found = read(lambda bag: bag.add_markers(tracks))["/markers"]
    assert [stamp_ns(one) for _, one in found] == [-5_000_000, 5_000_000, 15_000_000]
    assert [time_ns for time_ns, _ in found] == [0, 5_000_000, 15_000_000]
    assert [one.width for _, one in found] == [2, 1, 2]
    cloud = found[2][1]
    kinds = {6: "<u4", 7: "<f4"}
    kind = np.dtype(
        {
            "names": [one.name for one in cloud.fields],
            "formats": [(kinds[one.datatype], one.count) for one in cloud.fields],
            "offsets": [one.offset for one in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    points = np.frombuffer(cloud.data.tobytes(), kind)
    np.testing.assert_array_equal(np.column_stack([points[a].ravel() for a in "xyz"]), tracks.xyz[4:].astype("f4"))
    assert points["track"].ravel().tolist() == [4, 70_000]
    assert points["measured"].ravel().tolist() == [1, 0]
    rows, columns = np.triu_indices(3)
    np.testing.assert_array_equal(points["covariance"], tracks.covariance[4:][:, rows, columns].astype("f4"))


def test_bodies_are_poses_and_transforms(read):
    found = read(lambda bag: bag.add_bodies(poses()))
    ((_, pose),) = found["/bodies/cup/pose"]
    assert stamp_ns(pose) == 7
    at, turn = pose.pose.pose.position, pose.pose.pose.orientation
    assert (at.x, at.y, at.z) == (1.0, 2.0, 3.0)
    half = np.linalg.norm([0.3, -0.2, 2.0]) / 2
    np.testing.assert_allclose(turn.w, np.cos(half))
    np.testing.assert_allclose([turn.x, turn.y, turn.z], np.sin(half) / 2 / half * np.array([0.3, -0.2, 2.0]))
    np.testing.assert_array_equal(pose.pose.covariance.reshape(6, 6), MATRIX @ MATRIX.T)
    ((_, tf),) = found["/tf"]
    assert (tf.transforms[0].header.frame_id, tf.transforms[0].child_frame_id) == ("world", "cup")
    assert tf.transforms[0].transform.translation.z == 3.0


@pytest.mark.parametrize(
    ("lens", "model"),
    [
        (MoscaLens(8.0, 322.0, 238.0, 0.0099, 0.0099, 0.0, 0.001, -1e-5, 0.0, 1e-4, 5e-5), "plumb_bob"),
        (OpenCVLens(800.0, 810.0, 322.0, 238.0, -0.2, 0.05, 0.0, 1e-3, 1e-3), "plumb_bob"),
        (OpenCVLens(800.0, 810.0, 322.0, 238.0, -0.2, 0.05, k4=0.01), "rational_polynomial"),
        (FisheyeLens(400.0, 401.0, 322.0, 238.0, 0.01, 0.001), "equidistant"),
    ],
)
def test_a_cameras_properties_project_as_the_camera_does(read, lens, model):
    one = camera(lens)
    found = read(lambda bag: bag.add_camera(one, [5, 6], RigFileOptions()))
    (_, info), _ = found["/cameras/left/camera_info"]
    assert (info.distortion_model, info.width, info.height, info.header.frame_id) == (model, 640, 480, "left")
    (_, tf), _ = found["/tf"]
    place, turn = tf.transforms[0].transform.translation, tf.transforms[0].transform.rotation
    wxyz = np.array([turn.w, turn.x, turn.y, turn.z])
    rotation = cv2.Rodrigues(2 * np.arccos(wxyz[0]) * wxyz[1:] / np.linalg.norm(wxyz[1:]))[0]
    # points before the camera, through OpenCV with what the bag says
    points = RNG.uniform([-0.5, -0.3, 2.0], [0.5, 0.3, 4.0], (50, 3)) @ TURN.T + [0.5, -1.0, 2.0]
    back = cv2.Rodrigues(rotation.T)[0], -rotation.T @ np.array([place.x, place.y, place.z])
    shape = points.reshape(-1, 1, 3)
    if model == "equidistant":
        theirs = cv2.fisheye.projectPoints(shape, *back, info.k.reshape(3, 3), info.d)[0]
    else:
        theirs = cv2.projectPoints(shape, *back, info.k.reshape(3, 3), info.d)[0]
    np.testing.assert_allclose(theirs.reshape(-1, 2), project(one, points), atol=0.02)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_images_come_back(read, kind):
    image = RNG.integers(0, np.iinfo(kind).max, (48, 64)).astype(kind)
    frames = [Frame("left", 0, 1_000, 2_000, image), Frame("left", 1, 9_000, 2_000, None, "dropped")]
    ((time_ns, found),) = read(lambda bag: [bag.add_image(one) for one in frames])["/cameras/left/image_raw"]
    assert time_ns == stamp_ns(found) == 2_000  # the middle of the exposure
    assert found.encoding == ("mono8" if kind == np.uint8 else "mono16")
    assert found.step == 64 * image.itemsize
    np.testing.assert_array_equal(found.data.view(kind).reshape(48, 64), image)


def test_definitions_are_those_of_ros():
    rosbags = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed (mosca-testbench[bench])")
    theirs = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    for name in MESSAGES:
        ours = rosbags.get_types_from_msg(definition(name), name)
        assert set(ours) >= {name}
        for part, fields in ours.items():
            if part == "builtin_interfaces/msg/Time":
                continue
            assert fields == theirs.fielddefs[part], part


def test_a_lens_that_ros_has_no_model_for_is_refused(read):
    """The axes of its pixels are not at right angles: OpenCV, and with it ROS, has no parameter for that."""
    sheared = camera(MoscaLens(8.0, 322.0, 238.0, 0.0099, 0.0099, -0.006, 0.001))
    with pytest.raises(InputError, match=r"camera 'left': mosca lens fitted by OpenCV's model: .* 0\.1 px allowed"):
        read(lambda bag: bag.add_camera(sheared, [5], RigFileOptions()))


def test_bags_that_cannot_be(tmp_path):
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed (pip install 'mosca-testbench[ros]')")
    (tmp_path / "there").mkdir()
    with (
        pytest.raises(InputError, match="there: is there already; choose a new folder"),
        written_bag(tmp_path / "there"),
    ):
        pass
    with pytest.raises(ZeroDivisionError), written_bag(tmp_path / "take"):
        raise ZeroDivisionError
    assert [one.name for one in tmp_path.iterdir()] == ["there"]
