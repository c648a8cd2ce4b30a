"""Curves from free-running cameras: errors as stated, clocks and limbs found, undetermined quantities reported.

Truth is sums of sines, not curves of the estimate's own kind.
"""

from dataclasses import replace

import numpy as np
import pytest
from continuous_scenes import PLAIN, limbs, nees, ring, rms, sines, staggered, take
from scipy.interpolate import BSpline

import mosca.continuous.estimator.estimate as whole
from mosca.continuous.estimator.constant_distances import Pairs
from mosca.continuous.estimator.estimate import estimate
from mosca.continuous.estimator.input_checks import check
from mosca.data.rig import Pose, Rig
from mosca.data.rotations import rotation_from_vector
from mosca.errors import InputError


def test_errors_are_small_and_as_large_as_stated():
    squares, within = [], np.linspace(0.1, 1.9, 150)
    for seed in range(3):
        path = sines(seed, 6)
        observations = take(path, ring(), staggered(), 0.1, seed)
        estimated = estimate(observations, ring(), PLAIN)
        # 0.1 px at 2.5 m is 0.42 mm across and no camera sees depth alone
        assert rms(estimated, path, within) < 0.0007
        assert estimated.sigma0 == pytest.approx(1.0, abs=0.12)
        squares.append(nees(estimated, path, within))
    joined = np.concatenate(squares)
    assert 2.1 < joined.mean() < 3.6
    assert 0.92 < (joined < 7.815).mean() < 0.99


def test_synchronous_cameras_lose_nothing_against_points_of_single_instants():
    from scipy.optimize import least_squares

    from mosca.camera.projection import project

    path, rig = sines(7, 4), ring()
    stamps = [np.arange(0, 1.5, 0.02)] * 3
    observations = take(path, rig, stamps, 0.1, 7)
    within = stamps[0][5:-5]
    single = []
    for k in range(5, len(stamps[0]) - 5, 6):
        for p in range(4):
            own = (observations.exposure == k) & (observations.point == p)
            xy = observations.xy_px[own]

            def residuals(x, xy=xy):
                return np.concatenate([project(c, x[None])[0] - z for c, z in zip(rig.cameras, xy, strict=True)])

            truth = path(stamps[0][k : k + 1])[0, p]
            single.append(np.linalg.norm(least_squares(residuals, truth).x - truth))
    of_instants = np.sqrt(np.mean(np.square(single)))
    assert rms(estimate(observations, rig, PLAIN), path, within) < 1.02 * of_instants


def test_offsets_and_drifts_are_found():
    path, within = sines(1, 8), np.linspace(0.1, 2.9, 150)
    clocks = np.array([[0.0, 0.0], [0.006, 2e-4], [-0.003, -3e-4]])
    observations = take(path, ring(), staggered(3.0), 0.1, 1, clocks)
    estimated = estimate(observations, ring(), replace(PLAIN, clocks="drift"))
    for clock, (offset, drift) in zip(estimated.clocks, clocks, strict=True):
        assert abs(clock.offset_s - offset) < max(4 * clock.offset_sigma_s, 1e-12)
        assert abs(clock.drift - drift) < max(4 * clock.drift_sigma, 1e-12)
        # a twentieth of a frame
        assert abs(clock.offset_s - offset) < 0.05 / 50
    assert rms(estimated, path, within) < 0.0007
    # the control: the same with clocks taken for right
    held = estimate(observations, ring(), PLAIN)
    assert rms(held, path, within) > 3 * rms(estimated, path, within)
    assert held.sigma0 > 1.5
    assert any("image errors" in line for line in held.findings)


def test_a_rolling_shutter_is_found():
    path = sines(2, 8)
    observations = take(path, ring(), staggered(2.0), 0.1, 2, row_s=2e-5)
    estimated = estimate(observations, ring(), replace(PLAIN, clocks="rolling"))
    for clock in estimated.clocks:
        assert abs(clock.row_time_s - 2e-5) < 4 * clock.row_time_sigma_s
        assert clock.row_time_sigma_s < 4e-6


