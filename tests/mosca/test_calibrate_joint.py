"""Cameras adjusted together to known points; pixels from OpenCV's projectPoints, the target's faults made by hand."""

import numpy as np
import pytest
from bundle_scenes import cv2_pixels, looking
from scipy.spatial.transform import Rotation

from mosca.calibration.single_camera.joint import (
    StandError,
    adjust_together,
    distinct_points,
    resected_camera,
    stand_centres,
)
from mosca.data.files.target_file import MeasuredPoints
from mosca.data.rig import Camera, OpenCVLens
from mosca.errors import InputError

SIZE = (1280, 1024)
FREE = ("fx_px", "fy_px", "cx_px", "cy_px", "k1")
LEVELS = (-0.1, 0.0, 0.1)
TURNS = (-2e-3, 0.0, 2e-3)


def cameras() -> list[Camera]:
    lens = OpenCVLens(1500.0, 1502.0, 650.0, 500.0, -0.08)
    centres = [(0.5, 0.4, 1.2), (-0.5, 0.4, 1.3), (-0.4, -0.5, 1.2), (0.5, -0.5, 1.25)]
    return [Camera(f"c{k}", *SIZE, lens, looking(c, (0, 0, 0))) for k, c in enumerate(centres)]


def target() -> np.ndarray:
    x, y, z = np.meshgrid(np.linspace(-0.25, 0.25, 9), np.linspace(-0.25, 0.25, 9), LEVELS)
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def twisted(points: np.ndarray) -> np.ndarray:
    """Return where the points really are: each level turned about z."""
    moved = points.copy()
    for level, turn in zip(LEVELS, TURNS, strict=True):
        on = points[:, 2] == level
        moved[on] = Rotation.from_rotvec([0, 0, turn]).apply(points[on])
    return moved


def measured(really: np.ndarray, noise_px: float = 0.1) -> list[MeasuredPoints]:
    rng = np.random.default_rng(4)
    return [
        MeasuredPoints(cv2_pixels(one, really) + rng.normal(0, noise_px, (len(really), 2)), target())
        for one in cameras()
    ]


def starts(given: list[MeasuredPoints]) -> list[Camera]:
    rngs = np.random.default_rng(1).spawn(len(given))
    return [resected_camera(f"c{k}", SIZE, "opencv", given[k], rngs[k]) for k in range(len(given))]


def test_cameras_of_a_perfect_target():
    given = measured(target())
    result = adjust_together(starts(given), given, FREE, sigma_px=0.1)
    assert result.sigma0 == pytest.approx(1.0, abs=0.1)
    for k, (one, true) in enumerate(zip(result.cameras, cameras(), strict=True)):
        sigma = np.sqrt(np.diag(result.precision.covariance))[
            [f"c{k}." in name for name in result.parameters]
        ]
        assert np.isfinite(sigma).all()
        assert abs(one.lens.fx_px - true.lens.fx_px) < 4 * result.standard_deviations[f"c{k}.fx_px"]
        shift = one.world_from_camera.translation - true.world_from_camera.translation
        assert np.linalg.norm(shift) < 2e-3


def test_stands_that_turned_are_found():
    given = measured(twisted(target()))
    held = adjust_together(starts(given), given, FREE, sigma_px=0.1)
    free = adjust_together(
        starts(given), given, FREE, sigma_px=0.1, stands=StandError(2, 3e-3, (1e-4, 1e-4, 1e-4))
    )
    turns = Rotation.from_matrix(free.placements.rotation).as_rotvec()[:, 2]
    np.testing.assert_allclose(turns, TURNS, atol=1e-4)
    assert held.sigma0 > 2
    assert free.sigma0 == pytest.approx(1.0, abs=0.1)


def test_points_off_by_a_known_sigma_are_weighted():
    rng = np.random.default_rng(7)
    given = measured(target() + rng.normal(0, 2e-4, (len(target()), 3)))
    held = adjust_together(starts(given), given, FREE, sigma_px=0.1)
    free = adjust_together(starts(given), given, FREE, sigma_px=0.1, point_sigma_m=2e-4)
    assert held.sigma0 > 2
    assert free.sigma0 == pytest.approx(1.0, abs=0.1)


def test_the_same_point_of_several_cameras_is_one():
    given = measured(target())[:2]
    points, index = distinct_points(given)
    assert len(points) == len(target())
    np.testing.assert_array_equal(points[index[: len(target())]], target())
    centres, stand = stand_centres(points, 2)
    np.testing.assert_allclose(centres, [(0, 0, level) for level in LEVELS], atol=1e-12)
    assert np.bincount(stand).tolist() == [81, 81, 81]


def test_a_fisheye_is_not_resected_here():
    with pytest.raises(InputError, match="opencv and mosca"):
        resected_camera("a", SIZE, "fisheye", measured(target())[0], np.random.default_rng(0))
