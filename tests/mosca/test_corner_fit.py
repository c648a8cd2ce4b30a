"""Corners of supersampled chessboards: no bias, as exact as their pixels allow, as uncertain as stated."""

from functools import cache

import cv2
import numpy as np
import pytest
from supersampled_boards import bound, corners, drawn, noisy, pose

from mosca.coded_targets.board_view import fitted_view
from mosca.coded_targets.corner_fit import LARGEST_REACH_PX, fitted_corners, places_of
from mosca.coded_targets.corner_image import BEND_1, BEND_2, PLACE
from mosca.data.boards import Board

SQUARES = (6, 5)
BOARD = Board(*SQUARES, 1.0, 1.0)
DRAWS = 25
CASES = [(6, 0.3, 0.0), (8, 0.05, 0.5), (10, 1.0, 0.3), (14, 0.6, 1.05), (20, 0.2, 0.8)]
"""Width of the squares [px], blur [px], slant [rad]."""


@cache
def scene(square_px, blur_px, slant, radial=0.0):
    """Return a homography, its noise-free image and the true corners."""
    side = int(7.5 * square_px) + 6
    homography = pose(square_px, slant, 0.7, 0.4, ((side - 1) / 2 + 0.3, (side - 1) / 2 - 0.2))
    image = drawn(homography, SQUARES, (side, side), blur_px, radial)
    return homography, image, *corners(homography, SQUARES, (side, side), radial)


def fit(image, start, full_dn=np.inf, bend=1.0):
    view = fitted_view(BOARD.corners()[:, :2], start, image.shape[::-1], bent=bend != 0.0)
    places = places_of(BOARD, view, np.arange(len(start)), start)
    places[:, [BEND_1, BEND_2]] *= bend
    return fitted_corners(image, places, (0.0, 1.0), full_dn, 1.0)


def by_gradients(image, start, square_px):
    """Return OpenCV's refinement of the corners."""
    half = max(2, round(0.35 * square_px))
    found = cv2.cornerSubPix(
        image.astype(np.float32), start[:, None].astype(np.float32), (half, half), (-1, -1), (3, 40, 1e-4)
    )
    return found[:, 0]


@pytest.mark.parametrize(("square_px", "blur_px", "slant"), CASES)
def test_corners_have_no_bias_and_no_larger_errors_than_the_bound_and_than_stated(square_px, blur_px, slant):
    homography, image, board, true = scene(square_px, blur_px, slant)
    places, _ = fit(image, true)
    assert np.sqrt(np.mean((places - true) ** 2)) < 0.002  # over 20 places in a pixel
    assert np.abs(places - true).max() < 0.004
    rng = np.random.default_rng(1)
    errors, stated, others = [], [], []
    for _ in range(DRAWS):
        taken = noisy(image, rng)
        start = true + rng.uniform(-0.3, 0.3, true.shape)
        places, covariance = fit(taken, start, 255.0, bend=0.0)
        errors.append(places - true)
        stated.append(covariance)
        others.append(by_gradients(taken, true, square_px * np.cos(slant)) - true)
    squared, variance = np.mean(np.square(errors)), np.mean(np.trace(stated, axis1=2, axis2=3)) / 2
    half = min(square_px, LARGEST_REACH_PX)
    least = np.mean([bound(homography, SQUARES, at, blur_px, half) for at in board[[0, 9, 18]]])
    print(
        f"rms {np.sqrt(squared):.4f} px, bound {np.sqrt(least):.4f}, stated {np.sqrt(variance):.4f}, cornerSubPix "
        f"{np.sqrt(np.mean(np.square(others))):.4f}"
    )
    assert np.sqrt(squared) < 1.1 * np.sqrt(least)
    assert squared == pytest.approx(variance, rel=0.15)
    # the control: what was done before
    assert np.mean(np.square(others)) > (2 * 1.1) ** 2 * least


def test_lines_that_the_lens_bends_do_not_draw_the_corners():
    """Sagittas of 0.1 px along half a square at the border."""
    *_, image, _, true = scene(20, 0.5, 0.4, radial=-4e-6)
    places, _ = fit(image, true)
    assert np.abs(places - true).max() < 0.004
    places, _ = fit(image, true, bend=-0.5)
    assert np.abs(places - true).max() > 0.01


def test_a_corner_under_dirt_says_so():
    """A grey spot pulls a corner, whose stated error grows with the misfit; a saturated reflection hides another."""
    _, image, _, true = scene(14, 0.6, 0.0)
    image = image.copy()
    x, y = np.rint(true[7]).astype(int)
    image[y + 1 : y + 5, x - 2 : x + 3] = 115.0
    x, y = np.rint(true[12]).astype(int)
    taken = noisy(image, np.random.default_rng(2))
    taken[y - 8 : y + 9, x - 8 : x + 9] = 255
    places, covariance = fit(taken, true, 255.0)
    assert np.isnan(fitted_corners(taken, np.zeros((4, PLACE)), (0.0, 1.0), 255.0, 1.0)[0]).all()  # none in the view
    off, sigma = np.abs(places - true).max(axis=1), np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    assert sigma[7] > 3 * np.median(sigma)
    assert np.isnan(places[12]).all()
    assert np.median(sigma) < 0.01
    assert np.delete(off / sigma, 12).max() < 5
