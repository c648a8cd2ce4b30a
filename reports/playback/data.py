"""The numbers of the player, packed for the page: instants, positions, errors, cameras, images.

Positions are in 16-bit steps of the box that encloses them all (0.1 mm in a space of 6 m: finer than a screen shows).
Errors are in 16-bit steps of the largest error. 65535 and -32768 stand for "no sample".
"""

import base64
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from reports.evidence import Evidence, KeptSet
from reports.playback.keeper import frame_stride
from reports.scene import camera_corners

MOST_ITEMS = 200
"""Most markers (without a truth: tracks) in the player: the longest ones."""
IMAGE_BYTES = 1_400_000
"""Most bytes of all images of a page; if they need more, only those of every second, third ... frame set remain."""
NONE_U2, NONE_I2 = 65535, -32768
HIDDEN, MISSED, FOUND = 0, 1, 2
"""State of a marker in a frame: visible to fewer than two cameras; visible to two and not measured; measured."""


@dataclass(frozen=True, eq=False)
class Played:
    """Data of the player: F instants, M markers (or tracks), C cameras."""

    time_s: Array
    """(F,)"""
    frame: Array
    """(F,) row of the truth, or pulse."""
    names: tuple[str, ...]
    """(M,)"""
    measured: Array
    """(F, M, 3) [m], NaN where there is no sample."""
    true: Array | None
    """(F, M, 3) [m]"""
    error: Array | None
    """(F, M, 3) [m], NaN where there is no sample."""
    state: Array
    """(F, M) HIDDEN, MISSED or FOUND."""
    used: Array | None
    """(F, M, C) bool: the camera contributed to the sample."""
    ghosts: tuple[Array, ...]
    """Points (g, 3) of each instant that belong to no marker [m]."""


def played(evidence: Evidence) -> Played | None:
    """Return the data of the player; None where nothing was measured and no truth is known."""
    if evidence.errors is not None and evidence.truth_xyz is not None and len(evidence.truth_names):
        return _with_truth(evidence)
    return _of_tracks(evidence) if len(evidence.tracks) else None


def _with_truth(evidence: Evidence) -> Played:
    errors, truth = evidence.errors, evidence.truth_xyz
    assert errors is not None
    assert truth is not None
    assert evidence.truth_time_ns is not None
    stride = frame_stride(len(truth))
    frames = np.arange(0, len(truth), stride)
    rows = np.flatnonzero(errors.frame % stride == 0)
    at = errors.frame[rows] // stride, errors.marker[rows]
    error = np.full((len(frames), len(evidence.truth_names), 3), np.nan)
    error[at] = errors.error_xyz_m[rows]
    true = np.asarray(truth[frames])
    state = np.full(error.shape[:2], HIDDEN)
    state[evidence.could_be_measured()[frames]] = MISSED
    state[at] = FOUND
    used = None
    if evidence.measured_by is not None and errors.sample is not None:
        used = np.zeros((*error.shape[:2], evidence.measured_by.cameras.shape[1]), bool)
        used[at] = _cameras_of(evidence, errors.sample[rows])
    ghosts = _ghosts(evidence, frames, stride)
    return Played(
        1e-9 * evidence.truth_time_ns[frames],
        frames,
        evidence.truth_names,
        true + error,
        true,
        error,
        state,
        used,
        ghosts,
    )


