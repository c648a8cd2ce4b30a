"""C3D with markers, joint centres and angles, as ezc3d reads it; and what of it our reader takes for places."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest
from joint_scenes import motion_of, some_motion
from scipy.spatial.transform import Rotation

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.joints.joints_c3d import write_joints_c3d
from mosca.formats.tracks.c3d import read_c3d
from mosca.skeleton.isb_angles import isb_angles


def marker() -> Tracks:
    n = 20
    return Tracks(
        np.arange(n), 10_000_000 * np.arange(n), np.full(n, 3), np.full(n, "LASI"), np.full((n, 3), 0.5),
        np.full((n, 3, 3), np.nan), np.full(n, 4), np.full(n, 0.1), np.full(n, "measured"),
    )  # fmt: skip


def test_ezc3d_reads_markers_centres_and_angles(tmp_path: Path) -> None:
    motion, path = some_motion(), tmp_path / "a.c3d"
    angles = isb_angles(motion)
    write_joints_c3d(path, motion, angles, 100.0, marker())
    document = ezc3d.c3d(str(path))
    point, points = document["parameters"]["POINT"], document["data"]["points"]
    labels = point["LABELS"]["value"]
    assert points.shape == (4, 1 + 15 + 15, 20)
    assert labels[:2] == ["LASI", "pelvis"]
    assert point["ANGLES"]["value"] == labels[16:]
    assert {"PelvisAngles", "SpineAngles", "LHipAngles", "RKneeAngles", "LWristAngles"} <= set(labels[16:])
    assert (point["ANGLE_UNITS"]["value"], point["UNITS"]["value"]) == (["deg"], ["mm"])
    residuals = document["data"]["meta_points"]["residuals"][0]
    names = [f"r_knee_{one}" for one in ("flexion", "adduction", "internal_rotation")]
    wanted = np.rad2deg(angles.angles[:, [angles.names.index(name) for name in names]])
    # the motion's frames are 5 to 16 of 0 to 19; float32 has 7 digits
    np.testing.assert_allclose(points[:3, labels.index("RKneeAngles"), 5:17].T, wanted, rtol=1e-6)
    assert (residuals[labels.index("RKneeAngles")] >= 0).tolist() == [5 <= k < 17 for k in range(20)]
    # l_knee is unknown in the fourth frame, its centre too
    assert np.flatnonzero(residuals[labels.index("LKneeAngles")] < 0).tolist() == [*range(5), 8, *range(17, 20)]
    np.testing.assert_allclose(1e-3 * points[:3, labels.index("neck"), 5:17].T, motion.centre[:, 2], atol=1e-6)
    table = read_c3d(path)
    assert table.names == ("LASI", *motion.joints)
    np.testing.assert_allclose(table.xyz[5:17, 1:], motion.centre, atol=1e-6)


def test_angles_by_hand(tmp_path: Path) -> None:
    bent = Rotation.from_euler("ZXY", [[-70.0, 0, 0], [-71.0, 5, -3]], degrees=True)
    motion = motion_of({"l_knee": bent})
    write_joints_c3d(tmp_path / "a.c3d", motion, isb_angles(motion), 50.0)
    document = ezc3d.c3d(str(tmp_path / "a.c3d"))
    assert document["parameters"]["POINT"]["RATE"]["value"] == [50.0]
    np.testing.assert_allclose(document["data"]["points"][:3, 1].T, [[70, 0, 0], [71, -5, 3]], atol=1e-5)


def test_what_such_a_file_cannot_hold(tmp_path: Path) -> None:
    motion, path = some_motion(), tmp_path / "a.c3d"
    with pytest.raises(InputError, match="angles in frame 5, where no point is"):
        write_joints_c3d(path, motion.select(np.arange(1, 12)), isb_angles(motion), 100.0)
    with pytest.raises(InputError, match="a frame rate of 0/s given"):
        write_joints_c3d(path, motion, isb_angles(motion), 0.0)
    assert list(tmp_path.iterdir()) == []
    document = ezc3d.c3d()
    document["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    document["parameters"]["POINT"]["LABELS"]["value"] = ["LHipAngles"]
    document.add_parameter("POINT", "ANGLES", ["LHipAngles"])
    document["data"]["points"] = np.ones((4, 1, 2))
    document.write(str(path))
    with pytest.raises(InputError, match="all its points are angles, forces"):
        read_c3d(path)
