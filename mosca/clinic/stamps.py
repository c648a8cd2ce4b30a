"""Causes that stamps and frame numbers show: arrival stamps, and frames lost without a gap in the numbers."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from mosca.clinic.causes import Diagnosis, merged
from mosca.clinic.misfit import Residuals
from mosca.data.arrays import Array
from mosca.data.distributions import f as f_distribution
from mosca.data.frames import Frame, FrameSource, WrappedSource, mid_exposure_ns
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.diagnostics.camera_health import HealthSettings

CERTAIN_S = HealthSettings().late_s
"""Stamps that scatter by less than this are taken for stamps of the exposures."""
ROUNDED_NS = (1_000_000, 10_000_000)
"""Steps to which files round stamps."""
FACTOR = 3.0
"""Largest ratio of the stamps' scatter to the exposures' scatter, which is estimated from the motion."""


@dataclass
class StampWitness:
    """Numbers and stamps of each camera's frames, as read."""

    numbers: dict[str, list[int]] = field(default_factory=dict)
    times_ns: dict[str, list[int]] = field(default_factory=dict)
    row_time_ns: dict[str, int] = field(default_factory=dict)

    def take(self, frame: Frame) -> None:
        """Keep a frame's number and stamp."""
        if frame.status == "ok":
            self.numbers.setdefault(frame.camera, []).append(frame.index)
            self.times_ns.setdefault(frame.camera, []).append(mid_exposure_ns(frame))
            self.row_time_ns[frame.camera] = frame.row_time_ns


class WitnessedSource(WrappedSource):
    """A source whose frames' numbers and stamps are kept as they are read."""

    def __init__(self, source: FrameSource, witness: StampWitness) -> None:
        super().__init__(source)
        self._witness = witness

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._source:
            self._witness.take(frame)
            yield frame


def stamp_causes(
    witness: StampWitness, residuals: Residuals | None, period_s: float, alpha: float
) -> list[Diagnosis]:
    """Return the faults that stamps and frame numbers show."""
    found = []
    for k, (name, times) in enumerate(witness.times_ns.items()):
        number, t = np.array(witness.numbers[name], float), 1e-9 * (np.array(times, float) - times[0])
        if len(t) < 20:
            continue
        one = _gaps(number, t, period_s, f"camera '{name}'")
        if one is None:
            motion = exposure_scatter(residuals, k) if residuals is not None else None
            one = _scattered(number, t, motion, alpha, f"camera '{name}'", "the motion in its images")
        found += [] if one is None else [replace(one, camera=name)]
    return merged(found)


def track_stamp_causes(tracks: Tracks, alpha: float) -> list[Diagnosis]:
    """Return the faults that stamps and frame numbers of tracks show, as a client records them from a stream.

    The stamps of a file are no more certain than the step to which the file rounds them.
    """
    tracks = tracks.select(tracks.status == "measured")
    frame, first = np.unique(tracks.frame, return_index=True)
    period_s = tracks.frame_period_s
    if len(frame) < 20 or not period_s or period_s <= 0:
        return []
    t = 1e-9 * (tracks.time_ns[first] - tracks.time_ns[first[0]])
    one = _gaps(frame.astype(float), t, period_s, "tracks")
    if one is None:
        motion = _sampling_scatter(tracks, period_s)
        rounded = max((step for step in ROUNDED_NS if not (tracks.time_ns[first] % step).any()), default=0)
        one = _scattered(frame.astype(float), t, motion, alpha, "tracks", "their motion", 1e-9 * rounded)
    return [] if one is None else [one]


def _gaps(number: Array, t: Array, period_s: float, whose: str) -> Diagnosis | None:
    """Return a diagnosis where stamps ``t`` (n,) [s] have gaps that the frame numbers (n,) do not show."""
    steps, counted = np.diff(t) / period_s, np.diff(number)
    gaps = np.flatnonzero((np.round(steps - counted) >= 1) & (steps > 1.5) & (np.abs(steps - np.round(steps)) < 0.25))
    regular = float(np.median(np.abs(steps - np.round(steps))))
    if not len(gaps) or regular >= 0.05:
        return None
    text = (
        f"{whose}: {len(gaps)} gap(s) in the stamps without one in the frame numbers, the first of "
        f"{steps[gaps[0]]:.0f} periods after frame {int(number[gaps[0]])}"
    )
    return Diagnosis("dropped-unnoticed", 1e-12, (text,), figures={"gaps": len(gaps)})


