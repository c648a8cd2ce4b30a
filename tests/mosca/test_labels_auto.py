"""Labels without training: the template's person, tracklets of points, and a walker of another lab."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from track_points import made_tracks

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.tracks.csv_columns import read_columns
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from mosca.labelling.automatic.body import TemplateBody, turned
from mosca.labelling.automatic.label import AutomaticSettings, label_automatically
from mosca.labelling.automatic.matching import Matching, _pair_gains
from mosca.labelling.automatic.naming import impossible, posed, rename
from mosca.labelling.automatic.personal import personal_template
from mosca.labelling.automatic.refine import alternatives, taken
from mosca.labelling.automatic.search import searched
from mosca.labelling.automatic.spread import Labelling
from mosca.labelling.automatic.template import STANDARD, BodyVariation, drawn_poses, expectation, read_template
from mosca.labelling.automatic.tracklets import tracklets_of
from scenarios.commands.labels_auto import PROBABILITIES, label_auto
from tests.studies.labels_auto import CMU, Take, measured, real_take, score, spoiled, twin_take


def test_the_right_side_mirrors_the_left_one() -> None:
    template = read_template()
    left, right = template.names.index("LELB"), template.names.index("RELB")
    assert template.other_side[left] == right
    np.testing.assert_allclose(template.place_m[right], template.place_m[left] * [1, -1, 1])
    arms = [template.segment_names.index(f"{side}_upper_arm") for side in "lr"]
    # both arms are raised sideways by 150 deg, and turn alike to the front
    np.testing.assert_allclose(np.degrees(template.turn_rad[arms, 0]), [[-20, 150], [-150, 20]])
    np.testing.assert_allclose(template.turn_rad[arms[0], 1], template.turn_rad[arms[1], 1])
    assert template.names[template.other_side[template.names.index("C7")]] == "C7"


def test_sets_have_their_own_names() -> None:
    names = read_template(set_name="cmu").names
    assert len(names) == 41
    assert {"LFWT", "RBAC", "RSHN", "LSHN"} <= set(names)
    assert not {"LASI", "RBAK", "LTIB", "LBAC", "LBAK"} & set(names)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('segment = "head"', 'segment = "hat"', "segment 'hat' is not listed"),
        ('parent = "l_forearm"', 'parent = "wing"', "parent 'wing' is not listed before it"),
        ('other_side = "RFHD"', 'other_side = "C7"', "'C7' is named twice"),
        ("height_m = 1.75", "height_m = -1", "key 'height_m': -1 given"),
        ('"LTOE", "LMT5"', '"LTOE", "LSHX"', "set 'cmu': marker 'LSHX' is not listed"),
        ('beside = "LTOE"', 'beside = "LTOX"', "marker 'LMT5': beside 'LTOX', which is not listed"),
        ('kind = "marker-template"', 'kind = "marker-model"', "is a marker model, not a marker template"),
    ],
)
def test_a_wrong_template_is_refused_in_one_line(tmp_path: Path, old: str, new: str, says: str) -> None:
    text = STANDARD.read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "set.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"set\.toml: ") as error:
        read_template(tmp_path / "set.toml")
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_set_is_refused() -> None:
    with pytest.raises(InputError, match=r"set 'helen' given; it has plug-in-gait, cmu"):
        read_template(set_name="helen")


def test_the_body_derivatives_are_those_of_its_places() -> None:
    body = TemplateBody(read_template())
    rng = np.random.default_rng(0)
    at = body.mean + rng.normal(size=body.p) * body.sigma
    at[3:6] = 0.0
    whole = Rotation.from_rotvec([0.1, 0.2, 0.5]).as_matrix()
    jacobian = body._places(at, whole)[2]
    for k in range(body.p):
        step = np.zeros(body.p)
        step[k] = 1e-6
        numeric = (body._places(at + step, whole)[0] - body._places(at - step, whole)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=1e-7)


def test_turns_are_rotations() -> None:
    for vector in ([0.0, 0.0, 0.0], [0.3, -1.0, 0.2], [0.0, 0.0, 3.0]):
        np.testing.assert_allclose(turned(np.array(vector)), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)


def test_a_drawn_person_keeps_distances_within_a_limb() -> None:
    template = read_template()
    xyz = drawn_poses(template, BodyVariation(), 3, 5, np.random.default_rng(2))
    away = np.linalg.norm(xyz[:, :, :, None] - xyz[:, :, None], axis=-1)
    same = template.segment[:, None] == template.segment
    np.testing.assert_allclose(away[:, :, same], away[:, :1, same].repeat(5, axis=1), atol=1e-12)
    assert np.median(away.std(axis=1)[:, ~same]) > 0.02
    assert (expectation(template).moved_m[same] < 1e-12).all()


def lines(speeds: list[list[float]], starts: list[list[float]], frames: int = 50) -> Tracks:
    """Points on straight lines at 100 Hz, each sample with a number of its own."""
    t = np.arange(frames) / 100
    xyz = np.array(starts)[None] + t[:, None, None] * np.array(speeds)[None]
    n = frames * len(starts)
    number = np.random.default_rng(0).permutation(n)
    row = np.repeat(np.arange(frames), len(starts))
    order = np.lexsort((number, row))
    return made_tracks(row[order], number[order], xyz.reshape(n, 3)[order])


def test_points_are_linked_by_constant_velocity() -> None:
    # two that fly at 2.5 m/s, 90 mm behind each other: 25 mm a frame
    tracks = lines([[2.5, 0, 0], [2.5, 0, 0], [0, 0, 0]], [[0, 0, 0], [0.09, 0, 0], [0, 1, 1]])
    found = tracklets_of(tracks)
    assert found.linked
    for k in range(len(found)):
        part = found.part(k)
        x, rows = found.xyz[part], found.row[part]
        speed = np.diff(x, axis=0) / np.diff(rows)[:, None] * 100
        assert np.ptp(speed, axis=0).max(initial=0.0) < 1e-9
    assert len(found) == 3


def test_points_that_meet_are_not_linked_across() -> None:
    # they pass each other at 2 mm: which is which is not sure, so tracklets end there
    tracks = lines([[1.0, 0, 0], [-1.0, 0, 0]], [[-0.25, 0, 0], [0.25, 0.002, 0]])
    found = tracklets_of(tracks)
    for k in range(len(found)):
        assert np.ptp(found.xyz[found.part(k)][:, 1]) == 0.0
    assert len(found) >= 3


def test_a_track_that_jumps_or_was_long_away_is_split() -> None:
    rows = np.r_[0:20, 30:50]
    x = np.where(np.arange(40) < 30, 0.0, 0.4)
    tracks = made_tracks(rows, np.zeros(40, dtype=int), np.stack([x, 0 * x, 0 * x], axis=1))
    assert tracklets_of(tracks).starts.tolist() == [0, 20, 30, 40]


def test_nothing_and_clutter_give_no_labels() -> None:
    template = read_template()
    assert len(label_automatically(Tracks.none(), template).tracks) == 0
    rng = np.random.default_rng(1)
    places = rng.uniform(-1, 1, (12, 3))
    rows = np.repeat(np.arange(60), 12)
    tracks = made_tracks(rows, np.tile(np.arange(12), 60), np.tile(places, (60, 1)))
    done = label_automatically(tracks, template)
    # chance constellations are no person: hardly a label, and what has none has no probability
    assert (done.tracks.label != "").mean() < 0.5
    assert (done.probability[done.tracks.label == ""] == 0).all()


def test_the_twins_walker_is_labelled_and_ghosts_are_not() -> None:
    take = twin_take("walk", 1.75, 32, 1.2)
    template = read_template()
    tracks, what = spoiled(take, np.random.default_rng(3), 0.05, False, 0.05)
    done = label_automatically(tracks, template, AutomaticSettings(frames=1, further=1))
    reached = score(done, tracks, what, template)
    assert reached.precision > 0.99
    assert reached.f1 > 0.97
    assert len(done.tracks) == len(tracks)


def test_a_marker_that_is_worn_with_another_is_hardly_there_alone() -> None:
    template = read_template()
    problem = Matching(
        np.random.default_rng(0).normal(size=(9, 4, 3)), [0], TemplateBody(template), expectation(template)
    )
    back, spine, left, right = (template.names.index(name) for name in ("RBAK", "C7", "LTIB", "RTIB"))

    def odds(*there: int) -> float:
        chosen = np.full(problem.m, -1)
        chosen[list(there)] = np.arange(len(there))
        return problem.presence(chosen)

    # by hand, from the shares 0.3 and 0.97 of RBAK and C7, 0.8 of TIB, and 0.97 of worn markers that are seen
    pair = [0.3 * 0.97**2 + 0.7 * 0.03**2, 0.3 * 0.03 * 0.97 + 0.7 * 0.97 * 0.03, 0.3 * 0.03**2 + 0.7 * 0.97**2]
    lonely = [0.03 * 0.03 * 0.97 + 0.97 * 0.97 * 0.03, 0.03 * 0.03**2 + 0.97 * 0.97**2]
    assert odds() == 0.0
    assert odds(back, spine) - odds(spine) == pytest.approx(np.log(pair[1] / pair[2]))
    assert odds(back) == pytest.approx(np.log(lonely[0] / lonely[1]))
    one = 0.8 * 0.97 * 0.03 + 0.2 * 0.03 * 0.97
    assert odds(left, right) - odds(left) == pytest.approx(np.log((0.8 * 0.97**2 + 0.2 * 0.03**2) / one))


def test_a_name_is_compared_with_absent_ones_of_either_order() -> None:
    """A point of a foot without its other: TOE comes before MT5 in the template, and each is an alternative to it."""
    take = twin_take("walk", 1.55, 41, 0.3)
    template = read_template()
    names = [name for name in take.names if name != "LTOE"]
    xyz = take.xyz[:, [take.names.index(name) for name in names]]
    problem = Matching(xyz, [10], TemplateBody(template), expectation(template))
    chosen = np.full(problem.m, -1)
    chosen[[template.names.index(name) for name in names]] = np.arange(len(names))
    toe, fifth = (template.names.index(name) for name in ("LTOE", "LMT5"))
    chosen[toe], chosen[fifth] = chosen[fifth], -1
    others = alternatives(problem, chosen, posed(problem, chosen).poses)
    assert any(other[fifth] == chosen[toe] and other[toe] < 0 for other in others)


def test_a_name_that_a_ghost_took_is_compared_with_its_owner() -> None:
    """An ankle's name is at a ghost that drifts by it, and it is called the forefoot, which nobody wears here."""
    take = twin_take("run", 1.75, 32, 0.3)
    template = read_template()
    names = [template.names.index(name) for name in take.names]
    ankle, fifth = (template.names.index(name) for name in ("LANK", "LMT5"))
    true = len(take.names) - 1
    order = [k for k in range(len(names)) if names[k] != ankle] + [names.index(ankle)]
    drift_m = np.linspace(-0.005, 0.005, len(take.xyz))[:, None, None]
    ghost = take.xyz[:, order[-1:]] + [0.0, 0.03, 0.02] + drift_m * [0.0, 1.0, 0.0]
    problem = Matching(
        np.concatenate([take.xyz[:, order], ghost], axis=1), [10], TemplateBody(template), expectation(template)
    )
    chosen = np.full(problem.m, -1)
    chosen[np.array(names)[order]] = np.arange(len(order))
    chosen[ankle], chosen[fifth] = true + 1, true
    poses = posed(problem, chosen).poses
    others = alternatives(problem, chosen, poses)
    assert any(other[ankle] == true and other[fifth] < 0 and not (other == true + 1).any() for other in others)
    # what is gained by it, summed anew over all pairs
    right = chosen.copy()
    right[ankle], right[fifth] = true, -1
    places = problem.places(poses)

    def total(one: np.ndarray) -> float:
        there = one >= 0
        return float(places[there, one[there]].sum()) + problem.both(problem.pairs, one)

    gain = taken(problem, chosen, problem.gains(chosen, places))[ankle, fifth]
    assert gain == pytest.approx(total(right) - total(chosen), abs=1e-3)