def _of_tracks(evidence: Evidence) -> Played:
    tracks = evidence.tracks
    numbers, lengths = np.unique(tracks.track, return_counts=True)
    chosen = np.sort(numbers[np.argsort(-lengths, kind="stable")[:MOST_ITEMS]])
    pulses, first = np.unique(tracks.frame, return_index=True)
    every = np.arange(pulses[0], pulses[-1] + 1)
    stride = frame_stride(len(every))
    frames = every[::stride]
    rows = np.flatnonzero(((tracks.frame - frames[0]) % stride == 0) & np.isin(tracks.track, chosen))
    at = (tracks.frame[rows] - frames[0]) // stride, np.searchsorted(chosen, tracks.track[rows])
    measured = np.full((len(frames), len(chosen), 3), np.nan)
    measured[at] = tracks.xyz[rows]
    state = np.where(np.isfinite(measured).all(axis=2), FOUND, HIDDEN)
    label_at = dict(zip(tracks.track.tolist(), tracks.label.tolist(), strict=True))
    names = tuple(f"{label_at[n]} (track {n})" if label_at[n] else f"track {n}" for n in chosen.tolist())
    used = None
    if evidence.measured_by is not None:
        used = np.zeros((*state.shape, evidence.measured_by.cameras.shape[1]), bool)
        used[at] = _cameras_of(evidence, rows)
    time_s = np.interp(frames, pulses, 1e-9 * tracks.time_ns[first])
    return Played(time_s, frames, names, measured, None, None, state, used, tuple(np.empty((0, 3)) for _ in frames))


def _cameras_of(evidence: Evidence, samples: Array) -> Array:
    """Return the cameras (k, C) bool that measured each of ``samples`` (k,): those of the point at its position."""
    table, tracks = evidence.measured_by, evidence.tracks
    assert table is not None
    result = np.zeros((len(samples), table.cameras.shape[1]), bool)
    order = np.argsort(table.frame, kind="stable")
    starts = np.searchsorted(table.frame[order], tracks.frame[samples])
    ends = np.searchsorted(table.frame[order], tracks.frame[samples], side="right")
    for i, (sample, start, end) in enumerate(zip(samples, starts, ends, strict=True)):
        candidates = order[start:end]
        if len(candidates):
            gap = np.linalg.norm(table.xyz[candidates] - tracks.xyz[sample], axis=1)
            if gap.min() < 1e-6:  # the tracker does not change positions
                result[i] = table.cameras[candidates[np.argmin(gap)]]
    return result


def _ghosts(evidence: Evidence, frames: Array, stride: int) -> tuple[Array, ...]:
    """Return the measured points of each instant that belong to no marker."""
    tracks, errors = evidence.tracks, evidence.errors
    if errors is None or errors.sample is None or evidence.truth_time_ns is None:
        return tuple(np.empty((0, 3)) for _ in frames)
    spare = tracks.status == "measured"
    spare[errors.sample] = False
    rows = np.flatnonzero(spare)
    times = np.asarray(evidence.truth_time_ns)
    middles = (times[1:] + times[:-1]) / 2
    at = np.searchsorted(middles, tracks.time_ns[rows])
    return tuple(tracks.xyz[rows[at == f]] for f in frames)


def packed(evidence: Evidence, shown: Played, limit_mm: float | None) -> str:
    """Return the player's data as JSON that can stand in a script element."""
    rig, space = evidence.rig, evidence.working_space_size
    corners = [camera_corners(camera, 0.22 * float(space.max())) for camera in rig.cameras]
    positions = np.array([c.world_from_camera.translation for c in rig.cameras]).reshape(-1, 3)
    everything = [shown.measured.reshape(-1, 3), *shown.ghosts]
    if shown.true is not None:
        everything.append(shown.true.reshape(-1, 3))
    finite = np.concatenate(everything)
    finite = finite[np.isfinite(finite).all(axis=1)]
    box = np.array([evidence.working_space_center - space / 2, evidence.working_space_center + space / 2])
    low, high = np.vstack([box, finite]).min(axis=0), np.vstack([box, finite]).max(axis=0)
    step = np.maximum(high - low, 1e-9) / (NONE_U2 - 1)
    counts = np.array([len(g) for g in shown.ghosts])
    document: dict[str, Any] = {
        "frames": len(shown.time_s),
        "first": first_item(shown),
        "names": shown.names,
        "cameras": [
            {"name": c.name, "at": _short(p), "corners": _short(k)}
            for c, p, k in zip(rig.cameras, positions, corners, strict=True)
        ],
        "box": _short(box),
        "low": low.tolist(),
        "step": step.tolist(),
        "limit_mm": limit_mm,
        "time": _array(shown.time_s, "<f4"),
        "measured": _array(_steps(shown.measured, low, step), "<u2"),
        "true": None if shown.true is None else _array(_steps(shown.true, low, step), "<u2"),
        "state": _array(shown.state, "u1"),
        "used": None if shown.used is None else _array(np.packbits(shown.used, axis=2, bitorder="little"), "u1"),
        "ghost_counts": _array(counts, "<u2"),
        "ghosts": _array(_steps(np.concatenate([np.empty((0, 3)), *shown.ghosts]), low, step), "<u2"),
        **_errors(shown),
        **_images(evidence, shown),
    }
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c")


