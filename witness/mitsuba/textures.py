"""Printed surfaces as images: chessboards, coded targets, grainy walls. The renderer samples texels linearly."""

import cv2
import numpy as np

from witness.mitsuba.scene import Array, Chessboard, CodedPlate

WHITE, BLACK = 0.85, 0.04
"""Reflectances of matt paper and matt print."""
TEXELS_A_SQUARE = 64
PLATE_TEXELS = 1024
PLATE_RADII = 8.0
"""Edge of a coded target's plate in dot radii; its ring reaches from 2 to 3 dot radii."""
SUB = 2


def board_texture(board: Chessboard) -> Array:
    """Return reflectances (rows, columns); the first row is the board's upper edge. Edges lie between texels."""
    n = TEXELS_A_SQUARE
    margin = round(board.margin_m / board.square_m * n)
    squares = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
    image = np.where(np.kron(squares, np.ones((n, n), int)) == 0, BLACK, WHITE)
    return np.pad(image, margin, constant_values=WHITE)


def coded_texture(target: CodedPlate) -> Array:
    """Return reflectances (n, n), y up in the first row; each texel averages SUB^2 points."""
    n = PLATE_TEXELS * SUB
    steps = ((np.arange(n) + 0.5) / n - 0.5) * PLATE_RADII
    x, y = np.meshgrid(steps.astype(np.float32), -steps.astype(np.float32))
    radius = np.hypot(x, y)
    sector = np.floor(np.mod(np.arctan2(y, x), 2 * np.pi) / (2 * np.pi) * len(target.sectors)).astype(int)
    lit = np.array(target.sectors)[np.clip(sector, 0, len(target.sectors) - 1)]
    white = (radius < 1) | (lit & (radius > 2) & (radius < 3))
    fine = np.where(white, WHITE, BLACK).astype(np.float32)
    return np.asarray(fine.reshape(PLATE_TEXELS, SUB, PLATE_TEXELS, SUB).mean((1, 3)))


def grain(reflectance: float, contrast: float, texels: int, grain_texels: float, seed: int) -> Array:
    """Return even noise smoothed to ``grain_texels``, of mean ``reflectance`` and relative rms ``contrast``."""
    noise: Array = np.random.default_rng(seed).standard_normal((texels, texels)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), max(grain_texels, 0.5))
    relative = noise * (contrast / max(float(noise.std()), 1e-9))
    return np.asarray(np.clip(reflectance * (1 + relative), 0.02, 0.95))
