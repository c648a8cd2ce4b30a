"""Rigid bodies: poses against scipy and chi-square, finding, losing, flips, look-alikes, learning."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation
from track_points import made_tracks, points

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Samples, Tracks
from mosca.errors import InputError
from mosca.rigid_bodies.ambiguity import check_bodies, difference_m, nearest
from mosca.rigid_bodies.learn import learn_body
from mosca.rigid_bodies.pose import BodySettings, Constellation, instant_points
from mosca.rigid_bodies.tracker import BodyTracker, body_poses, labelled_by_bodies

SIGMA = 2e-4
DRONE = RigidBody(
    "drone",
    tuple(f"D{k}" for k in range(1, 7)),
    np.array(
        [[0.13, 0.02, 0.05], [-0.11, 0.04, 0.06], [0.03, -0.14, 0.0], [-0.02, 0.1, -0.03], [0.05, 0.06, 0.09],
         [-0.07, -0.08, 0.02]]
    ),
)  # fmt: skip
CUP = RigidBody(
    "cup", ("C1", "C2", "C3", "C4"), np.array([[0, 0, 0], [0.12, 0, 0], [0.02, 0.08, 0], [0.05, 0.03, 0.06]])
)
CROSS = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]])


def pose_at(t: float, sway: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    turn = Rotation.from_rotvec([0.5 * np.sin(3 * t), 0.4 * t, 2 * sway * t]).as_matrix()
    return turn, np.array([sway * np.sin(t), np.cos(t), 1.0 + 0.1 * np.sin(5 * t)])


def tracks_of(
    frames: int, bodies: tuple[RigidBody, ...], rng: np.random.Generator, hidden: float = 0.0, clutter: int = 0
) -> tuple[Tracks, dict[str, list[tuple[np.ndarray, np.ndarray]]]]:
    """Tracks 0, 1, ... of the bodies' markers one after the other, then of points that wander about."""
    truth: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {body.name: [] for body in bodies}
    start = rng.uniform(-1, 1, (clutter, 3)) + [0, 0, 1]
    rows = []
    for f in range(frames):
        xyz = []
        for k, body in enumerate(bodies):
            truth[body.name].append(pose_at(f / 100.0, 1.0 - 2.2 * k))
            turn, place = truth[body.name][-1]
            xyz.append(body.positions @ turn.T + place)
        every = np.concatenate([*xyz, start + 0.2 * np.sin(f / 100.0 + start)])
        for track, point in enumerate(every):
            if rng.random() >= hidden:
                rows.append((f, track, point + rng.normal(0, SIGMA, 3)))
    return made_tracks(*zip(*rows, strict=True), SIGMA), truth


