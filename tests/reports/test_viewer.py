"""A Rerun file: written for real, read back with Rerun's own reader."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from reports_examples import example_evidence, example_rig, example_view

from mosca.data.detections import Detections
from mosca.data.joint_motion import JointMotion
from mosca.data.rig import MoscaLens
from mosca.errors import InputError
from reports.viewer import RerunLog

rerun_chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk 0.41 or later is not installed")


def columns(path: Path, entity: str, static: bool = False) -> dict[str, Any]:
    """Return the columns of one entity, all chunks together, rows in order of "frame"."""
    stream = rerun_chunk.RrdReader(path).store().stream()
    chunks = [c for c in stream.to_chunks() if c.entity_path == entity and c.is_static == static]
    rows: list[dict[str, Any]] = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        names = [n for n in batch.schema.names if n != "rerun.controls.RowId"]
        rows += [
            {n: batch.column(n)[i].value if n == "session" else batch.column(n)[i].as_py() for n in names}
            for i in range(batch.num_rows)
        ]
    rows.sort(key=lambda row: row.get("frame", 0))
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rrd") / "run.rrd"
    evidence = example_evidence(frames=6, markers=4)
    assert evidence.truth_time_ns is not None
    view = evidence.views[0]
    box = (evidence.working_space_center, evidence.working_space_size)
    with RerunLog(path, evidence.rig, box) as log:
        for i in range(6):
            rows, time_ns = evidence.tracks.frame == i, int(evidence.truth_time_ns[i])
            xyz, track = evidence.tracks.xyz[rows], evidence.tracks.track[rows]
            log.log_step(i, time_ns, {"cam0": view.image}, {"cam0": view.detections}, xyz, track)
            log.log_truth(i, time_ns, evidence.truth_xyz[i])
    return path


def test_positions_and_identities_come_back_on_both_timelines(recording: Path) -> None:
    evidence = example_evidence(frames=6, markers=4)
    points = columns(recording, "/world/points")
    assert points["frame"] == list(range(6))
    assert points["session"] == [10_000_000 * i for i in range(6)]
    for i in range(6):
        rows = evidence.tracks.frame == i
        np.testing.assert_allclose(points["Points3D:positions"][i], evidence.tracks.xyz[rows], atol=1e-6)
        assert points["track"][i] == list(evidence.tracks.track[rows])
    truth = columns(recording, "/world/truth")
    np.testing.assert_allclose(truth["Points3D:positions"], evidence.truth_xyz, atol=1e-6)


def test_images_are_small_jpegs_that_decode_to_the_frame(recording: Path) -> None:
    view = example_evidence(frames=6, markers=4).views[0]
    images = columns(recording, "/world/cameras/cam0/image")
    blob = np.array(images["EncodedImage:blob"][0][0], dtype=np.uint8)
    decoded = cv2.imdecode(blob, cv2.IMREAD_GRAYSCALE)
    assert images["EncodedImage:media_type"][0] == ["image/jpeg"]
    assert blob.size < view.image.size / 4
    assert np.abs(decoded.astype(float) - view.image).mean() < 3.0
    found = columns(recording, "/world/cameras/cam0/image/detections")
    np.testing.assert_allclose(found["Points2D:positions"][2], view.detections.xy_px, atol=1e-3)


def test_cameras_stand_where_the_rig_says(recording: Path) -> None:
    camera = example_rig().cameras[0]
    pose = columns(recording, "/world/cameras/cam0", static=True)
    np.testing.assert_allclose(pose["Transform3D:translation"][0][0], camera.world_from_camera.translation, atol=1e-6)
    by_columns = np.reshape(pose["Transform3D:mat3x3"][0][0], (3, 3)).T
    np.testing.assert_allclose(by_columns, camera.world_from_camera.rotation, atol=1e-6)
    pinhole = columns(recording, "/world/cameras/cam0/image", static=True)
    matrix = np.reshape(pinhole["Pinhole:image_from_camera"][0][0], (3, 3)).T
    np.testing.assert_allclose(matrix, [[800, 0, 328.0], [0, 800, 245.5], [0, 0, 1]])


def test_step_by_step_with_any_lens_depth_and_name(tmp_path: Path) -> None:
    rig = example_rig(2)
    lens = MoscaLens(8.0, 327.5, 245.0, 0.01, 0.0098)
    odd = type(rig.cameras[0])("left cam/1", 656, 491, lens, rig.cameras[0].world_from_camera)
    path = tmp_path / "steps.rrd"
    deep = example_view(np.random.default_rng(0)).image.astype(np.uint16) << 4
    with RerunLog(path, type(rig)((odd, rig.cameras[1]))) as log:
        log.log_step(3, 30, {"left cam/1": deep}, {"left cam/1": Detections.none("left cam/1")}, np.empty((0, 3)))
        log.log_truth(3, 30, np.array([[np.nan] * 3, [1.0, 2.0, 3.0]]))
        log.log_step(4, 40)
        with pytest.raises(InputError, match="no camera 'nobody'"):
            log.log_step(5, 50, {"nobody": deep})
    log.close()
    truth = columns(path, "/world/truth")
    assert truth["Points3D:positions"] == [[[1.0, 2.0, 3.0]]]
    assert columns(path, "/world/points")["Points3D:positions"] == [[]]


def test_a_missing_folder_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"):
        RerunLog(tmp_path / "none" / "run.rrd", example_rig())


def test_a_person_is_joints_and_lines_between_them_until_it_is_gone(tmp_path: Path) -> None:
    joints = ("pelvis", "l_hip", "l_knee", "l_ankle", "neck")
    centre = np.array([[[0, 0, 1.0], [0, 0.1, 1.0], [0, 0.1, 0.5], [0, 0.1, 0.1], [np.nan] * 3]])
    nothing = np.zeros((1, 5, 3, 3))
    motion = JointMotion(np.array([7]), np.array([70]), joints, centre, nothing, np.zeros((1, 5, 4)), nothing)
    path = tmp_path / "person.rrd"
    with RerunLog(path, type(example_rig())(())) as log:
        log.log_skeleton(7, 70, motion)
        log.log_skeleton(7, 70, motion, true=True)
        log.log_skeleton(8, 80, None)
    points = columns(path, "/world/skeleton/joints")
    assert points["frame"] == [7, 8]
    np.testing.assert_allclose(points["Points3D:positions"][0], centre[0, :4], atol=1e-7)
    assert points["Points3D:labels"][0] == list(joints[:4])
    assert points["Points3D:positions"][1] == []
    bones = columns(path, "/world/skeleton/bones")["LineStrips3D:strips"]
    np.testing.assert_allclose(bones[0], centre[:, :4], atol=1e-7)
    assert bones[1] == []
    np.testing.assert_allclose(
        columns(path, "/world/true_skeleton/bones")["LineStrips3D:strips"][0], centre[:, :4], atol=1e-7
    )
