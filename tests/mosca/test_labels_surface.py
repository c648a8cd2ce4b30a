"""Labels of a face from a surface model: statistics against scipy's, drawn faces with known names, broken tracks."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal
from track_points import made_tracks

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.labelling.surface.fit import SurfaceFitter, SurfacePose, aligned
from mosca.labelling.surface.label import label_surface
from mosca.labelling.surface.matching import SurfaceMatcher, exchange_odds
from mosca.labelling.surface.model import FACE, NOISE_M, SurfaceModel, read_surface_model

MODEL = read_surface_model()
M = len(MODEL.names)
HERE = SurfacePose(np.eye(3), np.zeros(3), 1.0)


def drawn(rng: np.random.Generator, frames: int = 1) -> Array:
    """Return a person's markers (frames, m, 3), model axes, drawn from the model's own distributions."""
    root = np.linalg.cholesky(MODEL.motion + 1e-14 * np.eye(3 * M))
    person = rng.multivariate_normal(np.zeros(3 * M), MODEL.person).reshape(M, 3)
    moved = (rng.normal(size=(frames, 3 * M)) @ root.T).reshape(frames, M, 3)
    return np.exp(rng.normal(0, MODEL.size_sigma)) * MODEL.place_m + person + moved


def few(count: int = 8) -> SurfaceModel:
    """Return a model of the first markers alone."""
    part = slice(0, 3 * count)
    return SurfaceModel(
        MODEL.names[:count], MODEL.place_m[:count], MODEL.person[part, part], MODEL.motion[part, part], 0.07
    )


def test_the_face_is_as_large_as_adults_are() -> None:
    """Farkas 1994, North American adults: mouth 50 to 54 mm wide, sellion to subnasale and nose about 50 mm."""
    at = dict(zip(MODEL.names, MODEL.place_m, strict=True))
    assert len(at) == 40
    assert np.linalg.norm(at["LMTC"] - at["RMTC"]) == pytest.approx(0.052, abs=0.004)
    assert np.linalg.norm(at["MNBR"] - at["MNTP"]) == pytest.approx(0.038, abs=0.006)
    np.testing.assert_allclose(at["RBRO"], at["LBRO"] * [1, -1, 1])
    assert np.linalg.eigvalsh(MODEL.covariance()).min() > 0


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('other_side = "RFHD"', 'other_side = "MFHD"', "'MFHD' is named twice"),
        ("size_sigma = 0.07", "size_sigma = 0", "key 'size_sigma': 0 given"),
        ("between_parts = 0.2", "between_parts = 2", "key 'between_parts': 2 given"),
        ('kind = "surface-model"', 'kind = "marker-template"', "is a marker template, not a surface model"),
    ],
)
def test_a_wrong_model_is_refused_in_one_line(tmp_path: Path, old: str, new: str, says: str) -> None:
    text = FACE.read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "one.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"one\.toml: ") as error:
        read_surface_model(tmp_path / "one.toml")
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_alignment_finds_the_pose_that_was_put(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, shift, size = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3), rng.uniform(0.8, 1.2)
    pose = aligned(shift + size * MODEL.place_m @ turn.T, MODEL.place_m)
    np.testing.assert_allclose(pose.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(pose.translation, shift, atol=1e-9)
    assert pose.size == pytest.approx(size, abs=1e-9)


def test_evidence_is_the_density_with_pose_and_size_integrated_out() -> None:
    """Differences of evidence between two sets of points near each other, against scipy's normal distribution.

    A flat prior of the pose is one of 1 m and 10 rad here; the size's is the model's. Linear about the same pose.
    """
    model, rng = few(), np.random.default_rng(4)
    fitter = SurfaceFitter(model)
    points = model.place_m + rng.normal(0, 2e-3, model.place_m.shape)
    base = fitter.fit(points, HERE)
    local = base.pose.local(points)
    columns = []
    for k in range(3):
        columns.append(np.cross(local, np.eye(3)[k]).reshape(-1) * 10.0)
    columns += [np.tile(np.eye(3)[k], len(local)) for k in range(3)]
    columns.append((base.pose.size * model.place_m).reshape(-1) * model.size_sigma)
    pose = np.column_stack(columns)
    covariance = model.covariance() + NOISE_M**2 * np.eye(len(pose)) + pose @ pose.T
    mean = model.place_m.reshape(-1)
    witness = multivariate_normal(mean, covariance)
    for _ in range(5):
        other = points + rng.normal(0, 1e-3, points.shape)
        moved = fitter.fit(other, base.pose)
        told = moved.evidence - base.evidence
        wanted = witness.logpdf(base.pose.local(other).reshape(-1)) - witness.logpdf(local.reshape(-1))
        assert told == pytest.approx(wanted, abs=0.15)


def test_expected_places_are_as_far_off_as_they_say() -> None:
    """NEES of 3 of markers that are seen, and of hidden ones, over drawn faces; standard error 0.11 and 0.2."""
    rng, fitter = np.random.default_rng(1), SurfaceFitter(MODEL)
    found: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(25):
        turn, shift = Rotation.random(rng=rng), rng.normal(size=3)
        points = turn.apply(drawn(rng)[0]) + shift + rng.normal(0, NOISE_M, (M, 3))
        given_points = points.copy()
        given_points[rng.choice(M, 8, replace=False)] = np.nan
        near = (turn * Rotation.from_rotvec([0.2, -0.1, 0.2])).as_matrix()
        fit = fitter.fit(given_points, SurfacePose(near, points.mean(axis=0), 1.0))
        away = fit.pose.local(points) - fit.mean
        nees = np.einsum("ia,iab,ib->i", away, np.linalg.inv(fit.spread), away)
        for seen in found:
            found[seen] += nees[fit.seen == seen].tolist()
    assert np.mean(found[True]) == pytest.approx(3.0, abs=0.35)
    assert np.mean(found[False]) == pytest.approx(3.0, abs=0.6)


def test_odds_of_an_exchange_are_those_of_the_exchanged_match() -> None:
    points = drawn(np.random.default_rng(3))[0]
    matcher = SurfaceMatcher(SurfaceFitter(MODEL), 0.97, 1.0)
    match = matcher.valued(points, np.arange(M), HERE)
    odds = exchange_odds(match)
    for one, two in (("LULP", "MULP"), ("RBRI", "RBRM"), ("LMTC", "LLLP")):
        i, j = MODEL.names.index(one), MODEL.names.index(two)
        chosen = np.arange(M)
        chosen[[i, j]] = j, i
        other = matcher.valued(points, chosen, match.fit.pose)
        assert np.log(odds[i, j]) == pytest.approx(other.value - match.value, rel=0.1)
    assert not odds[np.arange(M), np.arange(M)].any()


@pytest.mark.parametrize(("seed", "hidden"), [(0, 0), (1, 0), (2, 2)])
def test_a_drawn_face_is_named_wherever_it_looks(seed: int, hidden: int) -> None:
    """From nothing, turned anywhere: no sure name is wrong."""
    rng = np.random.default_rng(seed)
    points = Rotation.random(rng=rng).apply(drawn(rng)[0]) + rng.normal(size=3)
    order = rng.permutation(M)[: M - hidden]
    matcher = SurfaceMatcher(SurfaceFitter(MODEL), 0.97, 1.0)
    best, rivals = matcher.challenged(points[order], matcher.found(points[order]))
    sure = matcher.probability(best, rivals) >= 0.99
    assert (order[best.chosen[sure]] == np.flatnonzero(sure)).all()
    assert sure.sum() >= 20


def test_a_chain_of_neighbours_is_undone_at_once() -> None:
    """Four markers, each with its neighbour's point and the last one hidden: found without help, and against odds."""
    points = MODEL.place_m + np.random.default_rng(3).normal(0, 2e-3, (M, 3))
    chain = [MODEL.names.index(name) for name in ("RLID", "RCKM", "RNLF", "RMTC")]
    matcher = SurfaceMatcher(SurfaceFitter(MODEL), 0.97, 1.0)
    shown = np.delete(points, chain[-1], axis=0)
    right = np.arange(M) - (np.arange(M) > chain[-1])
    right[chain[-1]] = -1
    wrong = right.copy()
    wrong[chain] = [-1, *right[chain[:-1]]]
    match = matcher.valued(shown, wrong, HERE)
    best, rivals = matcher.challenged(shown, [match])
    assert best.value > match.value
    assert (best.chosen == right).all()
    assert any((one.chosen == wrong).all() for one in rivals)


