"""The labs that Mitsuba plays: what they measure by chance, their sensors, and (at night) how shake moves images."""

from dataclasses import replace

import numpy as np
import pytest

from tests.studies.lab_mitsuba import LIGHT, by_shake_and_jitter, truth_of, wand, waved, without_chance
from tests.studies.mitsuba_lab import (
    LENGTH_M,
    SIZE,
    WAND,
    WAND_HZ,
    KeptLight,
    Takes,
    by_chance,
    exposed,
    filmed,
    hidden_cameras,
    targets,
    wand_seed,
)
from witness.mitsuba.projection import project
from witness.mitsuba.scene import FIRST_MID_S


def nearest_point(cameras, pixels):
    """Return the point whose images are nearest to ``pixels``, by Gauss-Newton steps with numerical slopes."""
    point = np.zeros(3)
    for _ in range(8):
        rest = np.concatenate([p - project(c, point) for c, p in zip(cameras, pixels, strict=True)])
        slope = np.column_stack(
            [np.concatenate([project(c, point + 1e-6 * e) - project(c, point) for c in cameras]) for e in np.eye(3)]
        )
        point = point + np.linalg.lstsq(slope / 1e-6, rest, rcond=None)[0]
    return point


def centroids(light):
    """Return the centroid of each window's light (n, 2) [px]."""
    found = []
    for k, (_, _, x, y, w, h) in enumerate(light.place):
        window = light.light[light.start[k] : light.start[k + 1]].reshape(h, w)
        found.append([window.sum(0) @ (x + np.arange(w)), window.sum(1) @ (y + np.arange(h))] / window.sum())
    return np.array(found)


@pytest.mark.parametrize("seed", [201, 207])
def test_each_camera_films_the_wand_with_its_own_brightness(seed):
    """All windows have one light: each camera's brightest pixels have its signal, as its targets at rest have."""
    cameras, edge = hidden_cameras(seed), 20
    place = np.array([(0, c, 100, 100, edge, edge) for c in range(len(cameras))])
    light = KeptLight(
        place, edge**2 * np.arange(len(cameras) + 1), np.full(len(cameras) * edge**2, 0.02), np.zeros(1)
    )
    for one, images in zip(cameras, waved(cameras, Takes(light, light, light), seed, 0), strict=True):
        (counts,) = images
        black = one.sensor.black_dn * 2.0 ** (one.sensor.bits - 8)
        seen_e = (counts[100 : 100 + edge, 100 : 100 + edge].mean() - black) / one.gain - one.sensor.stray_e
        assert seen_e == pytest.approx(one.signal * one.capacity_e, rel=0.02)


def test_what_shake_and_jitter_make_of_a_length():
    """Against points from displaced images, without any derivative; the excess has the mean 0."""
    seed = 205
    cameras, motion = hidden_cameras(seed), wand(seed)[0].motion
    excess, expected = by_shake_and_jitter(cameras, seed)
    drawn = [by_chance(one, c, WAND, wand_seed(seed)) for c, one in enumerate(cameras)]
    lenses = [one.lens for one in cameras]
    for frame in (0, 40, 80, 120):
        ends = []
        for x in (-0.5, 0.5):
            images = []
            for one, (shift, late) in zip(cameras, drawn, strict=True):
                rotation, position = motion.pose(FIRST_MID_S + frame / WAND_HZ + late[frame] + one.delay_s)
                images.append(project(one.lens, position + rotation @ [x * LENGTH_M, 0.0, 0.0]) + shift[frame])
            ends.append(nearest_point(lenses, images))
        error = np.linalg.norm(ends[1] - ends[0]) - LENGTH_M
        assert excess[frame] + expected[frame] == pytest.approx(error**2, abs=0.1 * expected[frame])
    assert abs(excess.mean()) < 4.0 * excess.std() / np.sqrt(WAND)


@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0])
def test_what_chance_does_not_explain(gain):
    """Points show ``gain`` times the drawn shake: means of 400 takes and their scatter are those that are stated."""
    rng, takes = np.random.default_rng(8), []
    for _ in range(400):
        sigma = rng.uniform(0.5, 2.0, WAND)
        drawn = sigma * rng.standard_normal(WAND)
        square = (gain * drawn + rng.standard_normal(WAND)) ** 2
        takes.append(
            (*without_chance(square, drawn**2 - sigma**2, sigma**2), square.mean(), gain**2 * sigma @ sigma / WAND)
        )
    found, stated, plain, of_shake = np.array(takes).T
    off = found - 1.0 - of_shake
    assert abs(off.mean()) < 3.0 * off.std() / 20.0 + 0.01
    assert np.sqrt(np.mean(stated**2)) == pytest.approx(off.std(), rel=0.15)
    assert off.std() <= 1.02 * (plain - 1.0 - of_shake).std()


@pytest.mark.parametrize("seed", [205, 206])
def test_a_sensor_is_what_its_truth_says(seed):
    """Means, variances and patterns of even images, by the photon transfer law."""
    for c, one in enumerate(hidden_cameras(seed)):
        name = one.lens.name
        told = {key: truth_of((one,), name, key) for key in ("errors.full_well_e", "sensor.prnu", "sensor.black_dn")}
        scale, top = 2.0 ** (one.sensor.bits - 8), 2**one.sensor.bits - 1
        level = LIGHT[1] * told["errors.full_well_e"]
        image = np.full(SIZE[::-1], level - one.sensor.stray_e)
        counts = np.array(list(exposed(one, (seed, c), iter([image] * 4), 9)), float)
        black = scale * told["sensor.black_dn"]
        assert counts.mean() == pytest.approx(black + LIGHT[1] * (top - black), rel=1e-3)
        fixed = counts.mean(axis=0).var() - counts.var(axis=0, ddof=1).mean() / 4
        pattern = np.sqrt(fixed - (scale * one.sensor.dsnu_dn) ** 2) / (counts.mean() - black)
        assert pattern == pytest.approx(told["sensor.prnu"], rel=0.03)
        # none: the witness's targets are not evenly bright
        assert truth_of((one,), name, "errors.marker_signal") is None


@pytest.mark.slow
def test_shake_and_delay_move_the_images(tmp_path):
    """Centroids of noise-free light at rest follow the drawn shifts; those of a moving target its way while late."""
    from tests.oracle.needs_mitsuba import needs_mitsuba

    needs_mitsuba()
    camera, frames = hidden_cameras(205)[:1], 6
    bodies = targets(205, 0.0)
    light = filmed(camera, bodies, frames, 100.0, 7, tmp_path)
    shift, _ = by_chance(camera[0], 0, frames, 7)
    # each target by itself: in the whole image's centroid, its brightness counts with its distance from the others
    places = centroids(light)
    found = np.array([places[light.place[:, 0] == frame].mean(0) for frame in range(frames)])
    off = (found - found.mean(0)) - (shift - shift.mean(0))
    assert np.abs(off).max() < 0.05 * np.abs(shift).max() + 0.002
    # a delay of 20 ms is some pixels of the wand's way
    late, moving = (replace(camera[0], delay_s=0.02),), wand(205)
    light = filmed(late, moving, 1, 100.0, 7, tmp_path)
    shift, jitter = by_chance(late[0], 0, 1, 7)
    rotation, position = moving[0].motion.pose(FIRST_MID_S + 0.02 + jitter[0])
    wanted = [project(late[0].lens, position + rotation @ part.at_m) + shift[0] for part in moving[0].parts]
    assert len(light.place) == 2
    for seen in centroids(light):
        assert min(np.abs(seen - one).max() for one in wanted) < 0.1
