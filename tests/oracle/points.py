"""What the pipeline makes of a recording whose points and bounds are known."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

import mosca
from mosca.data.settings import MatchSettings
from mosca.pipeline import PipelineSettings


class PointFigures(NamedTuple):
    """Of points that stand alone in two cameras or more."""

    complete: float
    """Share that is found."""
    ratio: float
    """Rms over the Cramer-Rao bound."""
    nees: float
    """Mean of the squared errors over the stated covariance; 3 is expected."""
    within: float
    """Share within the stated ellipsoid of 95 %."""
    rms_m: float
    """Rms of the distance [m]."""


def point_figures(
    folder: Path, values: dict[str, Any], lookahead: int = PipelineSettings().lookahead, **match: Any
) -> PointFigures:
    """Return the figures of a recording by ``mosca reconstruct`` with the true rig beside it.

    ``values``: ``bound_m2``, ``time_ns``, ``diameter_m`` and ``mean_xyz`` as in ``witness.npz``.
    """
    settings = PipelineSettings(match=MatchSettings(**match), lookahead=lookahead)
    tracks = mosca.reconstruct(folder, mosca.read_rig(folder / "rig.toml"), settings)
    alone = np.isfinite(values["bound_m2"][:, :, 0, 0])
    frame = np.searchsorted(values["time_ns"], tracks.time_ns - 500_000)
    radius = values["diameter_m"].max() / 2
    found, error2, nees = 0, [], []
    for f, point in np.argwhere(alone):
        here = tracks.select(frame == f)
        off = here.xyz - values["mean_xyz"][f, point]
        distance = np.linalg.norm(off, axis=1)
        if distance.min(initial=np.inf) < radius:
            k = distance.argmin()
            found += 1
            error2.append(distance[k] ** 2)
            nees.append(off[k] @ np.linalg.solve(here.covariance[k], off[k]))
    bound2 = np.trace(values["bound_m2"][alone], axis1=1, axis2=2).mean()
    within = np.mean(np.array(nees) < chi2.ppf(0.95, 3))
    rms_m = float(np.sqrt(np.mean(error2)))
    return PointFigures(
        float(found / alone.sum()), float(rms_m / np.sqrt(bound2)), float(np.mean(nees)), float(within), rms_m
    )
