"""Samples of several zones as one set: those of one target in two zones are fused by their covariances."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.stitching.association import Group


def shifted(tracks: Tracks, by_m: Array) -> Tracks:
    """Return ``tracks`` moved by ``by_m`` (3,)."""
    return replace(tracks, xyz=tracks.xyz + by_m)


def merged(zones: Mapping[str, Tracks], groups: Sequence[Group], gate_sigma: float) -> tuple[Tracks, int, int]:
    """Return one set of tracks, numbered as ``groups``; how many samples were merged, and how many did not fit.

    Samples of one target and instant are replaced by their mean, weighted by inverse covariances; its covariance is
    the inverse of the weights' sum. Measured samples take precedence over filled ones. Where two differ by more than
    twice ``gate_sigma`` standard deviations only the one with less variance is kept. Camera counts add up; residuals
    are the cameras' rms.
    """
    number = {key: k for k, group in enumerate(groups) for key in group}
    parts = []
    for name, tracks in zones.items():
        target = np.array([number[name, int(k)] for k in tracks.track], dtype=np.int64)
        columns = {column: getattr(tracks, column) for column in Tracks.__dataclass_fields__}
        parts.append(columns | {"track": target})
    all_of = {column: np.concatenate([p[column] for p in parts]) for column in Tracks.__dataclass_fields__}
    later = all_of["status"] != "measured"
    order = np.lexsort((later, all_of["track"], all_of["frame"]))
    rows = {column: values[order] for column, values in all_of.items()}
    start = np.ones(len(order), bool)
    start[1:] = (np.diff(rows["frame"]) != 0) | (np.diff(rows["track"]) != 0)
    firsts = np.flatnonzero(start)
    sizes = np.diff([*firsts, len(order)])
    kept = {column: values[firsts].copy() for column, values in rows.items()}
    doubled = torn = 0
    for k in np.flatnonzero(sizes > 1).tolist():
        of = np.arange(firsts[k], firsts[k] + sizes[k])
        of = of[rows["status"][of] == rows["status"][of[0]]]
        if len(of) == 1:
            continue
        place, spread, used = _weighted(rows["xyz"][of], rows["covariance"][of], gate_sigma)
        doubled += len(used) > 1
        torn += len(used) == 1
        cameras = rows["n_cameras"][of[used]]
        squares = rows["residual_px"][of[used]] ** 2
        kept["xyz"][k], kept["covariance"][k] = place, spread
        kept["n_cameras"][k] = cameras.sum()
        kept["residual_px"][k] = np.sqrt(np.average(squares, weights=np.maximum(cameras, 1)))
        kept["time_ns"][k] = rows["time_ns"][of[used[0]]]
    kept["label"] = _labels(kept)
    return Tracks(**kept), doubled, torn


def _weighted(xyz: Array, covariance: Array, gate_sigma: float) -> tuple[Array, Array, Array]:
    """Return mean, covariance and the samples (n, 3) used: all, or that of least variance where they disagree."""
    surest = int(np.trace(covariance, axis1=1, axis2=2).argmin())
    for k in range(len(xyz)):
        away = xyz[k] - xyz[surest]
        if k != surest and away @ np.linalg.solve(covariance[k] + covariance[surest], away) > (2.0 * gate_sigma) ** 2:
            return xyz[surest], covariance[surest], np.array([surest])
    weights = np.linalg.inv(covariance)
    spread = np.linalg.inv(weights.sum(axis=0))
    place = spread @ (weights @ xyz[:, :, None]).sum(axis=0)[:, 0]
    return place, 0.5 * (spread + spread.T), np.arange(len(xyz))


def _labels(columns: Mapping[str, Array]) -> Array:
    """Return each target's label on all its samples, where any has one."""
    named = columns["label"] != ""
    label_of = dict(zip(columns["track"][named].tolist(), columns["label"][named].tolist(), strict=True))
    labels = [
        own or label_of.get(k, "")
        for k, own in zip(columns["track"].tolist(), columns["label"].tolist(), strict=True)
    ]
    return np.array(labels, dtype=np.str_)
