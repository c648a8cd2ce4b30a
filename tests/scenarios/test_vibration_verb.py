"""mosca vibration: modes from files of tracks, what it prints and writes; wrong inputs in one line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import mosca, refusal
from vibration_records import FREQUENCIES_HZ, NOISE_M, PLACES, RATE_HZ, plate_shapes, plate_values

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import write_tracks
from mosca.machines.vibration.displacements import displacements
from mosca.machines.vibration.modal import mac


def tracks_of(values, *, labels=True, carrier=None):
    """Return deflections (t, m) along z as tracks; ``carrier``: rigid motion (t, 3) that all follow [m]."""
    t, m = values.shape
    xyz = np.empty((t, m, 3))
    xyz[...] = np.column_stack([PLACES[:m], np.full(m, 0.5)])
    xyz[..., 2] += values
    if carrier is not None:
        xyz += carrier[:, None]
    frame = np.repeat(np.arange(t), m)
    track = np.tile(np.arange(m), t)
    label = np.char.add("P", (track + 1).astype(str)) if labels else np.full(t * m, "")
    covariance = np.tile(NOISE_M**2 * np.eye(3), (t * m, 1, 1))
    return Tracks(
        frame, np.rint(frame * 1e9 / RATE_HZ), track, label, xyz.reshape(-1, 3), covariance,
        np.full(t * m, 4), np.full(t * m, 0.1), np.full(t * m, "measured"),
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a take of 20 s, as .npz."""
    folder = tmp_path_factory.mktemp("vibration")
    write_tracks(tracks_of(plate_values(20.0, 1)), folder / "panel.npz", RATE_HZ)
    return folder


def test_modes_are_printed_and_written(folder):
    done = mosca("vibration", "panel.npz", "--out", "modes.json", "--plot", "spectra.svg", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "noise floor" in done.stdout
    document = json.loads((folder / "modes.json").read_text())
    found = [mode["frequency_hz"] for mode in document["modes"]]
    np.testing.assert_allclose(found, FREQUENCIES_HZ, rtol=0.01)
    shape = np.array(document["modes"][0]["shape"])
    names = list(document["targets"])
    order = [names.index(f"P{k + 1}") for k in range(len(PLACES))]
    assert mac(shape[order][:, None], plate_shapes()[:, :1])[0, 0] > 0.98
    assert (folder / "spectra.svg").read_text().startswith("<svg")
    assert mosca("vibration", "panel.npz", "--out", "modes.csv", cwd=folder).returncode == 0
    rows = (folder / "modes.csv").read_text().splitlines()
    assert len(rows) == 1 + len(FREQUENCIES_HZ)
    assert len(rows[0].split(",")) == len(rows[1].split(",")) == 8 + len(PLACES)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("none.npz", "none.npz: no such file"),
        ("panel.npz --out modes.txt", "modes.txt: suffix '.txt' given; .json or .csv is wanted"),
        ("panel.npz --frames 0:99", "100 frames with measured samples"),
        ("panel.npz --frames 9000:9999", "no samples in frames"),
        ("panel.npz --rigid P1,P2", "rigid motion needs 3 targets"),
        ("panel.npz --rigid P1,P2,X", "no target 'X'"),
        ("panel.npz --direction 0 0 0", "direction"),
        ("panel.npz --direction 0 0 1 --axes xyz", "leave one of them out"),
        ("panel.npz --exposure 0.1", "exposure 0.1 s given"),
    ],
)
def test_wrong_inputs_are_told_in_one_line(folder, words, told):
    assert told in refusal("vibration", *words.split(), cwd=folder)


def test_tracks_that_were_lost_and_found_are_one_target():
    tracks = tracks_of(plate_values(5.0, 2), labels=False)
    late = (tracks.frame >= 400) & (tracks.track == 3)
    tracks = replace(tracks, track=np.where(late, 77, tracks.track))
    record = displacements(tracks, RATE_HZ)
    assert len(record.names) == len(PLACES)
    assert np.isfinite(record.values).all()


def test_the_carriers_motion_is_taken_out_by_targets_on_it():
    values = plate_values(5.0, 2, noise_m=0.0)
    values[:, :4] = 0.0  # these are on the carrier
    time = np.arange(len(values)) / RATE_HZ
    carrier = np.stack([0.003 * np.sin(9 * time), 0.002 * np.cos(7 * time), 0.005 * np.sin(5 * time)], axis=1)
    tracks = tracks_of(values, carrier=carrier)
    record = displacements(tracks, RATE_HZ, direction=np.array([0, 0, 1.0]), rigid_by=("P1", "P2", "P3", "P4"))
    assert len(record.names) == len(PLACES) - 4
    own = values[:, [int(name[1:]) - 1 for name in record.names]]
    np.testing.assert_allclose(record.values, own - own.mean(axis=0), atol=2e-8)
    left = displacements(tracks, RATE_HZ, direction=np.array([0, 0, 1.0]))
    assert np.abs(left.values).max() > 0.004


def test_filled_samples_are_not_measured():
    tracks = tracks_of(plate_values(5.0, 2))
    status = tracks.status.copy()
    status[tracks.frame % 20 == 0] = "filled"
    record = displacements(replace(tracks, status=status), RATE_HZ)
    assert record.measured.mean() == pytest.approx(0.95, abs=0.001)


def test_frames_that_are_far_apart_need_no_memory_and_are_refused():
    tracks = tracks_of(plate_values(5.0, 2))
    late = tracks.frame == tracks.frame.max()
    with pytest.raises(InputError, match="no target is measured in 90% of frames 0 to 4000000000"):
        displacements(replace(tracks, frame=np.where(late, 4_000_000_000, tracks.frame)), RATE_HZ)


def test_targets_seen_too_seldom_are_left_out_and_named():
    tracks = tracks_of(plate_values(5.0, 2))
    tracks = tracks.select((tracks.label != "P7") | (tracks.frame % 2 == 0))
    record = displacements(tracks, RATE_HZ)
    assert record.left_out == ("P7",)
    assert len(record.names) == len(PLACES) - 1
    with pytest.raises(InputError, match="'P7' is measured in too few frames"):
        displacements(tracks, RATE_HZ, rigid_by=("P1", "P2", "P7"))