def labelled(xyz: np.ndarray, labels: list[int]) -> Labelling:
    """A take of points (t, n, 3), each a tracklet, NaN where not seen, with ``labels`` (n,), -1 for none."""
    row, number = np.nonzero(np.isfinite(xyz[:, :, 0]))
    tracklets = tracklets_of(made_tracks(row, number, xyz[row, number]))
    labelling = Labelling(tracklets, expectation(read_template()), 0.01)
    for k, label in enumerate(labels):
        labelling.give(k, label)
    return labelling


def test_a_label_that_moves_to_an_unused_name_keeps_its_positions() -> None:
    template = read_template()
    forearm, finger = template.names.index("LFRM"), template.names.index("LFIN")
    assert finger > forearm  # the unused name comes later, and its nothing must not be written over what came
    xyz = np.zeros((5, 1, 3)) + np.arange(5.0)[:, None, None] * 1e-3
    labelling = labelled(xyz, [forearm])
    rename(labelling, np.array([forearm]), np.array([finger]))
    assert labelling.label.tolist() == [finger]
    np.testing.assert_array_equal(labelling.xyz[:, finger], xyz[:, 0])
    assert not np.isfinite(labelling.xyz[:, forearm]).any()


def test_what_is_seen_beside_a_hidden_marker_is_not_that_marker() -> None:
    template = read_template()
    toe, fifth, heel = (template.names.index(name) for name in ("LTOE", "LMT5", "LHEE"))
    xyz = np.zeros((40, 4, 3)) + np.arange(4.0)[None, :, None]
    xyz[30:, 0] = np.nan  # the toe is hidden at last
    xyz[:30, 2] = np.nan  # what is seen only then may be it
    xyz[:25, 3] = np.nan  # a ghost, beside the toe for five frames
    labelling = labelled(xyz, [toe, fifth, -1, -1])
    lost = impossible(labelling, np.array([fifth, -1, -1]), np.array([1, 2, 3]))
    assert (lost[toe] < 0).tolist() == [True, False, True]
    # what is seen now, and what the take does not have, is open to all
    assert not lost[[fifth, heel]].any()


