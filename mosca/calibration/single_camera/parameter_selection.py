"""Selection of the lens parameters that the data determine.

Pose and scale (c and my, or fx and fy) are always estimated. The principal point, the affinity a, K1, (P1, P2), K2,
K3 (or k1, (p1, p2), k2, k3, ...) join group by group: each time the group that lowers the sum of squares most
significantly (F-test), until none does. A parameter left out stays at zero, the principal point in the middle of the
image. So weak terms cannot become large where there are no points. Mosca's P1 and P2 come last, and only where the
others do not imitate them. OpenCV's thin prism s1-s4 models the effect of a slanting window or water surface.
Mosca's mx is always held: c, mx and my have two degrees of freedom.
"""

from collections.abc import Iterable, Sequence
from dataclasses import fields

import numpy as np

from mosca.calibration.single_camera.least_squares import ROUGHLY_CONVERGED, CameraFit, fit_camera, linearised
from mosca.calibration.single_camera.outliers import LEAST_REDUNDANCY, ROUNDING_PX
from mosca.data.arrays import Array
from mosca.data.distributions import f as f_distribution
from mosca.data.rig import LENS_MODELS, Camera

Group = tuple[str, ...]

SCALE = {"mosca": ("c_mm", "my_mm_per_px"), "opencv": ("fx_px", "fy_px"), "fisheye": ("fx_px", "fy_px")}
PRISM = ("s1", "s2", "s3", "s4")
# groups of lens parameters that may join, in the order in which they become available: a radial term
# becomes available after the next lower one
GROUPS: dict[str, tuple[tuple[str, ...], ...]] = {
    "mosca": (
        ("xp_px", "yp_px"),
        ("a",),
        ("K1_per_mm2",),
        ("P1_per_mm", "P2_per_mm"),
        ("K2_per_mm4",),
        ("K3_per_mm6",),
    ),
    "opencv": (("cx_px", "cy_px"), ("k1",), ("p1", "p2"), ("k2",), ("k3",), PRISM),
    "fisheye": (("cx_px", "cy_px"), ("k1",), ("k2",), ("k3",), ("k4",)),
}
LOWER = {
    "mosca": {"K2_per_mm4": "K1_per_mm2", "K3_per_mm6": "K2_per_mm4"},
    "opencv": {"k2": "k1", "k3": "k2"},
    "fisheye": {"k2": "k1", "k3": "k2", "k4": "k3"},
}
DECENTRING = ("P1_per_mm", "P2_per_mm")
COMPETING = (("xp_px", "yp_px"), ("a",))
LARGEST_INFLATION = 100.0
"""Variance inflation above which parameters are not separable (10 is called high, Belsley et al. 1980)."""


def groups_of(model: str, prism: bool = True) -> tuple[Group, ...]:
    """Return the groups of a model's lens parameters that may join; without the thin prism unless ``prism``."""
    return tuple(group for group in GROUPS[model] if prism or group != PRISM)


def nested_parameters(model: str, n_points: int, groups: Sequence[Group]) -> list[Group]:
    """Return nested sets of free parameters, from the simplest to the richest that so many points allow."""
    sets = [_free(model, groups[:k]) for k in range(len(groups) + 1)]
    return [free for free in sets if 6 + len(free) <= n_points] or sets[:1]


def choose_parameters(
    start: Camera, xy_px: Array, xyz: Array, significance: float, groups: Sequence[Group]
) -> tuple[CameraFit, tuple[tuple[str, float], ...]]:
    """Fit a camera to pixels (n, 2) of points (n, 3) [m] with those ``groups`` of parameters that these determine.

    ``significance``: level of the F-test. Also returns the groups that joined, in order, and their p-values.
    """
    fit = fit_camera(start, _free(start.lens.model, ()), xy_px, xyz)
    chosen: list[tuple[Group, float]] = []
    for decentring in (False, True):
        while True:
            joined = [group for group, _ in chosen]
            open_groups = [g for g in groups if g not in joined and (decentring or g != DECENTRING)]
            best = _best_group(fit, joined, open_groups, xy_px, xyz)
            if best is None or best[0] >= significance:
                break
            fit = best[2]
            chosen.append((best[1], best[0]))
    fit = fit_camera(fit.camera, fit.free, xy_px, xyz)
    return fit, tuple((", ".join(group), p_value) for group, p_value in chosen)


def _best_group(
    fit: CameraFit, joined: list[Group], open_groups: list[Group], xy: Array, world: Array
) -> tuple[float, Group, CameraFit] | None:
    """Return p-value, group and fit of the open group that lowers the sum of squares most significantly."""
    model = fit.camera.lens.model
    trials = []
    for group in open_groups:
        lower = LOWER[model].get(group[0])
        if lower is not None and (lower,) not in joined:
            continue
        if group == DECENTRING and _imitated(fit.camera, xy, world):
            continue
        trial = fit_camera(fit.camera, _free(model, [*joined, group]), xy, world, tolerance=ROUGHLY_CONVERGED)
        redundancy = 2 * len(xy) - len(trial.parameters)
        if trial.cofactors is None or redundancy < LEAST_REDUNDANCY:
            continue
        gain = (fit.cost - trial.cost) / len(group)
        noise = max(trial.cost, 2 * len(xy) * ROUNDING_PX**2) / redundancy
        p_value = float(f_distribution.sf(gain / noise, len(group), redundancy))
        trials.append((p_value, -gain, group, trial))
    if not trials:
        return None
    # the p-values of strong terms all underflow to zero; then the larger gain decides
    p_value, _, group, trial = min(trials, key=lambda t: t[:2])
    return p_value, group, trial


def _free(model: str, groups: Iterable[Group]) -> Group:
    wanted = set(SCALE[model]).union(*groups)
    return tuple(f.name for f in fields(LENS_MODELS[model]) if f.name in wanted)


def _imitated(camera: Camera, xy: Array, world: Array) -> bool:
    """Return whether principal point, affinity, scale and pose imitate Mosca's P1 and P2 in the volume measured.

    Criterion: variance inflation, the ratio of a parameter's variance to what it would be if all others were known.
    Through a wide lens over a deep target it is 4 to 10 for P1 and P2; through a long lens over a shallow target
    250 to 2,300 (measured on MyPTV's example), and with them points outside the target are predicted
    worse. OpenCV's model has no affinity, so that p1 and p2 may take its part.
    """
    free = _free(camera.lens.model, [*COMPETING, DECENTRING])
    design = linearised(camera, free, xy, world)[1].reshape(2 * len(xy), -1)
    if len(design) < design.shape[1]:
        return True
    triangular = np.linalg.qr(design / np.linalg.norm(design, axis=0), mode="r")
    singular = np.linalg.svd(triangular, compute_uv=False)
    if singular[-1] < 1e-9 * singular[0]:
        return True
    inflation = (np.linalg.inv(triangular) ** 2).sum(axis=1)[-len(DECENTRING) :]
    return bool(inflation.max() > LARGEST_INFLATION)
