"""Correspondence: every group right, ghosts refused, ambiguities of two cameras left open."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from rigs import ring
from scipy.stats import chi2

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.hypothesis import rather_hidden
from mosca.correspondence.match import EVERYWHERE, MatchSettings, match, match_counted
from mosca.data.detections import MERGED, PARTIAL, UNREFINED, Detections
from mosca.data.rays import Predicted
from mosca.data.rig import MoscaLens

LENS = MoscaLens(8.0, 330.0, 240.0, 0.01, 0.01, -0.006, 1e-3, -1.5e-5, 0, 1e-4, 5e-5)
SIGMA = 0.05


def rig_of(count):
    return ring(count, LENS, height_m=0.5 + 0.7 * (np.arange(count) % 2))


def chosen(detections, rows):
    """Some rows of a camera's detections, in the order given."""
    columns = {name: getattr(detections, name)[rows] for name in Detections.__dataclass_fields__ if name != "camera"}
    return replace(detections, **columns)


def detected(rig, points, rng, sigma=SIGMA, clutter=0, miss=0.0):
    """Detections in random order and, for each camera, the point behind each of them (-1: clutter)."""
    found, truth = {}, {}
    for camera in rig.cameras:
        xy = project(camera, points)
        keep = np.flatnonzero((rng.random(len(points)) >= miss) & np.isfinite(xy).all(axis=1))
        keep = rng.permutation(keep)
        noise = rng.uniform((0, 0), (655, 490), (clutter, 2))
        places = np.concatenate([xy[keep] + rng.normal(0, sigma, (len(keep), 2)), noise])
        n = len(places)
        # the image of a ball of 14 mm; clutter has the size of one at the volume's middle
        away = np.linalg.norm(points[keep] - camera.world_from_camera.translation, axis=1)
        diameter = 800.0 * 0.014 / np.concatenate([away, np.full(clutter, 3.0)])
        found[camera.name] = Detections(
            camera.name, places, np.tile(sigma**2 * np.eye(2), (n, 1, 1)), diameter, np.full(n, 100.0), np.ones(n)
        )
        truth[camera.name] = np.concatenate([keep, np.full(clutter, -1)]).astype(int)
    return found, truth


def grouped(rig, found, settings=None, predicted=None):
    settings = settings or MatchSettings(camera_sigma_px=0.0)
    bundle = make_ray_table(rig, found, settings.camera_sigma_px)
    return match(bundle, predicted or Predicted.nothing(), settings, EVERYWHERE)


def expected_at(places, sigma_m):
    return Predicted(places, np.tile(sigma_m**2 * np.eye(3), (len(places), 1, 1)))


def members(rig, points, truth):
    """For each group the set of true points behind its rays."""
    return [{int(truth[c.name][row[k]]) for k, c in enumerate(rig.cameras) if row[k] >= 0} for row in points.rays]


@pytest.mark.parametrize("count", [3, 4, 8])
def test_all_groups_right(count):
    rng = np.random.default_rng(count)
    rig, truth3d = rig_of(count), rng.uniform(-0.5, 0.5, (100, 3))
    found, behind = detected(rig, truth3d, rng)
    points = grouped(rig, found)
    groups = members(rig, points, behind)
    right = sum(len(g) == 1 and points.n_cameras[i] == count for i, g in enumerate(groups))
    # the noise throws a ray beyond 4 sigma once in some 10,000; three cameras leave chance pairs of three
    assert right >= 97
    assert sum(len(g) > 1 for g in groups) <= 1


def test_clutter_and_missed_images_make_no_wrong_groups_of_three():
    rng = np.random.default_rng(5)
    rig, truth3d = rig_of(4), rng.uniform(-0.5, 0.5, (60, 3))
    found, behind = detected(rig, truth3d, rng, clutter=10, miss=0.1)
    points = grouped(rig, found, MatchSettings(camera_sigma_px=0.0, minimum_cameras=3))
    groups = members(rig, points, behind)
    assert sum(len(g) > 1 or -1 in g for g in groups) == 0
    seen = np.sum([np.bincount(b[b >= 0], minlength=60) for b in behind.values()], axis=0)
    assert len(groups) >= 0.97 * (seen >= 3).sum()


