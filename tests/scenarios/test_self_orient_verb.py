"""mosca self-orient: a drone's recording to poses and to a table beside the rig's; wrong inputs in one line."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from command_line import mosca, refusal

from mosca.data.bodies import RigidBody
from mosca.data.files.rig_file import write_rig
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.bodies.body_file import write_bodies
from mosca.formats.tracks.tracks_file import write_tracks
from mosca.recording import RecordingWriter
from scenarios.spec.scenario import load_scenario
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.drone import build_drone
from twin.scenes.survey_flight import FACING_DRONE, SurveyField, seen_by_drone, upright_field
from twin.source import TwinSource

SCENARIO = Path(__file__).parents[2] / "scenarios/library/machines/uav.toml"
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
LATE_S = 0.75
"""The camera's clock is so far ahead of the tracks'."""


@dataclass
class Flight:
    """A folder with all files, and the true poses of the camera in the field's frame."""

    folder: Path
    rotation: np.ndarray
    position: np.ndarray


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Eight frames of a drone's camera, its lens exactly known, and true tracks in the field's frame."""
    folder = tmp_path_factory.mktemp("survey")
    rng = np.random.default_rng(4)
    box = {"box_center_m": np.array([0.0, 0.0, 1.25]), "box_size_m": np.array([2.0, 2.0, 1.0])}
    flight = build_drone(duration_s=0.4, rng=rng, markers=5, **box)
    field = upright_field((1.8, 1.2), 12, 0.2, 0.03, rng)
    there = SurveyField(field, Pose(FACING_DRONE, np.array([1.7, 0.0, 1.25])), np.array([0.0, 0.8, 0.0]), 0.04, 0.09)
    camera = Camera("front", 640, 400, OpenCVLens(380.0, 380.0, 319.5, 199.5), Pose(AHEAD, np.array([0.2, 0.0, 0.0])))
    timing = Timing(rate_hz=30.0, offset_s=0.05, row_time_s=60e-6, clock="device", clock_offset_s=LATE_S)
    exact = Optics(gap_px=0.0, tilt_deg=(0.0, 0.0), pupil_shift_m=0.0)
    virtual = VirtualCamera(camera, exact, timing, Mount(body="drone", body_px=0.0))
    scene = seen_by_drone(flight, there)
    with TwinSource(scene, (virtual,), frame_rate_hz=30.0, exposure_s=0.003, pulses=9, seed=1) as source:
        with RecordingWriter(folder / "flight", source.cameras) as writer:
            for frame in source:
                writer.write(frame)
        frames = source.truth().frames
    back = there.world_from_field.inverse()
    write_rig(Rig((Camera("front", 640, 400, camera.lens, Pose(np.eye(3), np.zeros(3))),)), folder / "front.toml")
    write_rig(Rig((camera,)), folder / "seat.toml")
    targets = [
        {"number": one.target.number, "position_m": one.position.tolist(), "normal": one.normal.tolist()}
        for one in field.targets
    ]
    document = {"kind": "field", "dot_radius_m": 0.03, "sigma_m": 1e-5, "target": targets}
    (folder / "field.toml").write_text(tomli_w.dumps(document))
    _write_tracks(flight, back, folder)
    return Flight(folder, back.rotation @ frames.camera_rotation, back.transform(frames.camera_position))


def _write_tracks(flight, back, folder):
    """Write the true places of the markers in the field's frame at 200 Hz, and the body in the drone's own axes."""
    scene = flight.scene
    sampler = scene.sampler()
    number = scene.model.body("drone").id
    state = sampler.at(0.0)
    place, turn = sampler.data.xpos[number].copy(), sampler.data.xmat[number].reshape(3, 3).copy()
    write_bodies([RigidBody("drone", scene.marker_names, (state.marker_xyz - place) @ turn)], folder / "drone.toml")
    n, m = 80, len(scene.marker_names)
    xyz = np.array([back.transform(sampler.at(k / 200).marker_xyz) for k in range(n)])
    frame, track = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    covariance = np.tile(1e-10 * np.eye(3), (n * m, 1, 1))
    label = np.tile(np.array(scene.marker_names), n)
    tracks = Tracks(
        frame, np.rint(frame * 1e9 / 200), track, label, xyz.reshape(-1, 3), covariance,
        np.full(n * m, 4), np.full(n * m, 0.1), np.full(n * m, "measured"),
    )  # fmt: skip
    write_tracks(tracks, folder / "tracks.npz", 200)


def test_poses_are_found_and_compared(flown):
    words = ("--tracks", "tracks.npz", "--body", "drone.toml", "--seat", "seat.toml", "--offset", str(LATE_S))
    done = mosca("self-orient", "flight", "front.toml", "field.toml", *words, "--out", "poses.csv", cwd=flown.folder)
    assert done.returncode == 0, done.stderr
    with (flown.folder / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    place = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    n = len(place)
    assert n >= 4  # of eight frames the two at either end give none
    index = [int(row["frame"]) for row in rows]
    # 0.03 px at 380 px a radian, 1.5 m away, 12 targets: 0.05 mm across; along the view some times that
    assert np.abs(place - flown.position[index]).max() < 0.0015
    means, rms = (
        [float(v) for v in re.search(rf"^  {name}\s+(.*)$", done.stdout, re.MULTILINE).group(1).split()]
        for name in ("mean", "rms")
    )
    assert np.abs(means[:3]).max() < 1.0  # mm
    assert np.abs(means[3:]).max() < 0.05  # deg
    assert np.abs(rms[:3]).max() < 1.5
    assert "rows 60 us apart are taken into account" in done.stdout
    late = mosca(
        "self-orient", "flight", "front.toml", "field.toml", *words[:-1], str(LATE_S + 0.05), cwd=flown.folder
    )
    worse = [float(v) for v in re.search(r"^  rms\s+(.*)$", late.stdout, re.MULTILINE).group(1).split()]
    assert np.linalg.norm(worse[:3]) > 10.0  # 50 ms at 0.5 m/s


def test_without_a_seat_it_is_estimated_and_said(flown):
    words = ("--tracks", "tracks.npz", "--body", "drone.toml", "--offset", str(LATE_S))
    done = mosca("self-orient", "flight", "front.toml", "field.toml", *words, cwd=flown.folder)
    assert done.returncode == 0, done.stderr
    assert "where the camera sits on the body is estimated" in done.stdout


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("none front.toml field.toml", "none"),
        ("flight none.toml field.toml", "none.toml"),
        ("flight front.toml front.toml", "front.toml"),
        ("flight front.toml field.toml --out poses.txt", "poses.txt: suffix '.txt' given; poses are written as .csv"),
        ("flight front.toml field.toml --name back", "--name back: front.toml has front; name one of them"),
        ("flight front.toml field.toml --fewest 13", "13 targets of the field that agree are wanted, the most seen"),
        ("flight front.toml field.toml --tracks tracks.npz", "--tracks and --body belong together"),
        ("flight front.toml field.toml --offset 1", "--offset 1.0: is of the comparison with a rig"),
        (
            "flight front.toml field.toml --tracks tracks.npz --body drone.toml --registration flight",
            "--registration flight: the rig's cameras are wanted; give --rig RIG.toml",
        ),
        (
            "flight front.toml field.toml --tracks tracks.npz --body drone.toml --light 0 1 0",
            "--rig-recording and --light belong together",
        ),
        ("flight front.toml field.toml --tracks tracks.npz --body drone.toml --seat seat.toml", "0 of the camera's"),
    ],
)
def test_wrong_inputs_are_told_in_one_line(flown, words, told):
    assert told in refusal("self-orient", *words.split(), cwd=flown.folder)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["pipeline.bodies=false"], "[self_orientation] needs the drone's poses; set pipeline.bodies = true"),
        (["calibration.target='none'"], "[self_orientation] needs an estimated rig"),
        (["self_orientation.camera='back'"], "self_orientation.camera = 'back': cameras on the drone are frontal"),
        (["self_orientation.targets=3"], "greater than or equal to 6"),
        (["scene={kind='robot'}"], "only a 'drone' flies"),
    ],
)
def test_keys_that_do_not_go_together_are_told(words, told):
    with pytest.raises(InputError) as refused:
        load_scenario(SCENARIO, tuple(words))
    assert told in str(refused.value)
