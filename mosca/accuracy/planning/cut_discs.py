"""Images of markers that are partly hidden by the body that wears them, or overlap: shifts, weights, missing images.

A ball of radius r seated on a convex body is partly hidden where the sight line to its centre passes through the body
or nearer to it than r. With the clearance d of that line (below zero inside), the body's edge cuts a straight piece
off the disc. For a disc of radius 1 cut at x = d / r, the hidden share h and the shift c of the remaining part's
centroid away from the edge are

    h = (acos x - x sqrt(1 - x^2)) / pi,    c = 2 (1 - x^2)^(3/2) / (3 pi (1 - h)),    c -> h for small h

(a segment of a circle, and its first moment). Where little is hidden, a circle fitted to the edge moves by as much:
the edge is displaced by u(phi) = 1 - x / cos phi, and 1 / pi int u cos phi dphi = h to first order.

An image's weight follows the pipeline's rule (``mosca.correspondence.hypothesis``). Missing areas below a share are
taken for noise of the sizes, and the image has full weight in spite of its shift. Above it, the image's variance
grows by the square of the shift that belongs to the share. A point is the weighted mean of images, each displaced by
e = c r t, with t the edge's normal. With N = sum J'J / v, where v is the assumed variance,

    mean error = N^-1 sum J'J e / v,    covariance of the noise = N^-1 (sum J'J sigma^2 / v^2) N^-1.

Discs of two balls on the same body that overlap in an image make one region, up to twice as large as a disc. By the
same rule the share that it has too much counts as a shift, of up to MOST_LARGE radii. Beside an image whose error is
a few hundredths of a radius it has almost no weight: such images are predicted as missing.
"""

from dataclasses import dataclass

import numpy as np

from mosca.accuracy.planning.obstacles import CYLINDER, clearance
from mosca.camera.ray_table import FIRST_AREA_NOISE
from mosca.correspondence.hypothesis import FIRST_HIDDEN, HALF_HIDDEN, MOST_ODD, ODD_SHIFT, rather_hidden
from mosca.data.arrays import Array
from mosca.data.settings import MatchSettings
from mosca.numba_support.decorators import kernel

OUTLIERS = MatchSettings().outlier_sigma ** 2
"""Squared error, over the variance, of an image that matching leaves out whatever its size."""


@dataclass(frozen=True, eq=False)
class WornMarkers:
    """Balls seated on upright cylinders, one ball on each body; a body's place follows from its ball's centre."""

    radius_m: float
    """Radius of the balls."""
    body_radius_m: float
    low_m: float
    high_m: float
    """Heights of the body's ends."""

    def images(self, points: Array, normal: Array, places: Array) -> tuple[Array, Array, Array]:
        """Return, for images of balls, hidden shares (c, n), shifts (c, n) [radius] and their directions (c, n, 3).

        ``points`` (n, 3) [m]: centres of balls with the same ``normal`` (3,); ``places`` (c, 3) [m]: the cameras.
        """
        axes = points - (self.body_radius_m + self.radius_m) * normal
        near, edge = body_clearance(points, axes, places, self.body_radius_m, self.low_m, self.high_m)
        hidden, shift = cut_disc(near / self.radius_m)
        return hidden, shift, edge

    def overlapping(self, points: Array, normal: Array, normals: Array, places: Array) -> Array:
        """Return whether images (c, n) of balls overlap that of another ball of their body that is not hidden.

        ``points``, ``normal`` and ``places`` as in ``images``; ``normals`` (k, 3): of the balls at the same height.
        """
        reach, found = self.body_radius_m + self.radius_m, np.zeros((len(places), len(points)), bool)
        own = points - places[:, None]
        for other in normals[(normals != normal).any(axis=1)]:
            there = points + reach * (other - normal)
            away = there - places[:, None]
            angle = np.arctan2(np.linalg.norm(np.cross(own, away), axis=2), (own * away).sum(axis=2))
            apart = self.radius_m / np.linalg.norm(own, axis=2) + self.radius_m / np.linalg.norm(away, axis=2)
            near = np.flatnonzero((angle < apart).any(axis=0))
            if len(near):
                hidden, _, _ = self.images(there[near], other, places)
                found[:, near] |= (angle < apart)[:, near] & (hidden < 1.0)
        return found


def cut_disc(cut: Array) -> tuple[Array, Array]:
    """Return hidden shares and centroid shifts of discs of radius 1 that a line cuts at ``cut`` from the centre.

    From a ``cut`` of 1 on nothing is hidden. The shift is that of the remaining part, 0 where nothing remains.
    """
    x = np.clip(cut, -1.0, 1.0)
    hidden = (np.arccos(x) - x * np.sqrt(1.0 - x * x)) / np.pi
    left = np.maximum(1.0 - hidden, 1e-12)
    return hidden, 2.0 * (1.0 - x * x) ** 1.5 / (3.0 * np.pi * left)


def taken_variance(hidden: Array, radius_px: Array, variance: Array) -> Array:
    """Return the variance [px^2] that matching assumes for images with a hidden share.

    ``variance`` [px^2]: of whole images. The standard deviation of a disc's radius is 1 / sqrt(2) of its centre's
    (Fisher information of a sharp edge: pi and 2 pi times the same); relative to it, that of its area is twice as
    large.
    """
    sigma = np.maximum(FIRST_AREA_NOISE, np.sqrt(2.0 * variance) / radius_px)
    added = 0.5 * (ODD_SHIFT * np.minimum(hidden, MOST_ODD) * radius_px) ** 2
    judged = rather_hidden(hidden, sigma, np.minimum(added / variance, OUTLIERS), FIRST_HIDDEN)
    return np.asarray(variance + np.where(judged, added, 0.0))


def measured(seen: Array, hidden: Array) -> Array:
    """Return which points (n,) are measured: by three images, or by two that are not more than half hidden."""
    images = (seen & (hidden < 1.0)).sum(axis=0)
    good = (seen & (hidden < HALF_HIDDEN)).sum(axis=0)
    return np.asarray((good >= 2) | (images >= 3))


@kernel
def body_clearance(points, axes, places, radius, low, high):
    """Return the least signed distance (c, n) [m] of sight lines from a body, and the normal (c, n, 3) there.

    ``points`` (n, 3) [m]; ``axes`` (n, 3) [m]: a point on the axis of each point's upright cylinder; ``places``
    (c, 3) [m]: the cameras; ``radius``, ``low``, ``high`` [m]: of all bodies.
    """
    near, edge = np.zeros((len(places), len(points))), np.zeros((len(places), len(points), 3))
    row = np.array([CYLINDER, 0.0, 0.0, 0.5 * (low + high), radius, radius, 0.5 * (high - low), 1.0, 0.0])
    for c in range(len(places)):
        for p in range(len(points)):
            row[1], row[2] = axes[p, 0], axes[p, 1]
            d, x, y, z = clearance(
                row, points[p, 0], points[p, 1], points[p, 2], places[c, 0], places[c, 1], places[c, 2], 1e9
            )
            near[c, p] = d
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                edge[c, p, 0], edge[c, p, 1], edge[c, p, 2] = x / length, y / length, z / length
    return near, edge
