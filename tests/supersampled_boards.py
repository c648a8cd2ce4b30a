"""Perspective chessboards integrated over 16 x 16 parts of a pixel, with the true corners and their bound.

Independent of the code under test: black and white are sampled through a homography and a radial term, blurred and
averaged; each part's own average is exact for straight edges.
"""

import numpy as np
from pixel_parts import averaged

PARTS = 16
BLACK, WHITE = 30.0, 200.0
DARK_DN2, GAIN_DN = 0.5, 0.05


def pose(square_px, slant, lean, roll, centre, distance=1500.0):
    """Return the homography (3, 3) from squares, x right and y down from the middle, to pixels."""
    c, s = np.cos(lean), np.sin(lean)
    k = np.array([[0, 0, s], [0, 0, -c], [-s, c, 0]])
    turn = np.eye(3) + np.sin(slant) * k + (1 - np.cos(slant)) * k @ k
    turn = turn @ np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    camera = np.array([[distance, 0, centre[0]], [0, distance, centre[1]], [0, 0, 1]])
    return camera @ np.column_stack([turn[:, 0], turn[:, 1], [0, 0, distance / square_px]])


def drawn(homography, squares, size, blur_px, radial=0.0):
    """Return the noise-free image (H, W) [DN] of ``squares`` (columns, rows) in a white surrounding.

    ``radial`` [px^-2]: straight lines' images are at ``x (1 + radial |x|^2)``, x from the image's middle.
    """
    middle = (np.array(size) - 1) / 2
    x, y = (np.arange(n * PARTS) / PARTS + 0.5 / PARTS - 0.5 - m for n, m in zip(size, middle, strict=True))
    y = y[:, None]
    away = 1 + radial * (x**2 + y**2) if radial else 1.0
    x, y = x * away + middle[0], y * away + middle[1]
    at = [row[0] * x + row[1] * y + row[2] for row in np.linalg.inv(homography)]
    pattern, inside = 1.0, True
    for t, n in zip((at[0] / at[2], at[1] / at[2]), squares, strict=True):
        line = np.rint(t - n / 2)
        distance = (t - n / 2 - line) / np.hypot(*np.gradient(t))  # in parts
        pattern = pattern * (1 - 2 * (line % 2)) * np.clip(2 * distance, -1, 1)
        inside = inside & (np.abs(t) < n / 2)
    pattern = averaged(np.where(inside, pattern, 1.0), PARTS, blur_px, truncate=5)
    return 0.5 * (WHITE + BLACK) + 0.5 * (WHITE - BLACK) * pattern


def corners(homography, squares, size, radial=0.0):
    """Return the inner corners on the board (n, 2) [squares] and in the image (n, 2) [px], row by row."""
    column, row = np.meshgrid(*(np.arange(1, n) - n / 2 for n in squares))
    board = np.column_stack([column.ravel(), row.ravel()])
    seen = np.column_stack([board, np.ones(len(board))]) @ homography.T
    middle = (np.array(size) - 1) / 2
    straight = seen[:, :2] / seen[:, 2:] - middle
    found = straight.copy()
    for _ in range(50):
        found = straight / (1 + radial * (found**2).sum(axis=1, keepdims=True))
    return board, found + middle


def noisy(image, rng):
    """Return the image (H, W) uint8 with the noise of a sensor, after EMVA 1288."""
    sigma = np.sqrt(DARK_DN2 + GAIN_DN * image)
    return np.clip(np.rint(image + sigma * rng.normal(size=image.shape)), 0, 255).astype(np.uint8)


def bound(homography, squares, corner, blur_px, half_px):
    """Return the Cramer-Rao bound [px^2] of a coordinate of the corner at ``corner`` (2,) [squares].

    From the pixels of its half squares, at most ``half_px`` away; place, directions of both edges, blur, black and
    white are unknown, light is even.
    """
    there = homography @ [*corner, 1]
    at = there[:2] / there[2]
    reach = int(np.ceil(half_px)) + 2
    first, size = np.rint(at).astype(int) - reach, (2 * reach + 1, 2 * reach + 1)

    def seen(right=0.0, down=0.0, tilt=0.0, shear=0.0, wider=0.0):
        about = np.array([[1, shear, -shear * corner[1]], [tilt, 1, -tilt * corner[0]], [0, 0, 1]])
        to = np.array([[1, 0, right - first[0]], [0, 1, down - first[1]], [0, 0, 1]])
        return drawn(to @ homography @ about, squares, size, blur_px + wider)

    image = seen()
    slopes = [seen(**{name: 0.02}) - seen(**{name: -0.02}) for name in ("right", "down", "tilt", "shear", "wider")]
    slopes = np.array([*(slope / 0.04 for slope in slopes), np.ones_like(image), image])
    y, x = np.mgrid[: size[1], : size[0]] + first[::-1, None, None]
    on_board = np.tensordot(np.linalg.inv(homography), np.stack([x, y, np.ones_like(x)]).astype(float), 1)
    away = np.abs(on_board[:2] / on_board[2] - np.array(corner)[:, None, None]).max(axis=0)
    mine = (away < 0.5) & (np.maximum(np.abs(x - at[0]), np.abs(y - at[1])) <= half_px)
    weighted = slopes[:, mine] / np.sqrt(DARK_DN2 + GAIN_DN * image[mine] + 1 / 12)
    scale = np.linalg.norm(weighted, axis=1)
    inverse = np.linalg.inv(weighted @ weighted.T / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.trace(inverse[:2, :2]) / 2
