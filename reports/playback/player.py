"""Values for the template of a page's player, and the library that draws it."""

import base64
from typing import Any

import numpy as np
from markupsafe import Markup

from reports.error_tables import Cell, camera_table
from reports.evidence import Evidence
from reports.playback.data import FOUND, Played, images_that_fit, packed
from reports.playback.keeper import VIEW_AT, frame_stride
from reports.units import figure

LIBRARY = "plotly.js (gl3d bundle) 4.1.1"
"""The library that draws space and plots; MIT licence. Its file and its licence are in ``vendor``, unchanged from
npm's plotly.js-gl3d-dist-min."""
SCRIPTS = {"library": "playback/vendor/plotly-gl3d.min.js", "player": "playback/player.js", "sort": "sort.js"}
"""Key in the template -> file of this package."""


def player(evidence: Evidence, shown: Played, limit_mm: float | None) -> dict[str, Any]:
    """Return the values for ``player.html.j2``. ``limit_mm``: limit of the rms error."""
    has_truth, frames = shown.true is not None, len(shown.time_s)
    kept, left_out = images_that_fit(evidence.kept_sets)
    ghosts, rays = any(len(one) for one in shown.ghosts), shown.used is not None
    layers = [
        ("measured", "measured"), ("true", "true") if has_truth else None, ("trail", "path"),
        ("rays", "rays of the marker") if rays else None, ("cameras", "cameras") if evidence.rig.cameras else None,
        ("ghosts", "ghosts") if ghosts else None,
    ]  # fmt: skip
    alt = (
        f"Space with {len(evidence.rig.cameras)} cameras, the working space and {len(shown.names)} "
        f"{'markers' if has_truth else 'tracks'} at the time shown; drag to turn it. The tables hold the figures."
    )
    return {
        "frames": frames,
        "start": round(VIEW_AT * (frames - 1)),
        "kind": "Marker" if has_truth else "Track",
        "names": shown.names,
        "layers": [one for one in layers if one is not None],
        "alt": alt,
        "has_truth": has_truth,
        "note": _note(evidence, frames, has_truth, rays),
        "views": _views(kept),
        "images_note": _images_note(len(kept), left_out),
        "data": Markup(packed(evidence, shown, limit_mm)),  # every < of it is escaped
    }


def camera_cells(evidence: Evidence, shown: Played) -> dict[str, tuple[Cell, ...]]:
    """Return the cells of ``camera_table`` for each camera, over the instants of the page."""
    frame, marker = np.nonzero(shown.state == FOUND)
    used = None if shown.used is None else shown.used[frame, marker]
    return {**camera_table(evidence, marker, shown.frame[frame], used)}


def _note(evidence: Evidence, frames: int, has_truth: bool, rays: bool) -> str:
    total = len(evidence.truth_names) and evidence.truth_xyz is not None and len(evidence.truth_xyz)
    stride = frame_stride(int(total)) if total else 1
    text = "Drag to turn, scroll to come nearer, click a marker to choose it, click a plot to go to its time. "
    if has_truth:
        text += (
            "Dots are measured, their colour is the error (the scale ends above 95 % of "
            "all); grey rings are true. A line ends where there is no "
            "sample: red spans are frames in which the marker could be seen and was not measured, grey spans "
            "those in which fewer than two cameras could see it. "
        )
    else:
        text += "Dots are measured. A line ends where there is no sample (grey spans). "
    if rays:
        text += "Rays join a marker with the cameras that measured it. "
    if stride > 1:
        text += f"Every {_ordinal(stride)} frame is shown; tables and limits are of all frames."
    return text.strip()


def _images_note(kept: int, left_out: int) -> str:
    text = (
        f"Images of {figure(kept)} instants are kept, thinned by block maxima so that small targets stay; the slider "
        "shows the nearest of them, with the time it was taken. Rings are detections. Click an image to enlarge it."
    )
    return text + (f" {figure(left_out)} more instants are left out to keep the page small." if left_out else "")


def _views(kept: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Return the picture of each camera in the page itself: that of the frame set at VIEW_AT of the run."""
    if not kept:
        return []
    names = list(dict.fromkeys(image.camera for one in kept for image in one.images))
    middle = kept[min(round(VIEW_AT * len(kept)), len(kept) - 1)]
    views = []
    for name in names:
        with_it = [one for one in kept if any(image.camera == name for image in one.images)]
        nearest = min(with_it, key=lambda one: abs(one.pulse - middle.pulse))
        image = next(image for image in nearest.images if image.camera == name)
        views.append(
            {
                "camera": name,
                "src": base64.b64encode(image.webp).decode(),
                "size": image.size_px,
                "n": len(image.xy_px),
                "when": f"frame {nearest.pulse}, {len(image.xy_px)} detections",
            }
        )
    return views


def _ordinal(n: int) -> str:
    return {2: "second", 3: "third", 4: "fourth", 5: "fifth"}.get(n, f"{n}th")
