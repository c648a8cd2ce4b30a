"""OpenCV's pinhole model: ideal -> distorted, rational radial, tangential and thin prism distortion, tilted sensor.

With x = X/Z, y = Y/Z, r^2 = x^2 + y^2 and q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6):

    xd = x q + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4      u = cx + fx xt
    yd = y q + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4      v = cy + fy yt

(xt, yt) is (xd, yd) seen on a sensor turned by R = R_y(tauY) R_x(tauX):

    (xt, yt, 1) ~ [[R33, 0, -R13], [0, R33, -R23], [0, 0, 1]] R (xd, yd, 1)

Source: OpenCV documentation, calib3d, "Detailed Description".
"""

from functools import lru_cache

import numpy as np

from mosca.camera.lens_models.monotonic_range import first_positive_root
from mosca.data.arrays import Array
from mosca.data.rig import OpenCVLens

NEWTON_STEPS = 30
CONVERGED = 1e-14


def directions(lens: OpenCVLens, xy_px: Array) -> Array:
    """Pixel (n, 2) -> direction (n, 3) with z = 1, camera frame; Newton's method, NaN where it fails
    or ends beyond the fold.
    """
    xy = np.asarray(xy_px, dtype=float)
    distorted = _untilted(lens, (xy - (lens.cx_px, lens.cy_px)) / (lens.fx_px, lens.fy_px))
    ideal = distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            value, slope, _ = _distort(lens, ideal)
            rest = distorted - value
            determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
            step = np.column_stack(
                [
                    (slope[:, 1, 1] * rest[:, 0] - slope[:, 0, 1] * rest[:, 1]) / determinant,
                    (slope[:, 0, 0] * rest[:, 1] - slope[:, 1, 0] * rest[:, 0]) / determinant,
                ]
            )
            ideal = ideal + step
            if not np.any(np.abs(step) > CONVERGED):
                break
        value, slope, _ = _distort(lens, ideal)
        found = np.abs(distorted - value).max(axis=1, initial=0.0) < 1e-10
        found &= _imaged(lens, ideal, slope)
    ideal[~found] = np.nan
    return np.column_stack([ideal, np.ones(len(ideal))])


def pixels(lens: OpenCVLens, directions: Array) -> tuple[Array, Array, Array]:
    """Direction (n, 3), camera frame -> pixel (n, 2), d pixel/d direction (n, 2, 3), d pixel/d lens (n, 2, 18).

    NaN for directions behind the camera and beyond the radius where the distortion folds back.
    """
    v = np.asarray(directions, dtype=float)
    front = v[:, 2] > 0
    z = np.where(front, v[:, 2], 1.0)
    ideal = np.column_stack([v[:, 0] / z, v[:, 1] / z])
    with np.errstate(all="ignore"):
        distorted, slope, by_distortion = _distort(lens, ideal)
        seen = front & _imaged(lens, ideal, slope)
        image, slope, by_distortion, before = _tilt(lens, distorted, slope, by_distortion)
        seen &= before
    focal = np.array([lens.fx_px, lens.fy_px])
    xy = np.array([lens.cx_px, lens.cy_px]) + focal * image
    ideal_by_direction = np.zeros((len(v), 2, 3))
    ideal_by_direction[:, 0, 0] = ideal_by_direction[:, 1, 1] = 1 / z
    ideal_by_direction[:, :, 2] = -ideal / z[:, None]
    by_direction = focal[:, None] * (slope @ ideal_by_direction)
    by_lens = np.zeros((len(v), 2, 18))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = image[:, 0], image[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4:] = focal[:, None] * by_distortion
    xy[~seen], by_direction[~seen], by_lens[~seen] = np.nan, np.nan, np.nan
    return xy, by_direction, by_lens


@lru_cache(maxsize=256)
def fold_r2(lens: OpenCVLens) -> float:
    """Return the squared ideal radius at which the radial distortion r q(r^2) stops rising, or infinity.

    With q = N / D in s = r^2 the slope by r is (N D + 2 s (N' D - N D')) / D^2; a pole (D = 0) ends it too.
    """
    above = np.array([1.0, lens.k1, lens.k2, lens.k3])
    below = np.array([1.0, lens.k4, lens.k5, lens.k6])
    order = np.arange(4)
    # 2 s N' has the coefficients 2 k n_k, so the slope's numerator is a sum of products of the two
    rising = np.convolve(above * (1 + 2 * order), below) - np.convolve(above, 2 * order * below)
    return min(first_positive_root(rising), first_positive_root(below))


def _imaged(lens: OpenCVLens, ideal: Array, slope: Array) -> Array:
    """Return which ideal points (n, 2) lie before the fold (n,).

    Both stretches turn negative beyond the fold, so the determinant alone does not tell; farther out both may be
    positive again, so the slope alone does not tell either.
    """
    regular = (np.linalg.det(slope) > 0) & (np.trace(slope, axis1=1, axis2=2) > 0)
    return np.asarray(regular & ((ideal**2).sum(axis=1) < fold_r2(lens)))


