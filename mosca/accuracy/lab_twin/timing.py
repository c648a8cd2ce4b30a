"""Trigger jitter, delays between cameras and rolling shutters, from sums over frame sets of moving targets.

The model is a linear mixed model: delays and row times are the same in all frame sets; trigger jitter and body shake
are random in each. The variances are estimated by maximum likelihood with Fisher scoring (Harville, Journal of the
American Statistical Association 72 (1977) 320). Their standard deviations follow from the expected information. A
delay that all cameras share cannot be observed: delays are relative to their mean.
"""

from dataclasses import dataclass

import numpy as np

from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate, Told, root
from mosca.accuracy.lab_twin.moving_targets import SCALES, MovingTargets, TimingSums, frame_sums
from mosca.data.arrays import Array

KEYS = ("errors.trigger_jitter_s", "timing.delay_s", "timing.row_time_s")
FEWEST_SETS = 30
MOST_SIGMA_S = 1e-3
"""Standard deviation of a delay from which the targets moved too slowly to estimate it."""
ROUNDS = 60
SURE = 4.0
"""Standard deviations from which a rolling shutter is stated."""


@dataclass(frozen=True, eq=False)
class MixedModel:
    """Variances and fixed effects, in seconds and pixels; c cameras."""

    jitter: tuple[Array, Array]
    """Variances (c,) [s^2] and their standard deviations."""
    shake: tuple[Array, Array]
    """Variances an axis (c,) [px^2] and their standard deviations."""
    delay: tuple[Array, Array]
    """(c,) [s] about their mean, and their standard deviations."""
    row_time: tuple[Array, Array]
    """(c,) [s] and their standard deviations."""


def timing_estimates(seen: MovingTargets | None, names: tuple[str, ...]) -> list[Told]:
    """Return jitter, delay and row time of each camera, or what is missing to estimate them."""
    sets = 0 if seen is None else int(seen.set_of[-1]) + 1
    if seen is None or sets < FEWEST_SETS:
        why = f"needs {FEWEST_SETS} frame sets or more of moving targets that several cameras see: moving:FOLDER"
        return [NotTold(name, key, why) for name in names for key in KEYS]
    found = fit_mixed_model(frame_sums(seen))
    stated = seen.stated_s - seen.stated_s.mean()
    images = (seen.weight[:, :, 0, 0] > 0.0).sum(axis=0)
    told: list[Told] = []
    for k, name in enumerate(names):
        what = f"{images[k]} images of moving targets in {sets} frame sets"
        if not found.delay[1][k] < MOST_SIGMA_S:
            why = "needs targets that move faster, several at once: moving:FOLDER"
            told += [NotTold(name, key, why) for key in KEYS]
            continue
        told.append(ParameterEstimate(name, KEYS[0], *root(found.jitter[0][k], found.jitter[1][k]), what))
        delay = float(found.delay[0][k] - stated[k])
        told.append(ParameterEstimate(name, KEYS[1], delay, float(found.delay[1][k]), f"{what}; against their mean"))
        told.append(_row_time(name, seen, found, k, what))
    return told


def _row_time(name: str, seen: MovingTargets, found: MixedModel, k: int, what: str) -> Told:
    value, sigma, says = float(found.row_time[0][k]), float(found.row_time[1][k]), float(seen.stated_row_s[k])
    if says > 0.0:
        what = f"{what}; the camera says {1e6 * says:.4g} us"
    if value < SURE * sigma and says == 0.0:
        return ParameterEstimate(name, KEYS[2], 0.0, sigma, f"{what}; found {1e6 * value:.2g} us: global")
    return ParameterEstimate(name, KEYS[2], max(value, 0.0), sigma, what)


def fit_mixed_model(sums: TimingSums) -> MixedModel:
    """Fit variances and fixed effects to the sums of frame sets."""
    size = sums.normal.shape[1]
    c = size // 4
    values, vectors = np.linalg.eigh(sums.normal)
    seen = values > 1e-9 * values[:, -1:]
    roots = np.sqrt(np.where(seen, values, 0.0))
    # h: rows of H; y: whitened data, y = H (fixed + random) + white noise of variance 1
    h = roots[:, :, None] * np.swapaxes(vectors, 1, 2)
    y = np.where(seen, np.einsum("fji,fj->fi", vectors, sums.right) / np.where(seen, roots, 1.0), 0.0)
    groups = [[k] for k in range(c)] + [[c + k, 2 * c + k] for k in range(c)]
    kernels = np.stack([np.einsum("fij,fkj->fik", h[:, :, g], h[:, :, g]) for g in groups])
    variance = np.ones(len(groups))
    fixed, covariance = np.zeros(size), np.eye(size)
    information = np.eye(len(groups))
    for _ in range(ROUNDS):
        inverse = np.linalg.inv(np.eye(size) + np.einsum("g,gfij->fij", variance, kernels))
        weighted = np.einsum("fij,fjk->fik", inverse, h)
        covariance = np.linalg.pinv(np.einsum("fji,fjk->ik", h, weighted), rcond=1e-10, hermitian=True)
        fixed = covariance @ np.einsum("fji,fj->i", weighted, y)
        rest = np.einsum("fij,fj->fi", inverse, y - h @ fixed)
        # the fixed effects take few degrees of freedom of all frame sets together: neglected
        scaled = np.einsum("fij,gfjk->gfik", inverse, kernels)
        gradient = 0.5 * (np.einsum("fi,gfij,fj->g", rest, kernels, rest) - np.einsum("gfii->g", scaled))
        information = 0.5 * np.einsum("gfij,hfji->gh", scaled, scaled)
        change = np.linalg.solve(information, gradient)
        new = np.maximum(variance + change, 1e-9)
        if np.all(np.abs(new - variance) < 1e-6 * (variance + 1e-3)):
            break
        variance = new
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    own = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    time, shift, row = SCALES[0], SCALES[1], SCALES[3]
    delay = time * fixed[:c]
    return MixedModel(
        (time**2 * variance[:c], time**2 * sigma[:c]),
        (shift**2 * variance[c:], shift**2 * sigma[c:]),
        (delay - delay.mean(), time * own[:c]),
        (row * fixed[3 * c :], row * own[3 * c :]),
    )