def test_two_still_points_weigh_at_a_joint_too() -> None:
    """An elbow and a wrist keep their distance; a forearm's marker must not gain more by the weight alone."""
    template = read_template()
    elbow, wrist, forearm = (template.names.index(name) for name in ("LELB", "LWRA", "LFRM"))
    away, change = np.full((8, 8), 0.6), np.full((8, 8), 0.1)  # a person in motion
    away[[0, 1], [1, 0]] = 0.25

    def gains(still: float) -> tuple[float, float]:
        change[[0, 1], [1, 0]] = still
        both = _pair_gains(away, change, expectation(template))[0]
        return float(both[elbow, 0, wrist, 1]), float(both[forearm, 0, wrist, 1])

    joint, limb = gains(0.001)
    assert joint > 0.2 * limb > 0
    # points that move against each other are on no limb, and little is said of two
    joint, limb = gains(0.15)
    assert limb < 5 * joint < 0


@pytest.mark.parametrize("quarters", [-1, 2])
def test_a_head_found_turned_by_right_angles_is_turned_back(quarters: int) -> None:
    """Four markers on a head are nearly a square: what it was taken for must not hold its pose when it is anew."""
    take = twin_take("boxing", 1.75, 41, 0.5, 2)
    template = read_template()
    problem = Matching(take.xyz, [25], TemplateBody(template), expectation(template))
    true = np.full(problem.m, -1)
    true[[template.names.index(name) for name in take.names]] = np.arange(problem.n)
    head = [template.names.index(name) for name in ("LFHD", "RFHD", "RBHD", "LBHD")]
    wrong = true.copy()
    wrong[head] = np.roll(true[head], quarters)
    found = searched(problem, posed(problem, wrong))
    np.testing.assert_array_equal(found.chosen[head], true[head])