def _scattered(
    number: Array, t: Array, motion: tuple[float, int] | None, alpha: float, whose: str, what: str,
    certain_s: float = 0.0,
) -> Diagnosis | None:  # fmt: skip
    """Return a diagnosis where stamps scatter more than exposures; ``motion``: scatter of these [s], their number."""
    certain_s = max(CERTAIN_S, certain_s)
    rest = t - np.polyval(np.polyfit(number, t, 1), number)
    scatter = float(np.std(rest))
    if scatter <= certain_s or motion is None or scatter <= FACTOR * motion[0]:
        return None
    chance = float(f_distribution.sf((scatter / motion[0]) ** 2, len(t) - 2, motion[1]))
    skew = float(np.mean((rest / scatter) ** 3))
    text = (
        f"{whose}: stamps scatter by {1e3 * scatter:.2f} ms about even frames (skewness {skew:.1f}; "
        f"{1e6 * certain_s:.0f} us allowed), while {what} is even to {1e3 * motion[0]:.2f} ms (p = {chance:.1g})"
    )
    if chance >= alpha:
        return None
    return Diagnosis("arrival-stamps", chance, (text,), figures={"scatter_s": scatter})


def _sampling_scatter(tracks: Tracks, period_s: float) -> tuple[float, int] | None:
    """Return the rms scatter [s] of positions along their paths about even frames, and the number of frames.

    Each position is compared with the parabola through the five positions about it, all tracks of a frame together.
    None where too little moves. The parabola takes up half of the deviation of a single position.
    """
    pushes: dict[int, float] = {}
    sizes: dict[int, float] = {}
    x = np.arange(-2.0, 3.0)
    onto = np.linalg.pinv(np.stack([np.ones(5), x * period_s, (x * period_s) ** 2], axis=1))
    for name in np.unique(tracks.track):
        rows = np.flatnonzero(tracks.track == name)
        rows = rows[np.argsort(tracks.frame[rows], kind="stable")]
        if len(rows) < 5:
            continue
        near = np.lib.stride_tricks.sliding_window_view(rows, 5)
        near = near[np.ptp(tracks.frame[near], axis=1) == 4]
        fitted = np.einsum("pj,njk->npk", onto, tracks.xyz[near])
        off = tracks.xyz[near[:, 2]] - fitted[:, 0]
        for frame, push, size in zip(
            tracks.frame[near[:, 2]].tolist(),
            np.einsum("nk,nk->n", fitted[:, 1], off).tolist(),
            np.einsum("nk,nk->n", fitted[:, 1], fitted[:, 1]).tolist(),
            strict=True,
        ):
            pushes[frame], sizes[frame] = pushes.get(frame, 0.0) + push, sizes.get(frame, 0.0) + size
    late = np.array([pushes[frame] / size for frame, size in sizes.items() if size > 0])
    if len(late) < 20:
        return None
    return 2.0 * float(1.4826 * np.median(np.abs(late - np.median(late)))), len(late)


def row_causes(witness: StampWitness, residuals: Residuals, rig: Rig, limit_px: float) -> list[Diagnosis]:
    """Return cameras whose images move by more than ``limit_px`` rms during the row-by-row readout they state.

    The images of all cameras may move alike. Then no residual shows it, but the points have wrong instants.
    """
    told, worst = [], 0.0
    for k, camera in enumerate(rig.cameras):
        row_s = 1e-9 * witness.row_time_ns.get(camera.name, 0)
        late_s = row_s * (residuals.xy[:, k, 1] - 0.5 * (camera.height - 1))
        moved = residuals.flow[:, k] * late_s[:, None]
        seen = residuals.weight[:, k] > 0
        rms = float(np.sqrt(0.5 * np.mean(np.sum(moved[seen] ** 2, axis=1)))) if seen.any() else 0.0
        worst = max(worst, rms)
        if rms > limit_px:
            told.append(
                f"camera '{camera.name}' states {1e6 * row_s:.1f} us a row, {1e3 * row_s * camera.height:.1f} "
                f"ms in all, in which its images move by {rms:.2f} px rms from the middle row's instant "
                f"({limit_px:g} allowed)"
            )
    return [Diagnosis("rolling-shutter", 1e-12, tuple(told), figures={"moved_px": worst})] if told else []


def exposure_scatter(residuals: Residuals, camera: int) -> tuple[float, int] | None:
    """Return the rms scatter [s] of a camera's exposures against the others', from the motion of its images, and the
    number of frames used; None where too little moves.
    """
    w = residuals.weight[:, camera] ** 2
    push = np.einsum("ni,ni->n", residuals.flow[:, camera], residuals.rest[:, camera]) * w
    size = np.einsum("ni,ni->n", residuals.flow[:, camera], residuals.flow[:, camera]) * w
    frames, at = np.unique(residuals.observations.frame, return_inverse=True)
    pushes, sizes = np.zeros(len(frames)), np.zeros(len(frames))
    np.add.at(pushes, at, push)
    np.add.at(sizes, at, size)
    some = sizes > 0
    if some.sum() < 20:
        return None
    late: Array = pushes[some] / sizes[some]
    # the point's position takes up a share of a camera's delay: at most half with three cameras
    return 2.0 * float(1.4826 * np.median(np.abs(late - np.median(late)))), int(some.sum())