def test_clocks_that_still_points_cannot_tell_are_held_and_said():
    places = np.random.default_rng(3).uniform(-0.4, 0.4, (4, 3))

    def still(t):
        return np.tile(places, (len(t), 1, 1))

    observations = take(still, ring(), staggered(1.0), 0.1, 3)
    estimated = estimate(observations, ring(), replace(PLAIN, clocks="offset"))
    assert [clock.held for clock in estimated.clocks] == [(), ("offset",), ("offset",)]
    assert all(clock.offset_s == 0 for clock in estimated.clocks)
    assert any("'c1'" in line and "offset" in line for line in estimated.findings)


def test_distances_within_limbs_are_found_and_no_others():
    path = limbs(3)
    observations = take(path, ring(), staggered(2.0, rate=13.3), 0.2, 3)
    estimated = estimate(observations, ring())
    body = {f"m{k}": k // 3 for k in range(6)} | {"m6": 9}
    found = {(d.one, d.other) for d in estimated.distances}
    assert all(body[a] == body[b] for a, b in found)
    assert len(found) >= 4
    within = np.linspace(0.15, 1.8, 120)
    places = path(within)
    for d in estimated.distances:
        true = np.linalg.norm(places[0, int(d.one[1:])] - places[0, int(d.other[1:])])
        assert d.distance_m == pytest.approx(true, abs=0.003)
    assert rms(estimated, path, within) < rms(estimate(observations, ring(), PLAIN), path, within)


def test_false_constant_distances_loosen_themselves_and_leave(monkeypatch):
    path, within = limbs(3), np.linspace(0.15, 1.8, 120)
    observations = take(path, ring(), staggered(2.0, rate=13.3), 0.2, 3)
    alone = rms(estimate(observations, ring(), PLAIN), path, within)
    places = path(within)
    # points of different bodies, shuffled pairs, taken for as rigid as can be
    pair = np.array([[0, 3], [1, 5], [2, 6], [4, 6]])
    mean = np.linalg.norm(places[:, pair[:, 0]] - places[:, pair[:, 1]], axis=2).mean(axis=0)
    false = Pairs(pair, mean, np.full(4, 1e-4))
    # proposed again in every round: what was dropped must not come back
    monkeypatch.setattr(whole, "find_pairs", lambda *_: false)
    caught = estimate(observations, ring())
    assert caught.distances == ()
    assert rms(caught, path, within) < 1.1 * alone
    # the control: with the rigidity as stated, they increase the errors
    monkeypatch.setattr(whole, "learned", lambda pairs, *_: (pairs, np.ones(len(pairs), dtype=bool)))
    assert rms(estimate(observations, ring()), path, within) > 2 * alone


def test_gross_image_errors_do_no_harm():
    path, within = sines(5, 4), np.linspace(0.1, 1.4, 80)
    observations = take(path, ring(), staggered(1.5), 0.1, 5)
    xy = np.array(observations.xy_px)
    wrong = np.random.default_rng(5).choice(len(xy), len(xy) // 50, replace=False)
    xy[wrong] += 40.0
    clean = rms(estimate(observations, ring(), PLAIN), path, within)
    assert rms(estimate(replace(observations, xy_px=xy), ring(), PLAIN), path, within) < 1.5 * clean


def aligned(a, b):
    """a (n, 3) brought onto b by the best similarity (Umeyama 1991)."""
    x, y = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(y.T @ x)
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    return (s * sign).sum() / (x**2).sum() * x @ ((u * sign) @ vt).T + b.mean(axis=0)


def added_by_cameras(curves, time_s):
    """RMS that unknowns without time (the cameras' poses) add to the curves' errors, similarities left out [m]."""
    rng, best = np.random.default_rng(0), curves.at(time_s).reshape(-1, 3)
    by = BSpline(
        curves.knots.start_s + curves.knots.step_s * np.arange(-3, curves.knots.count + 1), curves.carried, 3
    )(time_s).reshape(len(best), 3, -1)
    drawn = rng.multivariate_normal(np.zeros(len(curves.shared)), curves.shared, 40)
    return np.sqrt(np.mean([((aligned(best - by @ s, best) - best) ** 2).sum(axis=1).mean() for s in drawn]))


def test_unknown_cameras_that_stand_still_cost_little():
    path, within, rng = sines(6, 10), np.linspace(0.1, 1.9, 120), np.random.default_rng(6)
    observations = take(path, ring(), staggered(2.0, rate=30.0), 0.1, 6)

    def off(camera):
        pose = camera.world_from_camera
        turn = rotation_from_vector(rng.normal(0, 0.02, 3))
        moved = Pose(pose.rotation @ turn, pose.translation + rng.normal(0, 0.05, 3))
        return replace(camera, world_from_camera=moved)

    rough = Rig((ring().cameras[0], *(off(camera) for camera in ring().cameras[1:])))
    estimated = estimate(observations, rough, replace(PLAIN, cameras="fixed"))
    truth = path(within).reshape(-1, 3)
    error = np.linalg.norm(aligned(estimated.curves.at(within).reshape(-1, 3), truth) - truth, axis=1)
    known = rms(estimate(observations, ring(), PLAIN), path, within)
    unknown = np.sqrt((error**2).mean())
    # the bound: the cameras' part by the stated covariance, after the same similarity; a thousandth here
    bound = np.hypot(known, added_by_cameras(estimated.curves, within)) / known
    assert bound < 1.01
    assert unknown < 1.02 * bound * known
    assert any(line.startswith("scale") for line in estimated.findings)
    # the control: rough poses taken for right
    taken = estimate(observations, rough, PLAIN).curves.at(within).reshape(-1, 3)
    assert np.sqrt(((aligned(taken, truth) - truth) ** 2).sum(axis=1).mean()) > 3 * known


def test_points_are_known_only_while_they_are_seen():
    observations = take(sines(8, 2), ring(), staggered(1.5), 0.1, 8)
    late = (observations.point == 1) & (observations.time_s < 0.7)
    curves = estimate(observations.only(~late), ring(), PLAIN).curves
    assert np.isnan(curves.at([0.5])[0, 1]).all()
    assert np.isfinite(curves.at([0.5])[0, 0]).all()
    assert np.isnan(curves.covariance_at([0.5])[0, 1]).all()


def _with_covariance(observations, covariance):
    """The same with the covariance (2, 2) of one image point changed."""
    changed = observations.covariance_px2.copy()
    changed[4] = covariance
    return replace(observations, covariance_px2=changed)


@pytest.mark.parametrize("cameras", ["known", "fixed"])
def test_cameras_at_one_place_determine_nothing_and_that_is_told(cameras):
    there = ring()
    same = Rig(tuple(replace(one, world_from_camera=there.cameras[0].world_from_camera) for one in there.cameras))
    with pytest.raises(InputError, match=r"c0, c1, c2 are all at .* they see no depth"):
        estimate(take(sines(1, 6), same, staggered(), 0.05), same, replace(PLAIN, cameras=cameras))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda o: replace(o, time_s=np.where((o.camera == 1) & (o.exposure == 3), 0.044, o.time_s)), "same"),
        (lambda o: replace(o, time_s=np.where((o.camera == 1) & (o.exposure == 3), 0.005, o.time_s)), "earlier"),
        (lambda o: replace(o, time_s=o.time_s + np.where(o.camera == 2, 9.0, 0.0)), "shares no time"),
        (lambda o: o.only(o.exposure < 3), "record longer"),
        (lambda o: o.only(o.camera == 0), "no image points"),
        (lambda o: o.only(np.zeros(len(o), dtype=bool)), "no image points"),
        (lambda o: _with_covariance(o, np.zeros((2, 2))), r"camera 'c0', exposure 4, point 'm0': covariance"),
        (lambda o: _with_covariance(o, np.ones((2, 2))), "positive definite"),
        (lambda o: _with_covariance(o, np.array([[1.0, 2.0], [2.0, 1.0]])), "positive definite"),
        (lambda o: _with_covariance(o, 1e-20 * np.eye(2)), "positive definite"),
        (lambda o: replace(o, xy_px=np.where(np.arange(len(o))[:, None] == 7, np.nan, o.xy_px)), "leave out")
    ]
)  # fmt: skip
def test_recordings_that_cannot_be_used_are_refused_in_one_line(change, text):
    observations = take(sines(9, 1), ring(), staggered(0.5), 0.1, 9)
    check(observations, ring())
    with pytest.raises(InputError, match=text) as told:
        estimate(change(observations), ring())
    assert "\n" not in str(told.value)
