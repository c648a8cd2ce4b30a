"""``mosca tracks ros2``: what of a run folder gets into the bag, and what is told where it cannot."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from command_line import mosca, refusal

from mosca.data.files.rig_file import write_rig
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.tracks import Tracks, table
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from mosca.recording import RecordingWriter


@pytest.fixture
def run_folder(tmp_path):
    """A run folder with two frames of one marker and a rig of one camera, whose lens ROS has a model for."""
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed (pip install 'mosca-testbench[ros]')")
    one = np.ones(2)
    tracks = Tracks(
        np.array([0, 1]), np.array([5, 10_000_005]), 3 * one, np.array(["a", "a"]), np.ones((2, 3)),
        np.tile(1e-8 * np.eye(3), (2, 1, 1)), 2 * one, 0.1 * one, np.array(["measured"] * 2),
    )  # fmt: skip
    (tmp_path / "run").mkdir()
    write_tracks(tracks, tmp_path / "run" / "tracks.npz", 100.0)
    camera = Camera("left", 64, 48, OpenCVLens(80.0, 80.0, 32.0, 24.0), Pose(np.eye(3), np.zeros(3)))
    write_rig(Rig((camera,)), tmp_path / "run" / "rig.toml")
    return tmp_path


def test_a_run_folder_becomes_a_bag(run_folder):
    done = mosca("tracks", "ros2", "run", "bag", cwd=run_folder)
    assert done.stdout == "bag written: 6 messages, 2 frame sets, 0 images\n"
    said = json.loads((run_folder / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {one["topic_metadata"]["name"]: one["message_count"] for one in said["topics_with_message_count"]}
    assert topics == {"/markers": 2, "/cameras/left/camera_info": 2, "/tf": 2}
    assert said["duration"]["nanoseconds"] == 10_000_000
    done = mosca("tracks", "ros2", "run/tracks.npz", "plain", "--no-cameras", cwd=run_folder)
    assert done.stdout == "plain written: 2 messages, 2 frame sets, 0 images\n"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("none.npz bag", "none.npz: no such file"),
        ("run run", "run: is there already; choose a new folder"),
        ("run bag --rig none.toml", "none.toml: no such file"),
        ("run bag --recording run", "run: "),
        ("run bag --max-residual-px 0", "--max-residual-px"),
    ],
)
def test_wrong_inputs(run_folder, words, told):
    assert told in refusal("tracks", "ros2", *words.split(), cwd=run_folder)
    assert not (run_folder / "bag").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("empty bag", "empty: no marker and no pose of a body: there is nothing to write"),
        ("empty/tracks.npz bag --no-cameras", "empty/tracks.npz: no marker and no pose of a body"),
        ("nowhere bag", "nowhere: no marker and no pose of a body"),
        ("run bag --recording black", "black: no image: there is nothing to write; leave --recording out"),
    ],
)
def test_what_did_not_happen_is_no_bag(run_folder, words, told):
    """A run without a sample, one whose positions are all withheld, and a recording whose frames are all lost."""
    run = run_folder / "run"
    tracks = read_tracks(run / "tracks.npz")
    withheld = replace(tracks, xyz=np.full_like(tracks.xyz, np.nan))
    for name, written in (("empty", table([])), ("nowhere", withheld)):
        shutil.copytree(run, run_folder / name)
        write_tracks(written, run_folder / name / "tracks.npz", 100.0)
    info = CameraInfo("left", 64, 48, 8, 100.0, clock="session")
    with RecordingWriter(run_folder / "black", (info,)) as writer:
        writer.write(Frame("left", 0, 5, 1_000_000, None, "dropped"))
    assert told in refusal("tracks", "ros2", *words.split(), cwd=run_folder)
    assert not (run_folder / "bag").exists()
