"""The predicted standard deviation over the volume, from above."""

from typing import Any

import numpy as np

from mosca.accuracy.planning.obstacles import distances_to
from scenarios.studies.plan.plan import Plan, predicted_of
from scenarios.studies.plan.room import bounding_box, inside_polygon, options_of, room_of

CELLS, HEIGHTS = 20, 3


def predicted_map(plan: Plan) -> dict[str, Any]:
    """Return positions ``x_m`` and ``y_m``, ``sigma_m`` (y, x), the wanted quantile over heights and directions
    there, and which are ``inside`` the volume; None outside, and where fewer markers are seen.
    """
    spec, best = plan.spec, plan.best
    center, size = bounding_box(spec)
    middles = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    x, y = center[0] + size[0] * middles, center[1] + size[1] * middles
    heights = center[2] + size[2] * ((np.arange(HEIGHTS) + 0.5) / HEIGHTS - 0.5)
    points = np.stack(np.meshgrid(y, x, heights, indexing="ij"), axis=-1)[..., [1, 0, 2]].reshape(-1, 3)
    room = room_of(spec, points)
    inside = distances_to(room.obstacles, points) > 0
    if spec.volume.corners_m is not None:
        inside &= inside_polygon(np.array(spec.volume.corners_m), points[:, :2])
    rows = best.layout.rows(plan.mounts, np.array([one.row for one in options_of(spec)]))
    sigma = predicted_of(spec, best.rig, rows, room).sigma_m.reshape(CELLS, CELLS, -1)
    share = np.quantile(sigma, spec.goal.quantile, axis=2, method="higher")
    there = inside.reshape(CELLS, CELLS, HEIGHTS).any(axis=2)
    shown = there & np.isfinite(share)
    return {
        "x_m": x.tolist(),
        "y_m": y.tolist(),
        "sigma_m": [
            [float(v) if ok else None for v, ok in zip(*row, strict=True)] for row in zip(share, shown, strict=True)
        ],
        "inside": there.tolist(),
    }