def take(seed: int, frames: int = 40) -> tuple[Tracks, Array]:
    """Return unlabelled tracks of a drawn face that moves slowly, some broken, and true names of the samples."""
    rng = np.random.default_rng(seed)
    knots = drawn(rng, 5)
    at = np.linspace(0, 4, frames)
    low = np.minimum(at.astype(int), 3)
    share = (at - low)[:, None, None]
    xyz = (1 - share) * knots[low] + share * knots[low + 1]
    turn = Rotation.from_rotvec(np.outer(at, [0.05, 0.02, -0.04]))
    world = np.stack([r.apply(x) for r, x in zip(turn, xyz, strict=True)]) + [0.2, -0.1, 1.2]
    there = np.ones((frames, M), dtype=bool)
    number = np.tile(rng.permutation(M), (frames, 1))
    for marker in rng.choice(M, 6, replace=False).tolist():
        gap = int(rng.integers(8, frames - 12))
        there[gap : gap + 6, marker] = False
        number[gap + 6 :, marker] = M + marker
    frame, marker = np.nonzero(there)
    tracks = made_tracks(frame, number[frame, marker], world[frame, marker])
    return tracks, np.array(MODEL.names)[marker]


def test_broken_tracks_of_a_take_keep_their_names() -> None:
    tracks, true = take(2)
    done = label_surface(tracks, MODEL)
    label = dict(zip(map(tuple, done.tracks.xyz.round(9)), done.tracks.label.tolist(), strict=True))
    given_labels = np.array([label[tuple(p)] for p in tracks.xyz.round(9)])
    named = given_labels != ""
    assert (given_labels[named] == true[named]).all()
    assert named.mean() > 0.7
    assert (done.probability[done.tracks.label != ""] >= 0.99).all()
    assert (done.probability[done.tracks.label == ""] == 0).all()
    # a mirrored face is a face whose left side is on the right
    mirrored = made_tracks(tracks.frame, tracks.track, tracks.xyz * [1, -1, 1])
    again = label_surface(mirrored, MODEL).tracks
    label = dict(zip(map(tuple, again.xyz.round(9)), again.label.tolist(), strict=True))
    other = np.array([name.translate(str.maketrans("LR", "RL", ""))[:1] + name[1:] for name in true.tolist()])
    sides = np.array([label[tuple(p)] for p in mirrored.xyz.round(9)])
    assert (sides[sides != ""] == other[sides != ""]).all()
    assert (sides != "").mean() > 0.7


def test_too_few_points_have_no_names() -> None:
    tracks, _ = take(2, 30)
    some = tracks.select(np.isin(tracks.track, np.unique(tracks.track)[:5]))
    done = label_surface(some, MODEL)
    assert (done.tracks.label == "").all()
    nothing = label_surface(tracks.select(np.zeros(len(tracks), dtype=bool)), MODEL)
    assert len(nothing.tracks) == 0