@pytest.mark.parametrize(("sigma_m", "told"), [(0.002, True), (0.03, False)])
def test_a_track_long_unseen_does_not_choose_between_two_images(sigma_m, told):
    """Two targets in one epipolar plane, one of them unseen by the second camera: both its images fit the track."""
    rig, rng = replace(rig_of(3), cameras=rig_of(3).cameras[:2]), np.random.default_rng(3)
    first, others = np.array([0.05, 0.02, 0.1]), rng.uniform(-0.5, 0.5, (20, 3))
    toward = first - rig.cameras[0].world_from_camera.translation
    places = np.array([first, first + 0.02 * toward / np.linalg.norm(toward), *others])
    found, behind = detected(rig, places, rng, sigma=0.02)
    found["c0"] = chosen(found["c0"], np.flatnonzero(behind["c0"] != 1))
    about = np.concatenate([[sigma_m**2 * np.eye(3)], np.tile(1e-6 * np.eye(3), (20, 1, 1))])
    expected = Predicted(np.array([first + 0.3 * sigma_m, *others]), about)
    points = match(make_ray_table(rig, found, 0.0), expected, MatchSettings(camera_sigma_px=0.0))
    assert len(points) == 20 + told
    assert (np.linalg.norm(points.xyz - first, axis=1) < 1e-3).sum() == told


def test_two_cameras_leave_open_and_count_what_they_cannot_tell():
    rig = rig_of(2)
    # two targets in one epipolar plane: four crossings of rays, none better than the other
    a, b = (c.world_from_camera.translation for c in rig.cameras)
    plane = np.cross(a, b)
    inside = np.cross(plane, a + b)
    inside /= np.linalg.norm(inside)
    targets = np.array([0.2 * inside, -0.2 * inside])
    rng = np.random.default_rng(0)
    found, behind = detected(rig, targets, rng, sigma=0.01)
    result = match_counted(make_ray_table(rig, found, 0.0), Predicted.nothing(), MatchSettings(camera_sigma_px=0.0))
    assert (len(result.points), result.left_open) == (0, 4)
    # with the tracks' predictions the true pairs are taken
    expected = expected_at(targets, 1e-2)
    assert sorted(map(sorted, members(rig, grouped(rig, found, predicted=expected), behind))) == [[0], [1]]


def test_a_bad_ray_is_left_out():
    rig, rng = rig_of(5), np.random.default_rng(3)
    truth3d = np.array([[0.1, 0.2, -0.1]])
    found, _ = detected(rig, truth3d, rng, sigma=0.02)
    found["c2"] = replace(found["c2"], xy_px=found["c2"].xy_px + 0.15)
    points = grouped(rig, found)
    best = int(np.argmax(points.n_cameras))
    assert points.rays[best].tolist() == [0, 0, -1, 0, 0]
    assert np.linalg.norm(points.xyz[best] - truth3d[0]) < 3e-4


def test_a_group_that_loses_an_image_is_tried_again_before_worse_ones_take_its_others():
    rig = rig_of(5)
    centres = [camera.world_from_camera.translation for camera in rig.cameras]
    # a target stands before it in c0; c4 does not see it; in c0 something else is where the ray of c1 goes on
    here = np.array([0.1, 0.05, -0.1])
    before = here + 0.15 * (centres[0] - here) / np.linalg.norm(centres[0] - here)
    beyond = here + 0.01 * (here - centres[1]) / np.linalg.norm(here - centres[1])
    found, _ = detected(rig, np.array([here, before]), np.random.default_rng(3))
    for k, camera in enumerate(rig.cameras):
        places = project(camera, np.array([beyond if k == 0 else here, before]))
        placed = replace(found[camera.name], xy_px=places + ((0, 0), (0, 0.1 if k == 0 else 0)))
        found[camera.name] = chosen(placed, [1]) if k == 4 else placed
    points = grouped(rig, found, predicted=expected_at(np.array([here]), 0.01))
    assert sorted(points.rays.tolist()) == [[-1, 0, 0, 0, -1], [1, 1, 1, 1, 0]]


def test_points_outside_the_volume_are_none():
    rig, rng = rig_of(4), np.random.default_rng(4)
    truth3d = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    found, _ = detected(rig, truth3d, rng)
    bundle = make_ray_table(rig, found, 0.0)
    box = (np.full(3, -0.2), np.full(3, 0.2))
    assert len(match(bundle, Predicted.nothing(), MatchSettings(), box)) == 1


def test_no_detections_no_points():
    rig = rig_of(4)
    assert len(grouped(rig, {})) == 0
    assert grouped(rig, {}).rays.shape == (0, 4)