def test_linear_evidence_is_near_the_evidence() -> None:
    take = twin_take("walk", 1.75, 32, 0.3)
    template = read_template()
    problem = Matching(take.xyz, [5, 20], TemplateBody(template), expectation(template)).with_tails()
    chosen = np.full(problem.m, -1)
    chosen[[template.names.index(name) for name in take.names]] = np.arange(len(take.names))
    poses = [posed(problem.frame(f), chosen).poses[0] for f in range(2)]
    value, poses = problem.evidence(chosen, poses, 10)
    linear = problem.linear(poses)
    for name in ("LKNE", "C7"):
        less = chosen.copy()
        less[template.names.index(name)] = -1
        lost = problem.evidence(less, poses, 10)[0] - value
        assert linear.of(less) - linear.of(chosen) == pytest.approx(lost, abs=0.7)
        assert abs(lost) > 2.0


@pytest.mark.slow
def test_an_early_name_is_corrected_by_later_evidence() -> None:
    """A foot's second marker is hidden for the first half: alone, the other one is no sure LMT5."""
    take = twin_take("walk", 1.55, 41, 2.0)
    template = read_template()
    hidden = take.xyz.copy()
    hidden[:100, take.names.index("LTOE")] = np.nan
    settings = AutomaticSettings(frames=1, further=1)

    def labels(xyz: np.ndarray) -> set[str]:
        tracks, what = spoiled(Take(take.names, xyz, 100.0), np.random.default_rng(0), 0.0, False)
        done = label_automatically(tracks, template, settings).tracks
        at = np.lexsort((*done.xyz.T, done.frame)), np.lexsort((*tracks.xyz.T, tracks.frame))
        early = (what[at[1]] == "LMT5") & (done.frame[at[0]] < 100)
        return set(done.label[at[0]][early].tolist())

    assert labels(hidden[:100]) <= {"", "LTOE"}
    assert labels(hidden) == {"LMT5"}


