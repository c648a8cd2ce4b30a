"""A marker's outline and motion as the camera sees them: what both ways of integrating its image share."""

import math

import numpy as np
from numba import njit

from twin.cameras.lens import land

BALL, FLAT = 0, 1
MAX_NODES = 24
PANEL_PX = 15.0
MOST_PANELS = 100
_NODES = [np.polynomial.legendre.leggauss(n) for n in range(1, MAX_NODES + 1)]
NODE_AT = np.zeros((MAX_NODES + 1, MAX_NODES))
NODE_WEIGHT = np.zeros((MAX_NODES + 1, MAX_NODES))
for _n, (_at, _weight) in enumerate(_NODES, start=1):
    NODE_AT[_n, :_n], NODE_WEIGHT[_n, :_n] = _at, _weight / 2


@njit(nogil=True, cache=True)
def _across(x, y, z):  # type: ignore[no-untyped-def]
    """Two unit vectors at right angles to (x, y, z) and to each other."""
    n = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / n, y / n, z / n
    if abs(x) < 0.7:
        ax, ay, az = 0.0, z, -y
    else:
        ax, ay, az = -z, 0.0, x
    k = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / k, ay / k, az / k
    return ax, ay, az, y * az - z * ay, z * ax - x * az, x * ay - y * ax


@njit(nogil=True, cache=True)
def rim(shape, n, x, y, z, r, angle):  # type: ignore[no-untyped-def]
    """A direction to the marker's outline at ``angle`` and its derivative by the angle."""
    if shape == FLAT:
        ax, ay, az, bx, by, bz = _across(n[0], n[1], n[2])
        c, s = r * math.cos(angle), r * math.sin(angle)
        ox, oy, oz = x, y, z
    else:
        ax, ay, az, bx, by, bz = _across(x, y, z)
        d2 = x * x + y * y + z * z
        # the touching circle: centre C (1 - r^2/d^2), radius r sqrt(1 - r^2/d^2)
        q = 1.0 - r * r / d2
        k = r * math.sqrt(q)
        c, s = k * math.cos(angle), k * math.sin(angle)
        ox, oy, oz = x * q, y * q, z * q
    return (
        ox + c * ax + s * bx, oy + c * ay + s * by, oz + c * az + s * bz,
        c * bx - s * ax, c * by - s * ay, c * bz - s * az,
    )  # fmt: skip


@njit(nogil=True, cache=True)
def front_of(dx, dy, dz, x, y, z, r, shape, n):  # type: ignore[no-untyped-def]
    """Distance along d at which the marker's own front is met (the silhouette's edge counts as met)."""
    if shape == FLAT:
        return (x * n[0] + y * n[1] + z * n[2]) / (dx * n[0] + dy * n[1] + dz * n[2])
    a = dx * dx + dy * dy + dz * dz
    b = dx * x + dy * y + dz * z
    return (b - math.sqrt(max(0.0, b * b - a * (x * x + y * y + z * z - r * r)))) / a


@njit(nogil=True, cache=True)
def place_at(path, tau):  # type: ignore[no-untyped-def]
    """Place on the parabola through the path's start (-1), middle (0) and end (+1)."""
    a, b = 0.5 * tau * (tau - 1.0), 0.5 * tau * (tau + 1.0)
    c = 1.0 - tau * tau
    return (
        a * path[0, 0] + c * path[1, 0] + b * path[2, 0],
        a * path[0, 1] + c * path[1, 1] + b * path[2, 1],
        a * path[0, 2] + c * path[1, 2] + b * path[2, 2],
    )


@njit(nogil=True, cache=True)
def image_motion(lens, path):  # type: ignore[no-untyped-def]
    """Length of this path's image [px], of one that turns or speeds up at its faster half's pace; -1: not imaged."""
    ua, va, _a, _b, _c, _d, _e, _f, ok_a = land(lens, path[0, 0], path[0, 1], path[0, 2])
    ub, vb, _a, _b, _c, _d, _e, _f, ok_b = land(lens, path[2, 0], path[2, 1], path[2, 2])
    if not ok_a or not ok_b:
        return -1.0
    chord = math.sqrt((ub - ua) ** 2 + (vb - va) ** 2)
    um, vm, _a, _b, _c, _d, _e, _f, ok_m = land(lens, path[1, 0], path[1, 1], path[1, 2])
    if not ok_m:
        return chord
    turned = 2.0 * math.sqrt(max((um - ua) ** 2 + (vm - va) ** 2, (ub - um) ** 2 + (vb - vm) ** 2))
    # a path that is nearly straight and even keeps its chord; one that turns back or speeds up does not
    return turned if turned > 1.2 * chord else chord


@njit(nogil=True, cache=True)
def instants(lens, path):  # type: ignore[no-untyped-def]
    """Instants (-1..1) and weights (sum 1) that integrate the image motion of this path: Gauss-Legendre.

    Nodes lie widest apart in the middle, pi / 2 of their mean distance: with 1.6 a pixel that is 1 px, which
    the pixel's own width smooths to below 1e-4 of the streak. Long streaks are cut into panels of at most 15 px.
    """
    length = image_motion(lens, path)
    panels, nodes = 1, 1
    if length >= 0.3:
        panels = min(1 + int(length / PANEL_PX), MOST_PANELS)
        each = length / panels
        nodes = min(MAX_NODES, max(3 + int(each), int(1.6 * each)))
    elif length >= 1e-3:
        nodes = 2
    at, share = np.empty(panels * nodes), np.empty(panels * nodes)
    for p in range(panels):
        for k in range(nodes):
            at[p * nodes + k] = (2 * p + 1 - panels + NODE_AT[nodes, k]) / panels
            share[p * nodes + k] = NODE_WEIGHT[nodes, k] / panels
    return at, share