def test_swapped_calibrations_find_next_to_nothing():
    rng = np.random.default_rng(6)
    rig, truth3d = rig_of(4), rng.uniform(-0.5, 0.5, (50, 3))
    found, _ = detected(rig, truth3d, rng)
    swapped = dict(found, c0=found["c1"], c1=found["c0"])
    assert (grouped(rig, swapped).n_cameras == 4).sum() == 0


def test_one_bad_ray_of_three_is_left_out_or_the_point_left_open():
    rig, rng = rig_of(3), np.random.default_rng(7)
    truth3d = rng.uniform(-0.5, 0.5, (40, 3))
    found, behind = detected(rig, truth3d, rng, sigma=0.02)
    bad = found["c1"]
    found["c1"] = replace(bad, xy_px=bad.xy_px + rng.choice([-3.0, 3.0], (len(bad), 2)))
    points = grouped(rig, found, MatchSettings(camera_sigma_px=0.0, judge_sizes=False))
    groups = members(rig, points, behind)
    for xyz, group in zip(points.xyz, groups, strict=True):
        if len(group) == 1:
            assert np.linalg.norm(xyz - truth3d[group.pop()]) < 1e-3
    # a ray 4 px off sometimes still lies on one epipolar line: such a point is open, not wrong
    assert sum(len(g) == 1 for g in members(rig, points, behind)) >= 25


@pytest.mark.parametrize("count", [2, 3, 4])
def test_covariance_is_honest_with_few_cameras_and_a_bad_ray_dropped(count):
    rig, nees = rig_of(count), []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        # far from each other, so that two cameras can distinguish them
        truth3d = np.column_stack([rng.uniform(-0.3, 0.3, (8, 2)), np.linspace(-0.5, 0.5, 8)])
        found, behind = detected(rig, truth3d, rng)
        if count == 4:
            bad = found["c3"]
            found["c3"] = replace(bad, xy_px=bad.xy_px + 1.5)
        points = grouped(rig, found)
        for k, group in enumerate(members(rig, points, behind)):
            if len(group) == 1:
                e = points.xyz[k] - truth3d[group.pop()]
                nees.append(e @ np.linalg.solve(points.covariance[k], e))
    n = len(nees)
    assert n > 120
    assert chi2.ppf(0.001, 3 * n) < sum(nees) < chi2.ppf(0.999, 3 * n)


def test_order_of_detections_does_not_matter():
    rng = np.random.default_rng(8)
    rig, truth3d = rig_of(4), rng.uniform(-0.5, 0.5, (50, 3))
    found, _ = detected(rig, truth3d, rng, clutter=5, miss=0.1)
    turned = {}
    for name, d in found.items():
        turned[name] = chosen(d, rng.permutation(len(d)))
    one, other = grouped(rig, found), grouped(rig, turned)
    np.testing.assert_allclose(one.xyz[np.lexsort(one.xyz.T)], other.xyz[np.lexsort(other.xyz.T)], atol=1e-12)


def flagged(found, flag, shift_px=0.0):
    """The same with a flag on the first detection of the first camera, which lies ``shift_px`` off on both axes."""
    flags, xy = np.zeros(len(found["c0"]), np.uint8), found["c0"].xy_px.copy()
    flags[0] = flag
    xy[0] += shift_px
    return found | {"c0": replace(found["c0"], flags=flags, xy_px=xy)}


def test_a_partly_hidden_image_counts_for_less():
    truth3d = np.array([[0.1, 0.0, 0.2]])
    for cameras, shift_px in ((2, 0.0), (3, 0.3)):
        rig, rng = rig_of(cameras), np.random.default_rng(9)
        found, _ = detected(rig, truth3d, rng, sigma=0.02)
        whole = grouped(rig, found)
        partly = grouped(rig, flagged(found, PARTIAL, shift_px))
        assert whole.n_cameras.tolist() == partly.n_cameras.tolist() == [cameras]
        assert partly.trusted[0] < whole.trusted[0]
        assert np.trace(partly.covariance[0]) > np.trace(whole.covariance[0])
    # control: two others show that it is where a whole one would be
    assert grouped(rig, flagged(found, PARTIAL)).trusted == pytest.approx([3.0])


