"""Targets of one size are judged by it, particles are not: learned from the points."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from track_points import points

from mosca.camera.ray_table import FIRST_AREA_NOISE
from mosca.correspondence.typical_size import TypicalSize
from mosca.data.detections import SATURATED
from mosca.data.rays import ANGLE, COLUMNS, FLAGS, VIEW

NO_RAYS = SimpleNamespace(rays=np.zeros((1, COLUMNS)), start=np.zeros(5, int), views=np.zeros((4, VIEW)))
"""A table without clean images."""
NO_RAYS.rays[:, FLAGS] = SATURATED


def compared(sizes, flags=0.0):
    """What is learned from images of targets 1 m from four cameras, by their ``sizes`` (n, 4) [m], 20 in a set."""
    learned = TypicalSize()
    for some in np.split(sizes, np.arange(20, len(sizes), 20)):
        n, cameras = some.shape
        rays = np.zeros((some.size, COLUMNS))
        rays[:, ANGLE], rays[:, FLAGS] = some.T.ravel(), flags
        table = SimpleNamespace(rays=rays, start=n * np.arange(cameras + 1), views=np.zeros((cameras, VIEW)))
        made = replace(
            points(np.tile([1.0, 0.0, 0.0], (n, 1))),
            rays=np.tile(np.arange(n)[:, None], cameras),
            diameter_m=some.max(axis=1),
        )
        learned.learn(made, table)
    return learned


def learned(diameter_m, sets=1):
    sizes = TypicalSize()
    for _ in range(sets):
        sizes.learn(replace(points(np.zeros((len(diameter_m), 3))), diameter_m=diameter_m), NO_RAYS)
    return sizes


@pytest.mark.parametrize(
    ("scatter", "alike"),
    # a half-hidden target lacks 0.7 of its area, at four standard deviations: 0.175 of it, 0.088 of the diameter
    [(0.0, True), (0.03, True), (0.08, True), (0.095, False), (0.3, False)],
)
def test_scatter_of_sizes_decides(scatter, alike):
    rng = np.random.default_rng(1)
    sizes = learned(0.01 * np.exp(scatter * rng.normal(size=2000)))
    assert sizes.alike == alike
    assert sizes.scatter == pytest.approx(2 * scatter, rel=0.1)
    assert sizes.diameter_m == pytest.approx(0.01, rel=0.02)


def test_a_few_hidden_and_merged_targets_do_not_stop_judging():
    rng = np.random.default_rng(2)
    whole = 0.01 * (1 + 0.02 * rng.normal(size=40))
    assert learned(np.concatenate([whole[:30], 0.7 * whole[30:35], 1.4 * whole[35:]])).alike
    # on a drone, most markers are hidden in part by its arms
    assert learned(np.concatenate([whole[:25], rng.uniform(0.5, 1.0, 15) * whole[25:]])).alike
    assert not learned(np.concatenate([whole[:20], 0.5 * whole[20:]])).alike


def test_nothing_is_known_of_two_points():
    assert not learned(np.array([0.01, 0.02])).known
    assert learned(np.array([0.01, 0.02])).alike
    assert learned(np.zeros(5)).alike


def test_the_noise_of_sizes_is_that_of_the_larger_images():
    """Lens and focus make an image smaller or larger by 2 %, its area by 4 %; every fourth image is half hidden."""
    rng = np.random.default_rng(3)
    sizes = 0.01 * np.exp(0.02 * rng.normal(size=(400, 4)))
    assert compared(sizes).area_noise == pytest.approx(0.04, rel=0.15)
    hidden = np.where(rng.random(sizes.shape) < 0.25, 0.7, 1.0)
    assert compared(sizes * hidden).area_noise == pytest.approx(0.04, rel=0.5)
    assert compared(np.full((5, 4), 0.01)).area_noise == 0.0
    # of two balls, and of saturated images, whose sizes are no measure
    assert compared(sizes[:2]).area_noise > 0.0
    assert compared(1.2 * sizes, SATURATED).area_noise == FIRST_AREA_NOISE


def test_the_typical_size_is_not_that_of_the_luckiest_image():
    rng = np.random.default_rng(4)
    sizes = 0.01 * np.exp(0.02 * rng.normal(size=(400, 4)))
    assert sizes.max(axis=1).mean() > 0.0102
    assert compared(sizes).diameter_m == pytest.approx(0.01, rel=0.003)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3])
def test_the_share_of_hidden_images_is_learned(share):
    """They miss any part of their area; those that miss as little as noise does are not counted."""
    rng = np.random.default_rng(5)
    sizes = 0.01 * np.exp(0.005 * rng.normal(size=(400, 4)))
    left = np.where(rng.random(sizes.shape) < share, rng.uniform(0.05, 1.0, sizes.shape), 1.0)
    found = compared(sizes * np.sqrt(left)).hidden
    assert found == pytest.approx(share, abs=0.002 + 0.2 * share)
