"""What an identification reads: commands, and the axes that targets define."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.machines.identification.commands import read_commands
from mosca.machines.identification.deck import PAPER, DeckAxes, in_axes, learned_deck, poses_in_axes, read_axes
from mosca.machines.identification.velocities import planar_path
from mosca.rigid_bodies.tracker import body_poses

NAMES = ("T3", "T6", "T8", "T10", "T13")
PLACES = np.array([[0.0, 0.1, 0.0], [-0.15, 0.0, 0.0], [0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.01, -0.1, 0.0]])
"""In the deck's axes; #13 is off the y axis, which the x axis overrules."""


def turned_body() -> RigidBody:
    """The deck in other axes and with another origin."""
    turn = Rotation.from_rotvec([0.3, -0.2, 1.1])
    return RigidBody("robot", NAMES, turn.apply(PLACES) + [0.4, -0.1, 0.2])


def test_axes_are_those_of_the_targets() -> None:
    body = in_axes(turned_body(), PAPER)
    place = dict(zip(body.markers, body.positions, strict=True))
    assert place["T8"] == pytest.approx([0, 0, 0], abs=1e-12)
    assert place["T10"] == pytest.approx([0.15, 0, 0], abs=1e-12)
    assert place["T3"] == pytest.approx([0, 0.1, 0], abs=1e-12)
    assert place["T13"] == pytest.approx([0.01, -0.1, 0], abs=1e-12)
    assert read_axes("T8, T6-T10, T13-T3") == PAPER
    turned = DeckAxes("T8", ("T10", "T6"), ("T3", "T13"))
    back = dict(zip(NAMES, in_axes(turned_body(), turned).positions, strict=True))
    assert back["T10"] == pytest.approx([-0.15, 0, 0], abs=1e-12)


@pytest.mark.parametrize("text", ["T8", "T8,T6,T10", "T8,T6-T10", "T8,T6-T10,T13-", "T8,T6-T10,T1-T2-T3", ""])
def test_wrong_axes_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="CENTRE,BACK-FRONT,RIGHT-LEFT is wanted"):
        read_axes(text)


def test_axes_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="has no target 'T9'"):
        in_axes(turned_body(), DeckAxes("T9", ("T6", "T10"), ("T13", "T3")))
    with pytest.raises(InputError, match="point the same way within 30 degrees"):
        in_axes(turned_body(), DeckAxes("T8", ("T6", "T10"), ("T6", "T8")))