def test_an_image_alone_that_no_disc_fits_is_half_hidden_where_discs_fit_others():
    rig, rng = rig_of(3), np.random.default_rng(9)
    found, _ = detected(rig, rng.uniform(-0.4, 0.4, (12, 3)), rng, sigma=0.02)
    whole, odd = grouped(rig, found), grouped(rig, flagged(found, UNREFINED, 0.7))
    at = np.flatnonzero(odd.rays[:, 0] == 0)
    same = np.flatnonzero(whole.rays[:, 0] == 0)
    assert whole.trusted[same[0]] == pytest.approx(3.0)
    assert odd.trusted[at[0]] == pytest.approx(2.0)
    assert np.trace(odd.covariance[at[0]]) > np.trace(whole.covariance[same[0]])
    # controls: beside a neighbour the fit fails for its sake; where no fit was tried, none means nothing
    crowded = grouped(rig, flagged(found, UNREFINED | MERGED))
    untried = grouped(rig, {n: replace(f, flags=np.full(len(f), UNREFINED, np.uint8)) for n, f in found.items()})
    assert crowded.trusted[crowded.rays[:, 0] == 0] == pytest.approx(3.0)
    assert untried.trusted == pytest.approx(np.full(12, 3.0))


def test_a_long_image_counts_for_less_where_the_others_are_round():
    rig, rng = rig_of(3), np.random.default_rng(9)
    found, _ = detected(rig, rng.uniform(-0.4, 0.4, (12, 3)), rng, sigma=0.02)
    longer = np.ones(12)
    longer[0] = 5.0 / 3.0
    odd = grouped(rig, {**found, "c0": replace(found["c0"], elongation=longer)})
    assert odd.trusted[odd.rays[:, 0] == 0] < 2.7
    assert odd.trusted[odd.rays[:, 0] != 0] == pytest.approx(np.full(11, 3.0))
    # control: flat or fast targets, all of them long, are whole
    flat = grouped(rig, {n: replace(f, elongation=np.full(12, 5.0 / 3.0)) for n, f in found.items()})
    assert flat.trusted == pytest.approx(np.full(12, 3.0))


def test_an_image_of_odd_size_is_trusted_less_where_its_size_is_certain():
    rig, rng = rig_of(4), np.random.default_rng(5)
    found, _ = detected(rig, rng.uniform(-0.04, 0.04, (6, 3)), rng, sigma=0.2)
    assert grouped(rig, found).trusted == pytest.approx(np.full(6, 4.0))
    # a fifth of an image's area is missing: of small images that is no more than the noise of their sizes
    smaller = replace(found["c0"], diameter_px=found["c0"].diameter_px * np.sqrt(0.8))
    certain = grouped(rig, {**found, "c0": smaller})
    assert certain.n_cameras.tolist() == [4] * 6
    assert (certain.trusted < 3.9).all()
    unsure = replace(smaller, diameter_sigma_px=0.045 * smaller.diameter_px)  # 9 % of its area
    assert grouped(rig, {**found, "c0": unsure}).trusted == pytest.approx(np.full(6, 4.0))


@pytest.mark.parametrize("added", [1.0, 40.0])
@pytest.mark.parametrize("hidden", [0.003, 0.2])
def test_an_image_counts_as_hidden_where_that_costs_less(hidden, added):
    """The loss over 400,000 images of both kinds is least at the limit; the rules' loss is that of both errors."""
    sigma, rng = 0.03, np.random.default_rng(7)
    cut = rng.random(400_000) < hidden
    missing = np.where(cut, rng.random(len(cut)), np.abs(rng.normal(0.0, sigma, len(cut))))
    limits = np.linspace(0.0, 6.0, 121) * sigma
    # half of the whole images miss less than nothing
    loss = [np.sum(added * cut * (missing < at)) + 0.5 * np.sum(~cut & (missing >= at)) for at in limits]
    least = limits[int(np.argmin(loss))]
    judged = np.flatnonzero(rather_hidden(limits, sigma, added, hidden))
    assert limits[judged[0]] == pytest.approx(least, abs=0.35 * sigma)
    assert np.diff(judged).max() == 1


def test_a_merged_image_serves_two_targets_that_tracks_expect():
    rig, rng = rig_of(3), np.random.default_rng(10)
    a = np.array([0.1, 0.0, 0.2])
    # a second target behind the first as seen from c0
    c0 = rig.cameras[0].world_from_camera.translation
    b = a + 0.3 * (a - c0) / np.linalg.norm(a - c0)
    truth3d = np.array([a, b])
    found, _ = detected(rig, truth3d, rng, sigma=0.02)
    found["c0"] = chosen(found["c0"], [0])
    expected = expected_at(truth3d, 1e-5**0.5)
    settings = MatchSettings(camera_sigma_px=0.0, judge_sizes=False)
    plain = grouped(rig, found, settings, expected)
    merged = grouped(rig, flagged(found, MERGED), settings, expected)
    assert sorted(plain.n_cameras) == [2, 3]
    assert sorted(merged.n_cameras) == [3, 3]


