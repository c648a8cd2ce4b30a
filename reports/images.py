"""A camera's picture with the detections in it, and one target enlarged so that its pixels are visible."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import MaxNLocator

from mosca.data.arrays import Array
from reports.evidence import CameraView
from reports.plot_style import WIDE, Picture, canvas, svg_text
from reports.units import figure as number

MOST_PIXELS = 900
"""Longest side of a picture on the page; larger images are shown thinned by block maxima."""
GREYS = 48
"""Grey levels of a picture on the page: enough for the eye, with half the bytes."""
ON_IMAGE = "#ff9d2e"
"""Orange that is visible on dark grey, with any colours of the page."""
CENTROID, TRUTH = "#d1410c", "#1667c9"
"""Colours of crosses that are visible on a bright target."""


def camera_picture(view: CameraView, name: str) -> Picture:
    """Draw ``view``'s image, contrast stretched, detections circled, with one target enlarged.

    ``name``: the picture's name on the page, unique there.
    """
    height, width = view.image.shape
    shown_height = min(4.6, 0.66 * WIDE * height / width)
    drawing = canvas(WIDE, shown_height + 0.35)
    bottom = 0.3 / (shown_height + 0.35)
    axes = drawing.add_axes((0.0, 0.01, 0.66, 0.97))
    _show(axes, view.image)
    axes.set_anchor("W")
    n = len(view.detections)
    for xy, diameter in zip(view.detections.xy_px, view.detections.diameter_px, strict=True):
        side = max(2.2 * diameter, 0.014 * width)
        axes.add_patch(Ellipse(xy, side, side, fill=False, edgecolor=ON_IMAGE, linewidth=0.8))
    chosen = _typical(view)
    text = "no target detected"
    if chosen is not None:
        near = drawing.add_axes((0.725, bottom, 0.275, 0.97 - bottom))
        near.set_anchor("NW")
        text = _show_near(near, axes, view, chosen)
    caption = (
        f"{n} target{'s' if n != 1 else ''} detected in one frame of {view.camera} "
        f"({width} × {height} px, contrast stretched). " + (f"Enlarged: {text}." if chosen is not None else "")
    )
    alt = f"Image of camera {view.camera} with {n} detections circled; {text}."
    return Picture(name, f"What camera {view.camera} sees", caption.strip(), alt, svg_text(drawing, name, alt))


def stretched(image: Array, low: float | None = None, high: float | None = None) -> Array:
    """Return ``image`` (H, W) as grey 0..1: from its median to its largest value, square root, few levels."""
    low = float(np.median(image)) * 0.5 if low is None else low
    high = float(image.max()) if high is None else high
    grey = np.sqrt(np.clip((image.astype(np.float64) - low) / max(high - low, 1.0), 0.0, 1.0))
    return np.asarray(np.round(grey * (GREYS - 1)) / (GREYS - 1))


def block_maxima(image: Array, factor: int) -> Array:
    """Return ``image`` (H, W) thinned to the brightest of each ``factor`` x ``factor`` pixels.

    This keeps small targets. Remaining pixels at the right and at the bottom are cut off.
    """
    height, width = (size // factor for size in image.shape)
    part = image[: height * factor, : width * factor]
    return np.asarray(part.reshape(height, factor, width, factor).max(axis=(1, 3)))


def _show(axes: Axes, image: Array) -> None:
    """Show the whole image, thinned by block maxima, which keep small targets."""
    height, width = image.shape
    factor = max(1, -(-max(height, width) // MOST_PIXELS))
    small = block_maxima(image, factor)
    extent = (-0.5, small.shape[1] * factor - 0.5, small.shape[0] * factor - 0.5, -0.5)
    axes.imshow(stretched(small), cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="none")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_axis_off()


def _typical(view: CameraView) -> int | None:
    """Return the detection with the most usual size that is clear of the border, or None."""
    found = view.detections
    if len(found) == 0:
        return None
    height, width = view.image.shape
    edge = np.minimum(found.xy_px, (width - 1, height - 1) - found.xy_px).min(axis=1)
    off = np.abs(found.diameter_px - np.median(found.diameter_px)) + np.where(edge < 12, 1e3, 0.0)
    return int(np.argmin(off))


def _show_near(near: Axes, overview: Axes, view: CameraView, chosen: int) -> str:
    """Show one target's pixels with its centroid; return a description in words."""
    xy, diameter = view.detections.xy_px[chosen], float(view.detections.diameter_px[chosen])
    half = int(np.clip(np.ceil(1.1 * diameter) + 2, 6, 24))
    x0, y0 = (int(v) for v in np.round(xy) - half)
    height, width = view.image.shape
    rows, columns = (
        slice(max(y0, 0), min(y0 + 2 * half + 1, height)),
        slice(max(x0, 0), min(x0 + 2 * half + 1, width)),
    )
    part = view.image[rows, columns]
    extent = (columns.start - 0.5, columns.stop - 0.5, rows.stop - 0.5, rows.start - 0.5)
    near.imshow(stretched(part, 0.0), cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="none")
    near.grid(False)
    near.plot(*xy, marker="+", markersize=13, markeredgewidth=1.4, color=CENTROID)
    if view.true_xy_px is not None and len(view.true_xy_px):
        gap = np.linalg.norm(view.true_xy_px - xy, axis=1)
        true = view.true_xy_px[int(np.nanargmin(gap))] if np.isfinite(gap).any() else None
        if true is not None and np.linalg.norm(true - xy) < half:
            near.plot(*true, marker="x", markersize=8, markeredgewidth=1.2, color=TRUTH)
    near.set_xlim(extent[:2])
    near.set_ylim(extent[2:])
    near.set_xlabel("x [px]")
    near.set_ylabel("y [px]", labelpad=1)
    near.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    near.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    overview.add_patch(
        Rectangle((x0 - 0.5, y0 - 0.5), 2 * half + 1, 2 * half + 1, fill=False, edgecolor=ON_IMAGE, linewidth=1.4)
    )
    sigma = np.sqrt(np.maximum(np.diagonal(view.detections.covariance_px2[chosen]), 0.0))
    text = f"one target of {number(diameter)} px, its centroid (+) known to {number(float(sigma.mean()))} px"
    return text + (", × the truth" if view.true_xy_px is not None else "")