@pytest.mark.slow
def test_a_labelled_take_of_the_person_is_the_template() -> None:
    static, take = twin_take("range_of_motion", 1.95, 32, 0.1), twin_take("walk", 1.95, 32, 1.0)
    # names that no template has
    own = {name: name for name in static.names} | {"LTHI": "wand"}
    tracks, what = spoiled(static, np.random.default_rng(0), 0.0, False)
    named = replace(tracks, label=np.array([own[name] for name in what.tolist()]))
    template = personal_template(named, read_template(), "static")
    assert set(template.names) == set(own.values())
    assert template.segment_names[template.segment[template.names.index("wand")]] == "l_thigh"
    # distances on a limb are this person's
    expected = expectation(template)
    first = [template.names.index(name) for name in ("LFHD", "RBHD")]
    true = np.linalg.norm(static.xyz[0, static.names.index("LFHD")] - static.xyz[0, static.names.index("RBHD")])
    assert expected.mean_m[first[0], first[1]] == pytest.approx(true, abs=0.005)
    tracks, what = spoiled(take, np.random.default_rng(1), 0.05, False, 0.05)
    what = np.array([own.get(name, "") for name in what.tolist()])
    done = label_automatically(tracks, template, AutomaticSettings(frames=1, further=1))
    reached = score(done, tracks, what, template)
    assert reached.precision > 0.995
    assert reached.f1 > 0.97


