"""Rigid bodies from tracks files: learned, found again in another take, written; refused where they cannot be."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from track_tables import measured_tracks

from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from scenarios.commands.bodies import find_in, learn_from

MARKERS = np.array([[0.12, 0.04, 0.03], [-0.10, 0.06, 0.0], [0.02, -0.13, 0.01], [0.0, 0.03, 0.11]])
NOISE = 1e-4


def take(path, n, seed, ids=(3, 1, 8, 5), loose=False):
    """Write tracks of a flown body beside a fixed point (track 20); returns its rotations and positions."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.01
    turn = Rotation.from_rotvec(np.column_stack([0.5 * np.sin(2 * t), 0.4 * np.cos(3 * t) - 0.4, t]))
    place = np.column_stack([np.sin(t), np.cos(t), 1 + 0.2 * t])
    xyz = np.stack([turn.apply(m) + place for m in MARKERS], axis=1)
    if loose:
        xyz[:, 2, 0] += 0.02 * np.sin(9 * t)
    xyz = np.concatenate([xyz, np.broadcast_to([2.0, 2.0, 0.0], (n, 1, 3))], axis=1) + rng.normal(0, NOISE, (n, 5, 3))
    tracks = measured_tracks(np.repeat(np.arange(n), 5), np.tile([*ids, 20], n), xyz.reshape(-1, 3), sigma_m=NOISE)
    write_tracks(tracks, path, 100.0)
    return turn, place


def test_a_body_is_learned_and_found_in_another_take(tmp_path):
    take(tmp_path / "one.csv", 60, 1)
    told = learn_from(tmp_path / "one.csv", tmp_path / "bodies.toml", ("drone=3,1,8,5",), "0:50")
    assert told[0].startswith("body 'drone': 4 markers, each known to 0.0")
    turn, _ = take(tmp_path / "two.csv", 80, 2, ids=(11, 12, 13, 14))
    told = find_in(
        tmp_path / "two.csv", tmp_path / "bodies.toml", tmp_path / "poses.csv", None, tmp_path / "named.csv", None
    )
    assert "body 'drone': a pose in 80 of 80 frames, its markers 0." in told[0]
    poses = np.genfromtxt(tmp_path / "poses.csv", delimiter=",", names=True)
    found = Rotation.from_quat(np.column_stack([poses[name] for name in ("qx", "qy", "qz", "qw")]))
    # the body's axes are arbitrary: compare the rotation since the start
    off = (found * found[0].inv()) * (turn * turn[0].inv()).inv()
    assert np.sqrt(np.mean(off.magnitude() ** 2)) < 3 * NOISE / 0.1
    labels = read_tracks(tmp_path / "named.csv")
    assert set(labels.label[labels.track == 12].tolist()) == {"drone/2"}
    assert set(labels.label[labels.track == 20].tolist()) == {""}
    find_in(tmp_path / "two.csv", tmp_path / "bodies.toml", tmp_path / "poses.tum", None, None, None)
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "poses.tum")[:, 1], poses["x"])


@pytest.mark.parametrize(
    ("bodies", "told"),
    [
        (("drone=3,1",), "--body drone=3,1: NAME=TRACK,TRACK,... of 3 tracks or more is wanted"),
        (("=3,1,8",), "NAME=TRACK,TRACK,... of 3 tracks"),
        (("drone=3,1,x",), "NAME=TRACK,TRACK,... of 3 tracks"),
        (("drone=3,1,9",), "has no track 9; its tracks are 1, 3, 5, 8, 20"),
        (("a=3,1,8,5", "a=3,1,8"), "body 'a' is given twice"),
        (("drone=3,1,8,20",), "(track 20) moves most against the others"),
    ],
)
def test_what_cannot_be_learned_is_one_line_and_leaves_no_file(tmp_path, bodies, told):
    take(tmp_path / "one.csv", 60, 1)
    with pytest.raises(InputError) as error:
        learn_from(tmp_path / "one.csv", tmp_path / "bodies.toml", bodies, None)
    assert told in str(error.value)
    assert not (tmp_path / "bodies.toml").exists()


def test_a_body_that_bends_is_refused(tmp_path):
    take(tmp_path / "one.csv", 60, 1, loose=True)
    with pytest.raises(InputError, match=r"'drone/3' \(track 8\) moves most"):
        learn_from(tmp_path / "one.csv", tmp_path / "bodies.toml", ("drone=3,1,8,5",), None)


@pytest.mark.parametrize(
    ("out", "body", "told"),
    [("p.bvh", None, "poses are written as .csv or .tum"), ("p.csv", "cat", "defines drone; name one of them")],
)
def test_what_cannot_be_found_is_said_before_the_tracks_are_read(tmp_path, out, body, told):
    take(tmp_path / "one.csv", 60, 1)
    learn_from(tmp_path / "one.csv", tmp_path / "bodies.toml", ("drone=3,1,8,5",), None)
    with pytest.raises(InputError, match=told):
        find_in(tmp_path / "none.csv", tmp_path / "bodies.toml", tmp_path / out, body, None, None)
    assert not (tmp_path / out).exists()
