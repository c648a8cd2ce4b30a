"""A person in a live run: labels in its tracks, joints in their file, bones for the viewer, lines that say it."""

from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from heard_server import Heard
from scipy.spatial.transform import Rotation
from tiny_scenario import write_tiny

from hardware.streams.values import HAS_MODEL, TRACKED, StreamedSkeleton
from mosca.data.rig import Rig
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.formats.bodies.subject_file import write_subject
from mosca.formats.joints.joints_csv import JointsLog, read_joints_csv
from mosca.formats.tracks.tracks_file import TracksLog, read_tracks
from mosca.skeleton.fit import fit_subject
from mosca.skeleton.isb_angles import isb_angles
from mosca.skeleton.marker_frames import marker_frames
from mosca.skeleton.track import track_subject
from reports.viewer import RerunLog
from scenarios.cli.main import cli
from scenarios.commands.live_skeleton import LivePerson, LiveShow
from scenarios.commands.live_sources import LiveOptions
from scenarios.commands.live_stream import LiveStream
from tests.skeleton_takes import RATE_HZ, legs_model, made_subject, take
from tests.studies.live_skeleton import disturbed


@pytest.fixture(scope="module")
def person(tmp_path_factory):
    """The file of a subject of pelvis and legs, its subject, and frames of another take."""
    model = legs_model()
    subject = fit_subject(model, marker_frames(take(model, 60)[0], model.labels))
    path = tmp_path_factory.mktemp("person") / "legs.npz"
    write_subject(subject, path)
    return path, subject, marker_frames(take(model, 60, seed=2)[0], model.labels)


def late(samples: list[Samples]) -> list[Samples]:
    """Return samples as a tracker gives them: what it is not sure of yet comes one frame later."""
    given, kept = [], Samples.none()
    for one in samples:
        some = np.arange(len(one)) % 7 == 0
        given.append(Samples.joined([kept, one.select(~some)]))
        kept = one.select(some)
    return given


def test_a_persons_labels_joints_and_bones(person, tmp_path):
    path, subject, frames = person
    clean = disturbed(frames, 0.0, 0.0, 0.0)
    with ExitStack() as stack:
        live = LivePerson(path, tmp_path / "j.csv", stack)
        log = stack.enter_context(TracksLog(tmp_path / "t.npz"))
        show = LiveShow(LiveOptions("", rrd=tmp_path / "t.rrd"), Rig(()), stack)
        live._live._worker = None  # names come in the frame that asks for them
        for k, samples in enumerate(late(clean.samples)):
            poses, label_of = live.step(samples)
            show.show(k, int(frames.time_ns[k]), samples, poses)
            log.write(samples, label_of)
            assert {frame for frame, _ in label_of} <= {k}
        lines = live.finish()
        log.finish(RATE_HZ)
    assert lines[0].startswith("skeleton: first after 0.")
    assert lines[0].endswith("lost 0 times")
    joints = read_joints_csv(tmp_path / "j.csv")
    assert lines[1] == f"joints of {len(joints)} frames in {tmp_path / 'j.csv'}"
    assert not (tmp_path / "j.csv.part.csv").exists()
    offline = track_subject(subject, frames).joints
    rows = np.searchsorted(offline.frame, joints.frame)
    away = np.linalg.norm(joints.centre - offline.centre[rows], axis=2)
    assert np.nanmax(away[5:]) < 0.003  # a seventh of the markers is missing
    tracks = read_tracks(tmp_path / "t.npz")
    named = tracks.label != ""
    names = np.array(subject.model.labels)
    assert named[tracks.frame > 40].mean() > 0.8
    assert (tracks.label[named] == names[tracks.track[named]]).all()
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk 0.41 or later is not installed")
    shown = {one.entity_path for one in chunk.RrdReader(tmp_path / "t.rrd").store().stream().to_chunks()}
    assert {"/world/points", "/world/skeleton/bones", "/world/skeleton/joints"} <= shown


