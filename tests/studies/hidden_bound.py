"""How near a person's markers come to what their images tell, by how many of these are whole.

The bound of a sample: the information of all images of the marker, each with the least covariance that its pixels
allow, the shake of its camera's body and the jitter of its trigger; the covariance of the run's own calibration is
added. Of an image that a straight edge cuts the least covariance is that of a disc of known radius and blur whose
centre, brightness, background, edge and the edge's direction are unknown (Cramer and Rao; the image on a fine grid,
blurred by scipy, its derivatives by differences), averaged over directions. Images of which less than ``LEAST_SEEN``
is visible tell nothing; samples with fewer than two others are left out. That targets lie before one another is
neglected: the bound is that of an estimator that finds them all.

    python -m tests.studies.hidden_bound actor --seconds 4
"""

import argparse
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from mosca.camera.projection import project
from scenarios.run.library import run_scenario
from scenarios.run.scenario import RunResult
from scenarios.score.tracks import pair
from scenarios.types import TruthPairs

LIGHT_E, READ_E, BLUR_PX = 12_000.0, 10.0, 0.67
"""Of the actor scenarios' images: electrons of a pixel inside a marker, read noise, blur with a pixel's width."""
FINE, SIDE, STEP = 12, 13, 0.05
LEAST_SEEN, WHOLE = 0.02, 0.99
HIDDEN = np.array([0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95])


def share_hidden(edge: float) -> float:
    """Return the share of a disc beyond an edge that lies ``edge`` radii from its centre."""
    return float((np.arccos(edge) - edge * np.sqrt(1.0 - edge * edge)) / np.pi)


def image(x: float, y: float, radius: float, edge: float, turn: float) -> np.ndarray:
    """Return the light (SIDE, SIDE) [e-] of a disc at (x, y), less what is beyond an edge [px] from the middle."""
    at = (np.arange(SIDE * FINE) + 0.5) / FINE - SIDE / 2
    u, v = np.meshgrid(at, at)
    shape = np.clip((radius - np.hypot(u - x, v - y)) * FINE + 0.5, 0.0, 1.0)
    shape *= np.clip((edge - u * np.cos(turn) - v * np.sin(turn)) * FINE + 0.5, 0.0, 1.0)
    blurred = gaussian_filter(shape, np.sqrt(BLUR_PX**2 - 1 / 12) * FINE, truncate=5.0)
    return LIGHT_E * blurred.reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3))


def least_variance_px2(radius: float, hidden: float) -> float:
    """Return the least variance an axis [px^2], mean of both, of a centre of whose disc a share is hidden."""
    at = (0.13, -0.2, radius, SIDE, 0.3)
    if hidden > 0.0:
        edge = radius * brentq(lambda c: share_hidden(c) - hidden, -1 + 1e-9, 1 - 1e-9)
        at = (*at[:3], edge + at[0] * np.cos(at[4]) + at[1] * np.sin(at[4]), at[4])
    light = image(*at)
    by = [light / LIGHT_E, np.ones_like(light)]
    for k in (0, 1, 3, 4) if hidden > 0.0 else (0, 1):
        more, less = list(at), list(at)
        more[k], less[k] = at[k] + STEP, at[k] - STEP
        by.append((image(*more) - image(*less)) / (2 * STEP))
    columns = np.array(by).reshape(len(by), -1)
    information = (columns / (READ_E**2 + light.ravel())) @ columns.T
    return float(np.trace(np.linalg.inv(information)[2:4, 2:4]) / 2)


@dataclass(frozen=True)
class Held:
    """Samples beside their bounds (n,)."""

    error_m: np.ndarray
    bound_m: np.ndarray
    """Root of the trace of the least covariance."""
    whole: np.ndarray
    """Number of whole images."""


def held(run: RunResult, edge_m: float, body_px: float, jitter_s: float) -> Held:
    """Return the errors of a run's samples and their bounds."""
    assert run.calibration is not None
    assert run.truth is not None
    truth, rig = run.truth, run.calibration.calibration.rig
    matched: TruthPairs = pair(run.tracks, truth, edge_m)
    of = (matched.frame, matched.marker)
    xyz = truth.xyz[of]
    radius = float(np.nanmedian(truth.diameter_px)) / 2
    table = np.array([least_variance_px2(radius, hidden) for hidden in HIDDEN])
    information, whole, views = np.zeros((len(xyz), 3, 3)), np.zeros(len(xyz), int), np.zeros(len(xyz), int)
    speed = np.gradient(truth.xyz, truth.time_ns * 1e-9, axis=0)[of]
    for c, name in enumerate(truth.cameras):
        camera, visible = rig.camera(name), truth.visible[(*of, c)]
        seen = visible > LEAST_SEEN
        whole += visible >= WHOLE
        by = np.stack(
            [(project(camera, xyz + d) - project(camera, xyz - d)) / 2e-4 for d in 1e-4 * np.eye(3)], axis=2
        )
        moved = np.einsum("nij,nj->ni", by, speed) * jitter_s
        own = np.interp(1.0 - visible, HIDDEN, table) + body_px**2
        s = own[:, None, None] * np.eye(2) + moved[:, :, None] * moved[:, None, :]
        told = np.einsum("nki,nkl,nlj->nij", by, np.linalg.inv(s), by)
        information[seen] += told[seen]
        views += seen
    two = views >= 2
    least = np.linalg.inv(information[two]) + run.calibration.covariance_m2(xyz[two])
    return Held(matched.distance_m[two], np.sqrt(np.trace(least, axis1=1, axis2=2)), whole[two])


def table(found: Held) -> str:
    """Return a table by the number of whole images."""
    lines = [
        "| whole images | share of samples | share of the mean square | measured rms | bound | ratio | largest |",
        "|---|---|---|---|---|---|---|",
    ]
    total = float((found.error_m**2).sum())
    chosen = [
        ("0", found.whole == 0),
        ("1", found.whole == 1),
        ("2", found.whole == 2),
        ("3 and more", found.whole > 2),
    ]
    for name, rows in (*chosen, ("all", found.whole >= 0)):
        if rows.any():
            measured = float(np.sqrt((found.error_m[rows] ** 2).mean())) * 1e3
            bound = float(np.sqrt((found.bound_m[rows] ** 2).mean())) * 1e3
            squares = (found.error_m[rows] ** 2).sum() / total
            lines.append(
                f"| {name} | {rows.mean():.4f} | {squares:.3f} | {measured:.3f} mm | {bound:.3f} mm | "
                f"{measured / bound:.2f} | {found.error_m[rows].max() * 1e3:.1f} mm |"
            )
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("scenario")
    parser.add_argument("--seconds", type=float, default=4.0)
    given = parser.parse_args()
    run = run_scenario(given.scenario, {"capture.duration_s": given.seconds})
    print(table(held(run, 2.5, 0.03, 20e-6)))


if __name__ == "__main__":
    main()
