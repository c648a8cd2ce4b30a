"""Targets at rest: the blur of the lens, the targets' brightness, and how the image moves from frame to frame.

The mean of many images has little noise: an ellipse is fitted to each isolated target in it. The frames differ from
this mean by small displacements, which are estimated linearly (Lucas and Kanade, 1981): each frame is regressed on
the model's slopes, brightness and background. Motion that all targets of a camera share is the camera's own shake;
motion of single targets is noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.accuracy.lab_twin.disc_model import DiscModel, EllipseFit
from mosca.accuracy.lab_twin.estimates import root
from mosca.accuracy.lab_twin.pixel_statistics import PixelStatistics
from mosca.data.arrays import Array
from mosca.data.detections import SATURATED, Detections

MOST_TARGETS = 24
"""Largest number of targets fitted in a camera, evenly over its image."""
FEWEST_TARGETS = 3
ROOM_PX = 5
"""Distance between a target's rim and the border of its window."""
FEWEST_OF_FIELD = 6
"""Fewest targets from which the change of blur over the field is estimated."""
LEAST_FIELD = 0.5
"""Share of the image's half diagonal that the outermost target must reach: farther out is extrapolation."""
UNEVEN = 0.005
"""Assumed error of the evenly lit disc model, as a share of the light: a few pixels must not outweigh all others."""
MOST_MISFIT = 0.08
"""Rms of the residuals over the brightness beyond which the window shows something other than a disc."""
LEAST_RADIUS_PX = 1.0
"""Radius of a target from which brightness and blur can be separated."""


@dataclass(frozen=True, eq=False)
class FittedTarget:
    """A target at rest in one camera's mean image."""

    fit: EllipseFit
    row: int
    """First row of its window."""
    column: int
    """First column of its window."""
    size: int
    """Side of the window [px]."""
    sigma: Array
    """(size, size) temporal standard deviation of the pixels [DN]."""
    ground: float
    """Mean of the window's outermost pixels [DN]: the fit's background also takes up what the disc model lacks."""

    @property
    def xy_px(self) -> tuple[float, float]:
        """Position in the image."""
        return self.column + self.fit.x_px, self.row + self.fit.y_px

    def window(self, image: Array) -> Array:
        """Return the target's window of an image (H, W)."""
        part: Array = image[self.row : self.row + self.size, self.column : self.column + self.size]
        return part


def refitted(sums: PixelStatistics, targets: Sequence[FittedTarget], defocus: Array) -> list[FittedTarget]:
    """Return the targets (n) fitted anew with shares (n,) of the squared blur that are defocus; as they were
    where no ellipse fits.
    """
    made = []
    for one, share in zip(targets, defocus, strict=True):
        first = (one.fit.x_px, one.fit.y_px, one.fit.radius_px)
        mean = one.window(sums.mean)
        light = np.maximum(mean - np.median(mean[[0, -1]]), 0.0)
        sigma = np.sqrt(one.sigma**2 / sums.images + (UNEVEN * light) ** 2)
        fit = DiscModel(one.size).fit(mean, sigma, first, float(share))
        made.append(one if fit is None else replace(one, fit=fit))
    return made


def fit_targets(sums: PixelStatistics, found: Detections) -> list[FittedTarget]:
    """Return fits of the isolated targets in the mean of a camera's images.

    Parameters
    ----------
    sums
        Statistics of the camera's images of targets at rest.
    found
        Targets in the rounded mean image.
    """
    mean, variance = sums.mean, np.maximum(sums.variance, 1.0 / 12.0)
    top = 2**sums.bits - 1
    fitted = []
    for k in _chosen(found, mean.shape):
        x, y = found.xy_px[k]
        radius = max(0.5 * float(found.diameter_px[k]), 0.5)
        half = math.ceil(radius) + ROOM_PX
        row, column, size = round(y) - half, round(x) - half, 2 * half + 1
        inside = row >= 0 and column >= 0 and row + size <= mean.shape[0] and column + size <= mean.shape[1]
        away = np.delete(np.hypot(*(found.xy_px - found.xy_px[k]).T) - 0.5 * found.diameter_px, k)
        if not inside or found.flags[k] & SATURATED or away.min(initial=np.inf) < 1.5 * half:
            continue
        part = np.s_[row : row + size, column : column + size]
        if mean[part].max() + 4.0 * math.sqrt(variance[part].max()) > top:
            continue
        light = np.maximum(mean[part] - np.median(mean[part][[0, -1]]), 0.0)
        sigma = np.sqrt(variance[part] / sums.images + (UNEVEN * light) ** 2)
        fit = DiscModel(size).fit(mean[part], sigma, (x - column, y - row, radius))
        if fit is not None and fit.misfit < MOST_MISFIT and fit.radius_px > LEAST_RADIUS_PX:
            rim = np.concatenate([mean[part][[0, -1]].ravel(), mean[part][1:-1, [0, -1]].ravel()])
            fitted.append(FittedTarget(fit, row, column, size, np.sqrt(variance[part]), float(rim.mean())))
    return fitted