def first_item(shown: Played) -> int:
    """Return the marker that is shown first: the one with the largest rms error, else the most complete one."""
    if shown.error is None or not np.isfinite(shown.error).any():
        return int(np.argmax((shown.state == FOUND).sum(axis=0)))
    squares = (shown.error**2).sum(axis=2)
    found = np.isfinite(squares)
    mean = np.where(found, squares, 0.0).sum(axis=0) / np.maximum(found.sum(axis=0), 1)
    return int(np.argmax(mean))


def _errors(shown: Played) -> dict[str, Any]:
    if shown.error is None:
        return {"error": None, "error_step_mm": 0.0, "rms_mm": None}
    largest = float(np.nanmax(np.abs(shown.error), initial=0.0))
    step = max(largest, 1e-12) / 32000
    error = np.where(np.isfinite(shown.error), np.round(shown.error / step), NONE_I2)
    found = np.isfinite(shown.error).all(axis=2)
    squares = np.where(found, np.nansum(shown.error**2, axis=2), 0.0).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms_mm = 1e3 * np.sqrt(squares / found.sum(axis=1))
    return {"error": _array(error, "<i2"), "error_step_mm": 1e3 * step, "rms_mm": _array(rms_mm, "<f4")}


def _images(evidence: Evidence, shown: Played) -> dict[str, Any]:
    """Return the kept frame sets at their instants of the page, with detections in 1/16 px."""
    kept, left_out = images_that_fit(evidence.kept_sets)
    first = int(shown.frame[0])
    stride = int(shown.frame[1] - first) if len(shown.frame) > 1 else 1
    sets = [
        {
            "at": int(np.clip(round((one.pulse - first) / stride), 0, len(shown.frame) - 1)),
            "pulse": one.pulse,
            "images": {
                image.camera: {
                    "src": base64.b64encode(image.webp).decode(),
                    "size": image.size_px,
                    "xy": _array(np.clip(np.round(16 * (image.xy_px + 0.5)), 0, NONE_U2), "<u2"),
                    "d": _array(np.clip(np.round(16 * image.diameter_px), 0, NONE_U2), "<u2"),
                }
                for image in one.images
            },
        }
        for one in kept
    ]
    return {"sets": sets, "sets_left_out": left_out}


def images_that_fit(sets: tuple[KeptSet, ...]) -> tuple[tuple[KeptSet, ...], int]:
    """Return every n-th of ``sets``, with n as small as ``IMAGE_BYTES`` allows, and the number of sets left out."""
    for n in range(1, len(sets) + 1):
        kept = sets[::n]
        if sum(len(image.webp) for one in kept for image in one.images) <= IMAGE_BYTES:
            return kept, len(sets) - len(kept)
    return (), len(sets)


def _steps(xyz: Array, low: Array, step: Array) -> Array:
    result: Array = np.where(np.isfinite(xyz), np.round((xyz - low) / step), NONE_U2)
    return result


def _array(values: Array, dtype: str) -> str:
    """Return ``values`` as base64 of little-endian ``dtype``, in C order."""
    return base64.b64encode(np.ascontiguousarray(np.asarray(values).astype(dtype)).tobytes()).decode()


def _short(values: Array) -> list[Any]:
    """Return coordinates [m] rounded to a tenth of a millimetre."""
    result: list[Any] = np.round(np.asarray(values, float), 4).tolist()
    return result
