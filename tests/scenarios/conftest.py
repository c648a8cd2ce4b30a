"""Wrong inputs through the command line: a folder of good and useless files, and what every refusal must be like."""

import re
import sys

import numpy as np
import pytest


@pytest.fixture(scope="module")
def lab_folder(tmp_path_factory):
    """A recording, rig files with devices that are not there and without devices, tracks, and files of no use."""
    from station_scene import Scene
    from station_scene import rig as scene_rig
    from tiny_scenario import TINY

    from mosca.data.files.rig_file import rig_toml
    from mosca.data.tracks import Samples, table
    from mosca.formats.tracks.tracks_file import write_tracks
    from mosca.recording import RecordingWriter

    lab = tmp_path_factory.mktemp("lab")
    rig = scene_rig()
    hardware = {name: {"driver": "gige", "serial": f"nobody-{name}"} for name in rig.names}
    (lab / "rig.toml").write_text(rig_toml(rig, hardware) + "\n[hardware]\nrate_hz = 50.0\n")
    (lab / "plain.toml").write_text(rig_toml(rig))
    source = Scene(rig.cameras, 4)
    with RecordingWriter(lab / "take", source.cameras) as writer:
        for frame in source:
            writer.write(frame)
    two = np.arange(20) % 2
    samples = Samples(
        np.arange(20) // 2, np.arange(20) // 2 * 10_000_000, two, np.zeros((20, 3)), np.tile(np.eye(3), (20, 1, 1)),
        np.full(20, 3), np.zeros(20), np.zeros(20, np.int8),
    )  # fmt: skip
    for name in ("left.csv", "right.csv"):
        write_tracks(table([samples]), lab / name, 100.0)
    (lab / "bytes.toml").write_bytes(b"\xff\xfe no toml")
    (lab / "bytes.csv").write_bytes(b"\xff\xfe,1\n")
    (lab / "scene.toml").write_text(TINY.format(top="", duration_s=0.3, cameras="", limits="position_rms = 0.01"))
    (lab / "wand.toml").write_text('kind = "wand"\nalong_m = [0.0, 0.2, 0.5]\ndiameter_m = 0.02\n')
    (lab / "empty.toml").write_text("")
    (lab / "other.toml").write_text('title = "x"\n')
    (lab / "background.toml").write_text("[background]\nkind = 'mean'\n")
    (lab / "edits.toml").write_text("[[edit]]\ntrim = { frames = [0, 99] }\n")
    (lab / "file.txt").write_text("mine")
    (lab / "bad.mcap").write_bytes(b"123")
    (lab / "bad.npz").write_bytes(b"PK\x03\x04 no")
    for name in ("full", "full.csv", "full.json", "full.toml"):
        (lab / name).mkdir()
        (lab / name / "notes.txt").write_text("mine")
    return lab


@pytest.fixture
def refused(lab_folder, monkeypatch, capsys):
    """Return what runs words of the command line: they must end in one line, which is returned, and leave nothing."""
    from scenarios.cli.main import main

    monkeypatch.chdir(lab_folder)

    def run(given, *more):
        before = tree(lab_folder)
        monkeypatch.setattr(sys, "argv", ["mosca", *words(given), *map(str, more)])
        with pytest.raises(SystemExit) as ended:
            main()
        # emulated cameras of a test that runs beside this one answer on the same loopback, and are warned of
        lines = capsys.readouterr().err.splitlines(keepends=True)
        told = "".join(line for line in lines if "WARNING mosca.hardware.drivers: " not in line)
        assert ended.value.code == 2, told
        assert told.startswith("mosca: ")
        assert told.count("\n") == 1
        assert tree(lab_folder) == before
        return told

    return run


def tree(folder):
    """Every file and folder, with the attributes that a write would change."""
    return {
        str(path): (path.stat().st_size, path.stat().st_mtime_ns) if path.is_file() else None
        for path in folder.rglob("*")
    }


def words(text):
    """Split a command into words: text between two bars is one word."""
    return [part[1:-1] if part.startswith("|") else part for part in re.findall(r"\|[^|]*\||\S+", text)]


@pytest.fixture
def changed(lab_folder):
    """Return what makes changed.toml of rig.toml; it is gone after the test."""
    path = lab_folder / "changed.toml"

    def change(find="", put="", more=""):
        text = (lab_folder / "rig.toml").read_text()
        assert find in text
        path.write_text(text.replace(find, put, 1) + more)

    yield change
    path.unlink(missing_ok=True)