def corner_blur(
    targets: Sequence[FittedTarget], shake_px: float, shape: tuple[int, int]
) -> tuple[float, float] | None:
    """Return the blur at the corner of an image (H, W) and its standard deviation [px]; None if undetermined.

    The square of the blur is assumed to grow with the square of the distance from the middle, which is the effect of
    field curvature to first order. A straight line is fitted by least squares.
    """
    half = 0.5 * math.hypot(*shape)
    far = np.array([math.hypot(t.xy_px[0] - shape[1] / 2, t.xy_px[1] - shape[0] / 2) / half for t in targets])
    square = np.array([sharper(one, shake_px) ** 2 for one in targets])
    if len(targets) < FEWEST_OF_FIELD or far.max() < LEAST_FIELD:
        return None
    line, covariance = np.polyfit(far**2, square, 1, cov=True)
    return root(float(line.sum()), math.sqrt(float(covariance.sum())))


def _chosen(found: Detections, shape: tuple[int, ...]) -> list[int]:
    """Return the indices of up to MOST_TARGETS detections, those farthest from each other first."""
    if len(found) <= MOST_TARGETS:
        return list(range(len(found)))
    xy = found.xy_px
    chosen = [int(np.argmin(np.hypot(xy[:, 0] - shape[1] / 2, xy[:, 1] - shape[0] / 2)))]
    nearest = np.full(len(xy), np.inf)
    while len(chosen) < MOST_TARGETS:
        nearest = np.minimum(nearest, np.hypot(*(xy - xy[chosen[-1]]).T))
        chosen.append(int(np.argmax(nearest)))
    return chosen


class TargetDisplacements:
    """Displacements of a camera's targets, frame by frame; ``add`` takes each image."""

    def __init__(self, targets: Sequence[FittedTarget], shake_px: float = 0.0, turned: Array | None = None) -> None:
        """Prepare the fits; ``shake_px``: rms motion, an axis, that blurs the mean image but not single frames.

        ``turned`` (t, 2, 2): motion of each target, in columns, as the middle of the image moves by 1 px along x, and
        along y; None: the same as there. Rotation moves images off the axis farther.
        """
        self._targets = targets
        self._turned = np.tile(np.eye(2), (len(targets), 1, 1)) if turned is None else turned
        self._solve = []
        self._sigma = np.empty((len(targets), 2))
        models: dict[int, DiscModel] = {}
        for k, one in enumerate(targets):
            model = models.setdefault(one.size, DiscModel(one.size))
            blur = math.sqrt(max(one.fit.blur_px**2 - shake_px**2, 0.04))
            disc, by_x, by_y = model.with_slopes(one.fit, blur)
            columns = np.stack([one.fit.level * by_x, one.fit.level * by_y, disc, np.ones_like(disc)], axis=-1)
            weight = 1.0 / one.sigma.ravel()
            design = columns.reshape(-1, 4) * weight[:, None]
            inverse = np.linalg.pinv(design)
            self._solve.append(inverse[:2] * weight)
            self._sigma[k] = np.sqrt((inverse[:2] ** 2).sum(axis=1))
        self._rows: list[Array] = []
        self.numbers: list[int] = []

    def add(self, image: Array, number: int) -> None:
        """Take an image (H, W) and its frame's number."""
        row = np.empty((len(self._targets), 2))
        for k, (one, solve) in enumerate(zip(self._targets, self._solve, strict=True)):
            row[k] = solve @ one.window(image).astype(float).ravel()
        self._rows.append(row)
        self.numbers.append(number)

    def common(self) -> tuple[Array, float]:
        """Return the motion (n, 2) of the image's middle, about its mean [px], and the rms of its noise, an axis.

        By least squares over all targets; the noise is estimated from the differences between targets.
        """
        moved = np.array(self._rows)
        moved -= moved.mean(axis=0)
        weight = 1.0 / self._sigma**2
        inverse = np.linalg.inv(np.einsum("tk,tki,tkj->ij", weight, self._turned, self._turned))
        shared = np.einsum("tk,tki,ntk,ij->nj", weight, self._turned, moved, inverse)
        own = moved - np.einsum("tki,ni->ntk", self._turned, shared)
        t = len(self._targets)
        # ratio of the scatter about the common motion to the scatter that pixel noise explains
        excess = float(np.mean((own**2 * weight).sum(axis=1) / (t - 1)))
        return shared, math.sqrt(excess * float(np.mean(np.diag(inverse))))


def sharper(target: FittedTarget, shake_px: float) -> float:
    """Return the blur [px] of a target's single images, without the shake that blurs their mean."""
    return math.sqrt(max(target.fit.blur_px**2 - shake_px**2, 0.0))