def errors_of(poses: BodyPoses, truth: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Errors (n, 6): position [m], rotation vector in world axes [rad], by scipy."""
    turns = Rotation.from_quat(poses.quaternion[:, [1, 2, 3, 0]])
    true = Rotation.from_matrix([truth[f][0] for f in poses.frame])
    places = np.array([truth[f][1] for f in poses.frame])
    return np.concatenate([places - poses.position, (true * turns.inv()).as_rotvec()], axis=1)


def test_a_pose_without_noise_is_exact_and_as_scipy_has_it() -> None:
    rng = np.random.default_rng(1)
    turn, place = Rotation.random(random_state=5).as_matrix(), np.array([1.0, -2.0, 3.0])
    xyz = DRONE.positions @ turn.T + place
    one = Constellation(DRONE, BodySettings())
    fit = one.fit(instant_points(xyz, np.tile(np.diag([1e-8, 4e-8, 9e-8]), (6, 1, 1))), np.arange(6))
    assert fit is not None
    np.testing.assert_allclose(fit.rotation, turn, atol=1e-13)
    np.testing.assert_allclose(fit.translation, place, atol=1e-13)
    # equal errors all round: scipy's Kabsch is the least squares solution
    noisy = xyz + rng.normal(0, 1e-3, xyz.shape)
    fit = one.fit(instant_points(noisy, np.tile(1e-6 * np.eye(3), (6, 1, 1))), np.arange(6))
    assert fit is not None
    ours, middle = DRONE.positions.mean(axis=0), noisy.mean(axis=0)
    kabsch = Rotation.align_vectors(noisy - middle, DRONE.positions - ours)[0].as_matrix()
    np.testing.assert_allclose(fit.rotation, kabsch, atol=1e-9)
    np.testing.assert_allclose(fit.translation, middle - kabsch @ ours, atol=1e-9)


def test_covariance_is_that_of_the_errors() -> None:
    """Chi-square of 6 degrees of freedom over 2000 draws with unequal, tilted errors and uncertain positions."""
    rng = np.random.default_rng(2)
    body = RigidBody("cup", CUP.markers, CUP.positions, 1e-4)
    one = Constellation(body, BodySettings())
    half = rng.normal(0, 3e-4, (4, 3, 3))
    covariance = half @ half.transpose(0, 2, 1) + 1e-8 * np.eye(3)
    root = np.linalg.cholesky(covariance + body.sigma_m**2 * np.eye(3))
    turn, place = pose_at(0.7)
    d2 = []
    for _ in range(2000):
        xyz = body.positions @ turn.T + place + np.einsum("mij,mj->mi", root, rng.normal(size=(4, 3)))
        fit = one.fit(instant_points(xyz, covariance), np.arange(4))
        assert fit is not None
        error = np.concatenate([place - fit.translation, Rotation.from_matrix(turn @ fit.rotation.T).as_rotvec()])
        d2.append(error @ np.linalg.solve(fit.covariance, error))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 6 * 2000) / 2000
    assert low < np.mean(d2) < high
    assert stats.kstest(d2, stats.chi2(6).cdf).pvalue > 1e-3


def test_few_markers_leave_the_pose_open() -> None:
    line = RigidBody("line", ("a", "b", "c", "d"), [[0, 0, 0], [0.1, 0, 0], [0.25, 0, 0], [0, 0.1, 0]])
    one = Constellation(line, BodySettings())
    seen = instant_points(line.positions, np.tile(1e-8 * np.eye(3), (4, 1, 1)))
    assert one.fit(seen, np.array([0, 1, -1, -1])) is None
    assert one.fit(seen, np.array([0, 1, 2, -1])) is None  # in a line
    near = line.positions + [[0, 0, 0], [0, 1e-4, 0], [0, 0, 0], [0, 0, 0]]
    fit = one.fit(instant_points(near, seen.covariance), np.array([0, 1, 2, -1]))
    assert fit is None or not one.settled(fit)


@pytest.mark.parametrize("ids", [True, False])
def test_two_bodies_are_followed_through_clutter(ids: bool) -> None:
    rng = np.random.default_rng(3)
    tracks, truth = tracks_of(80, (DRONE, CUP), rng, hidden=0.1, clutter=40)
    if ids:
        poses = body_poses(tracks, [DRONE, CUP])
    else:
        tracker = BodyTracker([DRONE, CUP])
        rows = [rng.permutation(np.flatnonzero(tracks.frame == f)) for f in range(80)]
        parts = [tracker.update(points(tracks.xyz[r]), f, int(f * 1e7)) for f, r in enumerate(rows)]
        columns = [np.concatenate([getattr(p, c) for p in parts]) for c in BodyPoses.__dataclass_fields__]
        poses = BodyPoses(*columns)
    d2 = []
    for body, least in ((DRONE, 0.97), (CUP, 0.85)):
        mine = poses.of(body.name)
        assert len(mine) >= least * 80
        errors = errors_of(mine, truth[body.name])
        assert np.abs(errors[:, :3]).max() < 2e-3
        assert np.abs(errors[:, 3:]).max() < 0.02
        d2 += np.einsum("ni,nij,nj->n", errors, np.linalg.inv(mine.covariance), errors).tolist()
        rows = np.median(mine.residual_m)
        assert 0.5 * SIGMA < rows < 2 * SIGMA
    low, high = stats.chi2.ppf([0.0005, 0.9995], 6 * len(d2)) / len(d2)
    assert low < np.mean(d2) < high


def test_found_again_after_loss_with_new_tracks() -> None:
    rng = np.random.default_rng(4)
    tracks, truth = tracks_of(120, (DRONE, CUP), rng, clutter=10)
    gone = (tracks.frame >= 30) & (tracks.frame < 80) & (tracks.track < 10)
    later = np.where(tracks.frame >= 80, tracks.track + 100, tracks.track)
    poses = body_poses(replace(tracks, track=later).select(~gone), [DRONE, CUP])
    for name in ("drone", "cup"):
        mine = poses.of(name)
        assert mine.frame.tolist() == [*range(30), *range(80, 120)]
        assert np.abs(errors_of(mine, truth[name])[:, :3]).max() < 2e-3


def test_labels_are_filled_and_given_ones_believed() -> None:
    rng = np.random.default_rng(5)
    tracks, _ = tracks_of(20, (DRONE, CUP), rng, clutter=5)
    labelled = labelled_by_bodies(tracks, [DRONE, CUP])
    expected = np.array([*DRONE.markers, *CUP.markers, *([""] * 5)])
    np.testing.assert_array_equal(labelled.label, expected[tracks.track])
    # three labels are enough where three points alone would be too few to be found
    few = labelled.select(np.isin(labelled.track, [0, 1, 2]))
    assert len(body_poses(few, [DRONE]).of("drone")) == 20
    bare = tracks.select(np.isin(tracks.track, [0, 1, 2]))
    assert len(body_poses(bare, [DRONE]).of("drone")) == 0


def test_a_body_first_seen_with_three_markers_is_filled_in_backwards() -> None:
    rng = np.random.default_rng(6)
    tracks, _ = tracks_of(40, (DRONE,), rng)
    early = (tracks.frame < 15) & (tracks.track > 2)
    poses = body_poses(tracks.select(~early), [DRONE])
    assert poses.of("drone").frame.tolist() == list(range(40))


# D2, D3 and D4 lie like D1, D2 and D3 to 0.1 mm: three visible markers are ambiguous
FLIPPING = RigidBody("flip", ("a", "b", "c", "d"), [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0.05]])


def test_three_markers_that_can_be_taken_otherwise_are_withheld() -> None:
    check_bodies([FLIPPING])
    out = BodyTracker([FLIPPING], BodySettings(least_found=3)).update(points(FLIPPING.positions[:3]), 0, 0)
    assert out.status.tolist() == ["withheld"]
    assert out.n_markers.tolist() == [3]
    assert np.isnan(out.quaternion).all()


def test_no_flip_while_a_marker_is_hidden() -> None:
    """The fourth marker, which alone is distinctive, is hidden for 0.2 s; tracks are given, and half-way swapped."""
    rng = np.random.default_rng(7)
    tracks, truth = tracks_of(60, (FLIPPING,), rng)
    hidden = (tracks.frame >= 20) & (tracks.frame < 40) & (tracks.track == 3)
    for swap in (False, True):
        track = tracks.track.copy()
        if swap:  # a and c exchange their identities: the pose that would follow is rotated by 180 deg
            late = tracks.frame >= 30
            track[late] = np.array([2, 1, 0, 3])[track[late]]
        poses = body_poses(replace(tracks, track=track).select(~hidden), [FLIPPING]).of("flip")
        errors = errors_of(poses, truth["flip"])
        assert np.abs(errors[:, 3:]).max() < 0.05
        assert len(poses) >= (60 if not swap else 45)


def test_a_stray_point_is_left_out() -> None:
    rng = np.random.default_rng(8)
    tracks, truth = tracks_of(10, (DRONE,), rng)
    xyz = tracks.xyz.copy()
    xyz[(tracks.track == 2) & (tracks.frame > 3)] += [0.004, 0, 0.003]
    poses = body_poses(replace(tracks, xyz=xyz), [DRONE]).of("drone")
    assert poses.n_markers.tolist() == [6] * 4 + [5] * 6
    assert np.abs(errors_of(poses, truth["drone"])[:, :3]).max() < 1e-3


def test_samples_of_the_tracker_as_they_come() -> None:
    rng = np.random.default_rng(9)
    tracks, _ = tracks_of(3, (CUP,), rng)
    tracker = BodyTracker([CUP])
    status = np.zeros(len(tracks), np.int8)
    samples = Samples(
        tracks.frame, tracks.time_ns, tracks.track, tracks.xyz, tracks.covariance, tracks.n_cameras,
        tracks.residual_px, status,
    )  # fmt: skip
    out = tracker.update(samples, 2, 20_000_000)  # the samples of frames 0 and 1 come late and are not used
    assert out.n_markers.tolist() == [4]
    status[:] = 1
    assert len(tracker.update(samples, 2, 30_000_000)) == 0  # filled samples are no measurements


@pytest.mark.parametrize(
    ("bodies", "message"),
    [
        ([RigidBody("x", "abcd", CROSS)], r"'x' looks like itself turned.*differ by 0.0 mm.*; move marker '[abcd]'"),
        ([CUP, RigidBody("cap", "abcd", CUP.positions + [[0.001, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])],
         r"body 'cup' looks like body 'cap': markers C1, C2, C3, C4 can be taken for a, b, c, d: they differ by 0"),
        ([CUP, RigidBody("more", "abcde", np.vstack([CUP.positions[::-1], [[0.3, 0.2, 0.1]]]))],
         r"'cup' looks like body 'more': .* for d, c, b, a"),
        ([CUP, RigidBody("cup", "abcd", DRONE.positions[:4])], "body 'cup' stands twice"),
        ([CUP, RigidBody("mug", ("C1", "b", "c", "d"), DRONE.positions[:4])], "marker 'C1' stands twice"),
        ([RigidBody("big", "abc", [[0, 0, 0], [0.1, 0, 0], [0.1, 0.009, 0]])], "'b' and 'c' are 9.0 mm apart"),
    ],
)  # fmt: skip
def test_look_alikes_are_refused(bodies: list[RigidBody], message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        BodyTracker(bodies)
    assert "\n" not in str(error.value)


def test_the_advice_helps() -> None:
    with pytest.raises(InputError) as error:
        check_bodies([RigidBody("x", "abcd", CROSS)])
    words = str(error.value).split()
    marker = words[words.index("move") + 2].strip("'")
    step, axis = float(words[words.index("by", words.index("move")) + 1]), words[-1]
    places = CROSS.copy()
    places["abcd".index(marker), "xyz".index(axis[1])] += (-1 if axis[0] == "-" else 1) * step / 1000
    check_bodies([RigidBody("x", "abcd", places)])


def test_a_mirror_image_is_another_body() -> None:
    mirrored = RigidBody("mirrored", ("m1", "m2", "m3", "m4"), CUP.positions * [1, 1, -1])
    check_bodies([CUP, mirrored])
    flat = RigidBody("flat", "abc", DRONE.positions[:3] * [1, 1, 0])
    # in a plane the mirror image is the body turned over
    over = RigidBody("over", "def", flat.positions * [1, -1, 1])
    with pytest.raises(InputError, match="looks like"):
        check_bodies([flat, over])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), moved=st.floats(0, 0.02))
def test_alikeness_is_what_remains_after_the_best_turn(seed: int, moved: float) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.2, 0.2, (5, 3))
    order = rng.permutation(5)
    turned = Rotation.random(random_state=seed).apply(places[order]) + rng.normal(0, 1, 3)
    turned[0] += [moved, 0, 0]
    away = difference_m(places[order], turned)
    assert away <= moved + 1e-12
    found = nearest(RigidBody("a", "abcde", places[order]), RigidBody("b", "fghij", turned), moved + 1e-3)
    assert found is not None
    assert found[0] <= away + 1e-12


@pytest.mark.parametrize(
    ("markers", "places", "message"),
    [
        ("abc", [[0, 0, 0], [1, 0, 0], [2, 0, 0]], "lie in a line"),
        ("abc", [[0, 0, 0], [1, 0, 0], [np.nan, 0, 0]], "no finite number"),
        ("aab", CUP.positions[:3], "marker 'a' stands twice"),
        ("ab", CUP.positions[:2], "2 markers given"),
    ],
)
def test_faults_of_a_body(markers, places, message) -> None:
    with pytest.raises(ValueError, match=message):
        RigidBody("b", markers, places)


def test_learning_gives_the_shape_back() -> None:
    rng = np.random.default_rng(10)
    tracks, _ = tracks_of(200, (DRONE,), rng, hidden=0.1)
    body = learn_body(tracks, range(6), "drone", DRONE.markers)
    # unlike in origin and axes; alike in shape: a position is the mean of 180 samples
    assert difference_m(body.positions, DRONE.positions) < 4 * SIGMA / np.sqrt(180)
    assert 0.5 < body.sigma_m / (SIGMA / np.sqrt(180)) < 1.6
    np.testing.assert_allclose(body.positions.mean(axis=0), 0, atol=1e-15)
    assert len(body_poses(tracks, [body]).of("drone")) > 190


def test_what_cannot_be_learned() -> None:
    rng = np.random.default_rng(11)
    tracks, _ = tracks_of(20, (DRONE,), rng, clutter=1)
    with pytest.raises(InputError, match=r"'b/4' \(track 6\) moves most against the others"):
        learn_body(tracks, [0, 1, 2, 6], "b")
    with pytest.raises(InputError, match="no frame shows all"):
        learn_body(tracks, [0, 1, 99], "b")
    with pytest.raises(InputError, match="2 tracks and 2 names given"):
        learn_body(tracks, [0, 1], "b")
    symmetric, _ = tracks_of(20, (RigidBody("x", "abcd", CROSS),), rng)
    with pytest.raises(InputError, match="'x' looks like itself turned"):
        learn_body(symmetric, range(4), "x")
