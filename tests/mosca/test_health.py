"""Health: errors, clock offsets and shares that were put in are found again, with honest intervals."""

import numpy as np
import pytest
from rigs import ring

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rig import MoscaLens
from mosca.data.tracks import Points
from mosca.diagnostics.camera_health import Health
from mosca.triangulation.triangulate import triangulate

NOISE_PX = 0.01
RATE_HZ = 100.0


RIG = ring(4, MoscaLens(6.0, 327.5, 245.0, 0.0099, 0.0099), radius_m=1.99, height_m=(0.2, -0.2, 0.2, -0.2))


def watched(
    shake_px, jitter_s=0.0, late_s=(0.0, 0.0, 0.0, 0.0), sets=300, markers=40, seed=1, strays=0, lost=(), handed=None,
    order=None,
):  # fmt: skip
    """Health after frame sets whose images shake (rms of each camera), with trigger errors; m/s speeds."""
    rng = np.random.default_rng(seed)
    health = Health(RIG)
    start, speed = rng.uniform(-0.3, 0.3, (markers, 3)), rng.normal(0, 1.0, (markers, 3))
    names = {c.name: c for c in RIG.cameras}
    for pulse in range(sets):
        t = pulse / RATE_HZ
        # back and forth, so that markers stay; the speed at any time is known
        where = lambda s: start + speed * 0.1 * np.sin(2 * np.pi * s / 0.6 + start[:, :1] * 9)  # noqa: E731
        found, image = {}, np.full((markers, 4, 2), np.nan)
        for k, (name, camera) in enumerate(names.items()):
            if pulse in lost and name == "c1":
                continue
            when = t + late_s[k] + rng.normal(0, jitter_s)
            xy = project(camera, where(when)) + rng.normal(0, NOISE_PX, (markers, 2))
            xy += rng.normal(0, 1, (markers, 2)) * shake_px[k]
            image[:, k] = xy
            stray = rng.uniform(0, 400, (strays if name == "c2" else 0, 2))
            n = len(xy) + len(stray)
            found[name] = Detections(
                name, np.concatenate([xy, stray]), np.tile(NOISE_PX**2 * np.eye(2), (n, 1, 1)),
                np.full(n, 6.0), np.full(n, 200.0), np.ones(n),
            )  # fmt: skip
        xyz, covariance, residual = triangulate(RIG, image, 0.05)
        seen = np.isfinite(image[:, :, 0])
        rays = np.where(seen, np.arange(markers)[:, None], -1)
        views = seen.sum(axis=1)
        points = Points(xyz, covariance, views, residual, rays, np.full(markers, 0.01), views)
        if order is not None:
            turn = order.permutation(markers)
            points = Points(*(getattr(points, name)[turn] for name in points.__dataclass_fields__))
        bundle = None if handed is None else make_ray_table(RIG, found, handed)
        health.attend(RIG, FrameSet(pulse, round(t * 1e9)), found, points, bundle)
    return health


def test_the_error_that_each_camera_adds_is_learned():
    # the cameras' shares differ by factors; images of a set shake on their own here, so that counts are large
    shake = np.array([0.03, 0.02, 0.06, 0.03])
    health = watched(shake, sets=600)
    np.testing.assert_allclose(health.noise.sigma_px, shake, rtol=0.12)
    assert health.noise.jitter_s < 20e-6
    assert health.findings() == ()


def test_ten_frame_sets_show_errors_far_below_the_one_to_start_from():
    """Images that err by 0.002 px besides their detection noise, where 0.06 px were assumed at first."""
    for seed in range(5):
        assert watched(np.full(4, 0.002), sets=10, seed=seed).noise.sigma_px.max() < 0.008, seed


def test_ten_frame_sets_tell_the_same_in_whatever_order_their_points_come():
    own = watched(np.full(4, 0.02), sets=10)
    other = watched(np.full(4, 0.02), sets=10, order=np.random.default_rng(0))
    np.testing.assert_allclose(other.noise.sigma_px, own.noise.sigma_px, rtol=1e-6)