def _distort(lens: OpenCVLens, ideal: Array) -> tuple[Array, Array, Array]:
    """Return distorted (n, 2), its slope by ideal (n, 2, 2) and by k1, k2, p1, p2, k3-k6, s1-s4 (n, 2, 12)."""
    x, y = ideal[:, 0], ideal[:, 1]
    r2 = x * x + y * y
    above = 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    below = 1 + r2 * (lens.k4 + r2 * (lens.k5 + r2 * lens.k6))
    above_slope = lens.k1 + r2 * (2 * lens.k2 + r2 * 3 * lens.k3)
    below_slope = lens.k4 + r2 * (2 * lens.k5 + r2 * 3 * lens.k6)
    q = above / below
    q_slope = (above_slope - q * below_slope) / below  # d q / d r2
    p1, p2 = lens.p1, lens.p2
    distorted = np.column_stack(
        [
            x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (lens.s1 + r2 * lens.s2),
            y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (lens.s3 + r2 * lens.s4),
        ]
    )
    prism = 2 * np.column_stack([lens.s1 + 2 * r2 * lens.s2, lens.s3 + 2 * r2 * lens.s4])
    slope = prism[:, :, None] * ideal[:, None, :]
    slope[:, 0, 0] += q + 2 * x * x * q_slope + 2 * p1 * y + 6 * p2 * x
    across = 2 * x * y * q_slope + 2 * p1 * x + 2 * p2 * y
    slope[:, 0, 1] += across
    slope[:, 1, 0] += across
    slope[:, 1, 1] += q + 2 * y * y * q_slope + 6 * p1 * y + 2 * p2 * x
    by = np.zeros((len(x), 2, 12))
    for k, power in ((0, r2), (1, r2**2), (4, r2**3)):
        by[:, :, k] = ideal * (power / below)[:, None]
    for k, power in ((5, r2), (6, r2**2), (7, r2**3)):
        by[:, :, k] = ideal * (-q * power / below)[:, None]
    by[:, 0, 2], by[:, 1, 2] = 2 * x * y, r2 + 2 * y * y
    by[:, 0, 3], by[:, 1, 3] = r2 + 2 * x * x, 2 * x * y
    by[:, 0, 8], by[:, 0, 9] = r2, r2**2
    by[:, 1, 10], by[:, 1, 11] = r2, r2**2
    return distorted, slope, by


def _tilt(lens: OpenCVLens, distorted: Array, slope: Array, by: Array) -> tuple[Array, Array, Array, Array]:
    """Carry distorted points (n, 2) and their Jacobians onto the tilted sensor.

    Returns the points (n, 2), their slope by ideal (n, 2, 2) and by all 14 coefficients (n, 2, 14), and which
    of them the sensor's plane meets in front of the lens (n,).
    """
    matrix, by_tau = _tilt_matrix(lens.tauX, lens.tauY)
    homogeneous = np.column_stack([distorted, np.ones(len(distorted))])
    image = homogeneous @ matrix.T
    depth = image[:, 2]
    xy = image[:, :2] / depth[:, None]
    carry = (matrix[:2, :2] - xy[:, :, None] * matrix[2, :2]) / depth[:, None, None]
    moved = np.stack([homogeneous @ one.T for one in by_tau], axis=2)  # (n, 3, 2)
    by_tilt = (moved[:, :2] - xy[:, :, None] * moved[:, 2:]) / depth[:, None, None]
    if lens.tauX == 0 and lens.tauY == 0:
        return distorted, slope, np.concatenate([by, by_tilt], axis=2), depth > 0
    return xy, carry @ slope, np.concatenate([carry @ by, by_tilt], axis=2), depth > 0


def _untilted(lens: OpenCVLens, image: Array) -> Array:
    """Return distorted points (n, 2) of points (n, 2) on the tilted sensor; NaN where no light comes from."""
    if lens.tauX == 0 and lens.tauY == 0:
        return image
    back = np.linalg.inv(_tilt_matrix(lens.tauX, lens.tauY)[0])
    distorted = np.column_stack([image, np.ones(len(image))]) @ back.T
    distorted[~(distorted[:, 2] > 0)] = np.nan
    return np.asarray(distorted[:, :2] / distorted[:, 2:])


def _tilt_matrix(tau_x: float, tau_y: float) -> tuple[Array, tuple[Array, Array]]:
    """Return the homography (3, 3) of the tilt and its derivatives by tauX and tauY."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_x_slope = np.array([[0, 0, 0], [0, -sx, cx], [0, -cx, -sx]])
    about_y_slope = np.array([[-sy, 0, -cy], [0, 0, 0], [cy, 0, -sy]])
    turn = about_y @ about_x
    slopes = []
    for turn_slope in (about_y @ about_x_slope, about_y_slope @ about_x):
        slopes.append(_onto_plane(turn_slope, 0.0) @ turn + _onto_plane(turn, 1.0) @ turn_slope)
    return _onto_plane(turn, 1.0) @ turn, (slopes[0], slopes[1])


def _onto_plane(turn: Array, one: float) -> Array:
    return np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, one]])