@pytest.mark.slow
def test_the_verb_writes_names_with_their_probabilities(tmp_path: Path) -> None:
    static, take = twin_take("walk", 1.75, 32, 0.1), twin_take("walk", 1.75, 32, 1.0)
    tracks, what = spoiled(static, np.random.default_rng(0), 0.0, False)
    write_tracks(replace(tracks, label=what), tmp_path / "static.csv", 100.0)
    tracks, _ = spoiled(take, np.random.default_rng(1), 0.05, False)
    write_tracks(tracks, tmp_path / "take.csv", 100.0)
    out, sure = tmp_path / "named.c3d", tmp_path / "sure.csv"
    lines = label_auto(tmp_path / "take.csv", out, None, tmp_path / "static.csv", None, sure, None)
    assert lines[0].startswith("32 of 32 markers of the set found")
    named = read_tracks(out)
    cells = read_columns(sure, PROBABILITIES, "file of probabilities")
    assert set(cells["label"]) == set(named.label.tolist()) - {""}
    stated = np.array(cells["probability"], dtype=float)
    assert ((stated >= 0.95) & (stated <= 1)).all()
    # the list is of the least of each, lowest first
    least = {name: stated[np.array(cells["label"]) == name].min() for name in set(cells["label"])}
    assert lines[1].split()[0] == min(sorted(least), key=lambda name: least[name])


def test_a_static_take_without_known_names_is_refused() -> None:
    tracks, _ = spoiled(twin_take("walk", 1.75, 32, 0.1), np.random.default_rng(0), 0.0, False)
    with pytest.raises(InputError, match=r"static\.csv: no sample has a label"):
        personal_template(tracks, read_template(), "static.csv")
    named = replace(tracks, label=np.array([f"m{k}" for k in tracks.track.tolist()]))
    with pytest.raises(InputError, match=r"static\.csv: 0 labels that the template has, 8 or more are wanted"):
        personal_template(named, read_template(), "static.csv")


@pytest.mark.data
@pytest.mark.slow
def test_the_set_of_a_real_walker_is_found(data_dir: Path) -> None:
    take = real_take(data_dir / "people/cmu_02_01.c3d", {})
    tracks, what = spoiled(take, np.random.default_rng(0), 0.0, False)
    template = read_template()
    done = label_automatically(tracks, template, AutomaticSettings(frames=1, further=1))
    assert done.set_name == "cmu"
    what = np.array([CMU.get(name, name) for name in what.tolist()])
    reached = score(done, tracks, what, template)
    assert reached.precision > 0.995
    assert reached.f1 > 0.98


@pytest.mark.data
def test_a_real_walker_shuffled_in_each_frame(data_dir: Path) -> None:
    take = real_take(data_dir / "people/cmu_02_01.c3d", {})
    assert len(take.names) == 41
    reached = measured(take, read_template(set_name="cmu"), 0, gaps=0.1, shuffled=True).score
    assert reached.f1 > 0.98
    assert reached.precision > 0.995


@pytest.mark.data
def test_a_mirrored_walker_has_the_sides_exchanged(data_dir: Path) -> None:
    """A person in a mirror is a person whose left side is the right one: sides are told by the space alone."""
    take = real_take(data_dir / "people/cmu_02_01.c3d", {})
    other = {"L": "R", "R": "L"}
    names = [other[name[0]] + name[1:] if name[0] in other and name != "RBAC" else name for name in take.names]
    mirrored = Take(names, take.xyz[:200] * [1.0, -1.0, 1.0], take.rate_hz)
    tracks, what = spoiled(mirrored, np.random.default_rng(0), 0.0, False)
    template = read_template(set_name="cmu")
    reached = score(label_automatically(tracks, template, AutomaticSettings(frames=1)), tracks, what, template)
    assert reached.precision > 0.97
    assert reached.recall > 0.9
