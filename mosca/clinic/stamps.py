"""Causes that stamps and frame numbers show: arrival stamps, and frames lost without a gap in the numbers."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import f as f_distribution

from mosca.clinic.causes import Diagnosis, merged
from mosca.clinic.misfit import Residuals
from mosca.data.arrays import Array
from mosca.data.frames import Frame, FrameSource, WrappedSource, mid_exposure_ns
from mosca.data.rig import Rig
from mosca.diagnostics.camera_health import HealthSettings

CERTAIN_S = HealthSettings().late_s
"""Scatter of stamps below which they are taken for those of exposures."""
FACTOR = 3.0
"""Factor by which stamps may scatter more than the motion says that exposures do."""


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
    """Return what stamps and numbers show to be wrong."""
    found = []
    for k, (name, times) in enumerate(witness.times_ns.items()):
        number, t = np.array(witness.numbers[name], float), 1e-9 * (np.array(times, float) - times[0])
        if len(t) < 20:
            continue
        steps, counted = np.diff(t) / period_s, np.diff(number)
        gaps = np.flatnonzero(
            (np.round(steps - counted) >= 1) & (steps > 1.5) & (np.abs(steps - np.round(steps)) < 0.25)
        )
        regular = float(np.median(np.abs(steps - np.round(steps))))
        if len(gaps) and regular < 0.05:
            text = (
                f"camera '{name}': {len(gaps)} gap(s) in the stamps without one in the frame numbers, the first of "
                f"{steps[gaps[0]]:.0f} periods after frame {int(number[gaps[0]])}"
            )
            found.append(Diagnosis("dropped-unnoticed", 1e-12, (text,), camera=name, figures={"gaps": len(gaps)}))
            continue
        rest = t - np.polyval(np.polyfit(number, t, 1), number)
        scatter = float(np.std(rest))
        motion = exposure_scatter(residuals, k) if residuals is not None else None
        if scatter <= CERTAIN_S or motion is None or scatter <= FACTOR * motion[0]:
            continue
        chance = float(f_distribution.sf((scatter / motion[0]) ** 2, len(t) - 2, motion[1]))
        skew = float(np.mean((rest / scatter) ** 3))
        text = (
            f"camera '{name}': stamps scatter by {1e3 * scatter:.2f} ms about even frames (skewness {skew:.1f}; "
            f"{1e6 * CERTAIN_S:.0f} us allowed), while the motion in its images is even to {1e3 * motion[0]:.2f} ms "
            f"(p = {chance:.1g})"
        )
        if chance < alpha:
            found.append(Diagnosis("arrival-stamps", chance, (text,), camera=name, figures={"scatter_s": scatter}))
    return merged(found)


def row_causes(witness: StampWitness, residuals: Residuals, rig: Rig, limit_px: float) -> list[Diagnosis]:
    """Return cameras that state a readout row by row in which their images move by more than ``limit_px`` rms.

    All cameras' images may move alike, so that no residual shows it: the points are at other instants than stamped.
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
    """Return how far (rms [s]) a camera's exposures scatter against the others', by the motion of its images, and
    the number of frames that this rests on; None where too little moves.
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
    # a point follows its images and takes up a share of a camera's delay: at most half with three cameras
    return 2.0 * float(1.4826 * np.median(np.abs(late - np.median(late)))), int(some.sum())