def test_a_few_sets_of_two_balls_leave_no_camera_for_still():
    """Bodies of cameras shake by 0.06 px, each alike for both balls; points err more where they happen to be fast."""
    rig, still, rms = ring(3, RIG.cameras[0].lens, radius_m=1.99, height_m=(0.2, -0.2, 0.2)), 0, []
    ends, views = np.array([[-0.15, 0.0, 0.0], [0.15, 0.0, 0.0]]), np.full(2, 3)
    for seed in range(60):
        rng, health = np.random.default_rng(seed), Health(rig)
        phase, hz = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.3, 0.8, 3)
        for pulse in range(8):
            t = pulse / 25
            where = ends + 0.4 / (2 * np.pi * hz) * np.sin(2 * np.pi * hz * t + phase)
            image = np.stack([project(c, where) + rng.normal(0, 0.06, 2) for c in rig.cameras], axis=1)
            image += rng.normal(0, NOISE_PX, image.shape)
            covariance, many = np.tile(NOISE_PX**2 * np.eye(2), (2, 1, 1)), np.full(2, 200.0)
            found = {
                c.name: Detections(c.name, image[:, k], covariance, np.full(2, 6.0), many, np.ones(2))
                for k, c in enumerate(rig.cameras)
            }
            xyz, spread, residual = triangulate(rig, image, 0.05)
            rays = np.tile(np.arange(2)[:, None], 3)
            points = Points(xyz, spread, views, residual, rays, np.full(2, 0.01), views)
            health.attend(rig, FrameSet(pulse, round(t * 1e9)), found, points)
        still += health.noise.sigma_px.min() < 0.4 * 0.06
        rms.append(health.noise.sigma_px / 0.06)
    assert still == 0
    assert 0.9 < np.sqrt(np.mean(np.square(rms))) < 1.2


def test_a_camera_that_errs_more_than_all_others_is_named():
    lines = watched(np.array([0.03, 0.03, 0.3, 0.03])).findings()
    assert len([line for line in lines if "'c2': its images err by 0." in line]) == 1
    assert watched(np.array([0.03, 0.03, 0.06, 0.03])).findings() == ()


def test_the_jitter_of_triggers_is_told_from_the_shake_by_the_speed():
    health = watched(np.full(4, 0.02), jitter_s=100e-6, sets=600)
    assert health.noise.jitter_s == pytest.approx(100e-6, rel=0.2)
    np.testing.assert_allclose(health.noise.sigma_px, 0.02, rtol=0.35)


def test_a_late_camera_is_named_with_its_delay():
    health = watched(np.full(4, 0.02), late_s=(0.0, 0.0, 1e-3, 0.0))
    cameras = {c.name: c for c in health.cameras()}
    # against the mean of all, which is 0.25 ms late itself
    assert cameras["c2"].late_s == pytest.approx(0.75e-3, abs=4 * cameras["c2"].late_sigma_s + 5e-6)
    assert cameras["c0"].late_s == pytest.approx(-0.25e-3, abs=4 * cameras["c0"].late_sigma_s + 5e-6)
    assert any("'c2' exposes 0.75 ms later" in line for line in health.findings())
    assert watched(np.full(4, 0.02)).findings() == ()


def test_stated_precision_of_offsets_is_honest():
    late = np.array([[c.late_s / c.late_sigma_s for c in watched(np.full(4, 0.02), sets=100, seed=s).cameras()]
                     for s in range(12)])  # fmt: skip
    assert 0.5 < np.sqrt(np.mean(late**2)) < 1.5


def test_rays_that_are_handed_on_tell_the_same_however_they_are_whitened():
    own = watched(np.full(4, 0.02), jitter_s=50e-6, sets=60)
    for handed in (0.0, np.array([0.01, 0.05, 0.1, 0.02])):
        other = watched(np.full(4, 0.02), jitter_s=50e-6, sets=60, handed=handed)
        np.testing.assert_allclose(other.noise.sigma_px, own.noise.sigma_px, rtol=1e-6)
        assert other.noise.jitter_s == pytest.approx(own.noise.jitter_s, rel=1e-6)
        for a, b in zip(other.cameras(), own.cameras(), strict=True):
            assert a.late_s == pytest.approx(b.late_s, rel=1e-6)


def test_still_points_tell_nothing_of_clocks():
    health = Health(RIG)
    assert all(np.isnan(c.late_s) for c in health.cameras())
    assert health.findings() == ()


def test_missing_sets_and_strays_are_shares():
    health = watched(np.full(4, 0.02), sets=100, strays=160, lost=range(20, 50))
    cameras = {c.name: c for c in health.cameras()}
    assert cameras["c1"].missing == pytest.approx(0.3)
    assert cameras["c0"].missing == 0.0
    assert cameras["c2"].connected == pytest.approx(40 / 200)
    assert cameras["c0"].connected == pytest.approx(1.0)
    assert any("'c2': only 20 %" in line for line in health.findings())