def deck_tracks(frames: int = 120) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Return the targets of a deck that drives a curve, and its true centre (t, 3) and yaw (t,)."""
    t = 0.02 * np.arange(frames)
    yaw = 0.4 + 0.5 * t
    centre = np.column_stack([np.sin(0.5 * t), 0.2 * t, np.full(frames, 0.15)])
    world = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    xyz = np.stack([world.apply(p) + centre for p in PLACES], axis=1)
    xyz = xyz + np.random.default_rng(4).normal(0, 1e-4, xyz.shape)
    n, m = frames, len(NAMES)
    frame = np.repeat(np.arange(n), m)
    covariance = np.tile(1e-8 * np.eye(3), (n * m, 1, 1))
    tracks = Tracks(
        frame, frame * 20_000_000, np.tile(np.arange(m) + 7, n), np.tile(np.array(NAMES), n), xyz.reshape(-1, 3),
        covariance, np.full(n * m, 3), np.full(n * m, 0.1), np.full(n * m, "measured"),
    )  # fmt: skip
    return tracks, centre, yaw


def test_a_deck_is_learned_and_its_path_is_that_of_its_centre() -> None:
    tracks, centre, yaw = deck_tracks()
    deck = learned_deck(tracks, PAPER)
    assert deck.positions[deck.markers.index("T3")] == pytest.approx([0, 0.1, 0], abs=1e-4)
    path = planar_path(body_poses(tracks, (deck,)).of("deck"), "take")
    error = path.values - np.column_stack([centre[:, :2], yaw])
    sigma = np.sqrt(np.diagonal(path.covariance, axis1=1, axis2=2))
    # of five targets of 0.1 mm about their mean, and of arms of 0.15, 0.15, 0.1 and 0.1 m
    assert sigma.mean(axis=0) == pytest.approx([1e-4 / np.sqrt(5), 1e-4 / np.sqrt(5), 3.9e-4], rel=0.02)
    assert (np.abs(error / sigma) < 5).all()
    with pytest.raises(InputError, match="no target 'T1' for the axes: the tracks have T10, T13, T3"):
        learned_deck(tracks, DeckAxes("T1", ("T6", "T10"), ("T13", "T3")))


def test_poses_in_axes_are_those_of_the_body_in_axes() -> None:
    tracks, *_ = deck_tracks()
    body = turned_body()
    direct = body_poses(tracks, (in_axes(body, PAPER),)).of("robot")
    moved = poses_in_axes(body_poses(tracks, (body,)), body, PAPER)
    assert moved.position == pytest.approx(direct.position, abs=1e-8)
    assert np.abs(np.sum(moved.quaternion * direct.quaternion, axis=1)) == pytest.approx(np.ones(len(moved)))
    assert moved.covariance == pytest.approx(direct.covariance, rel=1e-4, abs=1e-13)


def poses(n: int = 200, **changed: np.ndarray) -> BodyPoses:
    columns = {
        "frame": np.arange(n), "time_ns": 10_000_000 * np.arange(n), "body": np.full(n, "robot"),
        "quaternion": np.tile([1.0, 0, 0, 0], (n, 1)), "position": np.zeros((n, 3)),
        "covariance": np.tile(1e-8 * np.eye(6), (n, 1, 1)), "n_markers": np.full(n, 5),
        "residual_m": np.full(n, 1e-4), "status": np.full(n, "measured"),
    }  # fmt: skip
    return BodyPoses(**columns | changed)


def test_paths_that_cannot_be_fitted_are_refused() -> None:
    with pytest.raises(InputError, match="take: the body has a pose in 20 frames; 100 at least"):
        planar_path(poses(20), "take")
    upright = np.tile(Rotation.from_euler("y", 80, degrees=True).as_quat(scalar_first=True), (200, 1))
    with pytest.raises(InputError, match="points up or down by more than 60 degrees"):
        planar_path(poses(quaternion=upright), "take")
    late = 10_000_000 * np.arange(200)
    late[77] += 2_000_000
    with pytest.raises(InputError, match="frame 77 is 2 ms off regular frames of 10 ms"):
        planar_path(poses(time_ns=late), "take")


def test_commands_are_read_on_each_clock(tmp_path) -> None:
    file = tmp_path / "c.csv"
    file.write_text("frame,pwm_left,pwm_right\n3,1.5,-2\n8,0,1e1\n")
    held = read_commands(file).held(5_000_000_000, 2, 0.01)
    assert held.time_s.tolist() == pytest.approx([0.01, 0.06])
    assert held.values.tolist() == [[1.5, -2.0], [0.0, 10.0]]
    file.write_text("time_ns,left,right\n5000000010,1,2\n")
    assert read_commands(file).held(5_000_000_000, 2, 0.01).time_s.tolist() == pytest.approx([1e-8])
    file.write_text("thrust,time_s,left,right\n4,5.25,1,2\n")
    held = read_commands(file, ("thrust",)).held(5_000_000_000, 2, 0.01)
    assert (held.names, held.time_s.tolist(), held.values.tolist()) == (("thrust",), [0.25], [[4.0]])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("left,right\n1,2\n", "has no column for the time; one of time_ns, time_s, frame is wanted"),
        ("time_s,frame,left,right\n1,1,1,2\n", "has time_s and frame for the time"),
        ("time_s,left\n1,2\n", "lacks the column 'right'"),
        ("time_s,left,right\n", "no commands"),
        ("time_s,left,right\n1,2\n", "row 2: 2 values given, 3 wanted"),
        ("time_s,left,right\n1,2,x\n", "row 2: right = 'x'; a number or nothing is wanted"),
        ("time_s,left,right\n1,2,\n", "row 2: right is no finite number"),
        ("time_s,left,right\n1,2,inf\n", "row 2: right is no finite number"),
        ("time_s,left,right\n1,2,3\n1,2,3\n", "row 3: time_s does not rise"),
        ("frame,left,right\n1.5,2,3\n", "row 2: frame = '1.5'; a whole number of 64 bit is wanted"),
    ],
)
def test_wrong_commands_are_told_of_in_one_line(tmp_path, text: str, told: str) -> None:
    file = tmp_path / "c.csv"
    file.write_text(text)
    with pytest.raises(InputError) as refused:
        read_commands(file)
    assert told in str(refused.value)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)