@pytest.mark.parametrize(
    ("flags", "area", "served"),
    [(UNREFINED | MERGED, 1.1, 1), (UNREFINED | MERGED, 1.6, 2), (PARTIAL | MERGED, 1.1, 2), (0, 1.1, 1)],
)
def test_where_the_size_is_known_an_image_that_no_disc_fits_serves_two_targets_only_if_it_is_too_large(
    flags, area, served
):
    rig, rng = rig_of(3), np.random.default_rng(10)
    a = np.array([0.1, 0.0, 0.2])
    c0 = rig.cameras[0].world_from_camera.translation
    truth3d = np.array([a, a + 0.1 * (a - c0) / np.linalg.norm(a - c0)])
    found, _ = detected(rig, truth3d, rng, sigma=0.02)
    found["c0"] = chosen(found["c0"], [0])
    found["c0"] = replace(found["c0"], diameter_px=found["c0"].diameter_px * np.sqrt(area))
    settings, expected = MatchSettings(camera_sigma_px=0.0), expected_at(truth3d, 1e-5**0.5)
    table = make_ray_table(rig, flagged(found, flags), settings.camera_sigma_px)
    points = match(table, expected, settings, EVERYWHERE, typical_diameter_m=0.014)
    assert sorted(points.n_cameras) == [1 + served, 3]


def test_clutter_of_many_cameras_makes_no_ghosts():
    rng = np.random.default_rng(11)
    rig, truth3d = rig_of(16), rng.uniform(-0.5, 0.5, (60, 3))
    found, _ = detected(rig, truth3d, rng, clutter=10, miss=0.3)
    bundle = make_ray_table(rig, found, 0.0)
    # a point behind some of the cameras could be a target that few see: only the volume excludes it
    room = (np.full(3, -1.0), np.full(3, 1.0))
    points = match(bundle, Predicted.nothing(), MatchSettings(camera_sigma_px=0.0), room)
    assert len(points) == 60
    nearest = np.linalg.norm(points.xyz[:, None] - truth3d[None], axis=2).min(axis=1)
    assert nearest.max() < 1e-3


@pytest.mark.parametrize("count", [3, 4, 8])
@pytest.mark.parametrize("sigma_m", [1e-3, 0.03])
def test_tracks_save_the_search_and_wrong_ones_mislead_nobody(count, sigma_m):
    settings, rig, sets = MatchSettings(camera_sigma_px=0.0, minimum_cameras=3), rig_of(count), 6
    points, changed, wrong = np.zeros(4, int), np.zeros(4, int), np.zeros(4, int)
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        truth3d = rng.uniform(-0.5, 0.5, (80, 3))
        found, behind = detected(rig, truth3d, rng, clutter=8, miss=0.1)
        bundle = make_ray_table(rig, found, 0.0)
        right = expected_at(truth3d + rng.normal(0, sigma_m, truth3d.shape), sigma_m)
        beside = expected_at(np.roll(truth3d, 1, axis=0) + 2 * sigma_m, sigma_m)
        anywhere = expected_at(rng.uniform(-0.5, 0.5, (80, 3)), sigma_m)
        alone: set[tuple[int, ...]] = set()
        for k, tracks in enumerate((Predicted.nothing(), right, beside, anywhere)):
            one = match(bundle, tracks, settings, EVERYWHERE, 0.014)
            rows = {tuple(row) for row in one.rays}
            alone = rows if k == 0 else alone
            points[k] += len(one)
            changed[k] += len(rows ^ alone)
            wrong[k] += sum(len(g) > 1 or -1 in g for g in members(rig, one, behind))
    # a stray ray sometimes replaces a missing one; tracks do not increase their number
    assert wrong[0] <= 0.01 * points[0]
    assert (wrong[1:] <= wrong[0] + 1).all()
    assert (abs(points[1:] - points[0]) <= 2).all()
    assert (changed[1:] <= 0.02 * points[0]).all()


@pytest.mark.parametrize(
    "wrong", [{"gate_sigma": 0.0}, {"minimum_cameras": 1}, {"camera_sigma_px": -0.1}, {"target": "disc"}]
)
def test_settings_outside_their_bounds_are_refused(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        MatchSettings(**wrong)
