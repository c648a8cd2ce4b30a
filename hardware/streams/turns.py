"""Which axis of a stream points up, and products of quaternions."""

from typing import Literal

import numpy as np

from mosca.data.arrays import Array

UpAxis = Literal["z", "y"]
UP = {"z": np.eye(3), "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])}
"""Streamed axes from the world's (Z up)."""
_HALF = np.sqrt(0.5)
UP_TURN = {"z": np.array([1.0, 0.0, 0.0, 0.0]), "y": np.array([_HALF, -_HALF, 0.0, 0.0])}
"""The same as quaternions wxyz."""


def product(p: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    """Return the product of two quaternions wxyz, whose parts may be arrays."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