def test_a_person_is_streamed_with_labels_bones_and_angles(person, tmp_path, monkeypatch):
    """Bones against products of the joints' rotations by scipy, labels against those of the take."""
    path, subject, frames = person
    servers = []

    def opened(settings, model, names, rate_hz):
        server = Heard()
        servers.append((server, model, names))
        return server

    monkeypatch.setattr("scenarios.commands.live_stream.opened_streams", opened)
    source = SimpleNamespace(
        scene=None,
        session_ns=lambda host_ns: None,
        frames=SimpleNamespace(cameras=[SimpleNamespace(frame_rate_hz=RATE_HZ)]),
    )
    joints = []
    with ExitStack() as stack:
        live = LivePerson(path, None, stack)
        live._live._worker = None  # names come in the frame that asks for them
        stream = stack.enter_context(LiveStream(LiveOptions(""), source, live))
        for k, samples in enumerate(disturbed(frames, 0.0, 0.0, 0.0).samples):
            poses, label_of = live.step(samples)
            stream.step(k, int(frames.time_ns[k]), samples, poses, label_of)
            joints.append(poses[-1].joints)
    ((server, model, stream_names),) = servers
    (skeleton,) = [one for one in model if isinstance(one, StreamedSkeleton)]
    names = [bone.name for bone in skeleton.bones]
    assert names == ["pelvis", "l_thigh", "l_shank", "l_foot", "r_thigh", "r_shank", "r_foot"]
    number_of = {number: label for label, number in stream_names.numbers.items()}
    truth = {label: frames.xyz[:, k] for k, label in enumerate(subject.model.labels)}
    posed = 0
    for k, (frame, known) in enumerate(zip(server.frames_heard, joints, strict=True)):
        ((_, bones),) = frame.skeletons
        for marker in frame.markers[frame.markers["params"] & HAS_MODEL > 0]:
            np.testing.assert_allclose(marker["position"], truth[number_of[marker["id"]]][k], atol=1e-6)
        if known is None:
            assert not (bones["params"] & TRACKED).any()
            assert np.isnan(frame.angles).all()
            continue
        posed += 1
        turn = {
            joint: Rotation.from_quat(known.rotation[0, c], scalar_first=True) for c, joint in enumerate(known.joints)
        }
        shank = turn["pelvis"] * turn["l_hip"] * turn["l_knee"]
        bone = bones[names.index("l_shank")]
        assert (Rotation.from_quat(bone["quaternion"]).inv() * shank).magnitude() < 1e-6
        np.testing.assert_allclose(bone["position"], known.centre[0, known.joints.index("l_knee")], atol=1e-6)
        assert frame.angles[stream_names.angles.index("l_knee_flexion")] == isb_angles(known).angles[
            0, isb_angles(known).names.index("l_knee_flexion")
        ]  # fmt: skip
    assert posed > 30


def test_a_take_without_the_person_says_so(person, tmp_path):
    write_tiny(tmp_path, duration_s=0.1)
    words = ["live", str(tmp_path / "tiny.toml"), "--skeleton", str(person[0]), "--joints", str(tmp_path / "j.csv")]
    result = CliRunner().invoke(cli, [*words, "--rrd", str(tmp_path / "t.rrd")], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "skeleton: the person was not found" in result.output
    assert "no joints to write" in result.output
    assert any(line.startswith("skeleton ") and "p99" in line for line in result.output.splitlines())
    assert not (tmp_path / "j.csv").exists()
    assert [one.name for one in tmp_path.iterdir() if "part" in one.name] == []
    assert (tmp_path / "t.rrd").is_file()


def test_joints_of_a_run_that_was_cut_short_stay(tmp_path: Path):
    subject = made_subject()
    frames = marker_frames(take(subject.model, 3)[0], subject.model.labels)
    joints = track_subject(subject, frames).joints
    log = JointsLog(tmp_path / "j.csv")
    log.write(joints)
    log.close()
    with pytest.raises(InputError, match="left by a run that was cut short"):
        JointsLog(tmp_path / "j.csv")
    assert len(read_joints_csv(tmp_path / "j.csv.part.csv")) == 3
    with pytest.raises(InputError, match=r"joints are a \.csv file"):
        JointsLog(tmp_path / "j.npz")


def test_the_viewer_is_not_asked_for_more_than_it_shows(tmp_path, monkeypatch):
    logs = []

    def fake(rig: Rig) -> RerunLog:
        logs.append(RerunLog(tmp_path / "v.rrd", rig))
        return logs[-1]

    monkeypatch.setattr("scenarios.commands.live_skeleton.log_in_viewer", fake)
    seen = []
    monkeypatch.setattr(RerunLog, "log_step", lambda *a, **b: seen.append(a[1]))
    with ExitStack() as stack:
        show = LiveShow(LiveOptions("", view=True), Rig(()), stack)
        for k in range(50):
            show.show(k, k, Samples.none(), [])
    assert seen[0] == 0
    assert len(seen) < 25
