"""Detection of cameras that were bumped during a run, by name.

Each frame's points give, for each camera, the rotation that would best explain the displacement of its image against
the other cameras, with the information of all cameras on each other (Baarda 1968's test of one camera's common
shift against all residuals). Sums over the last frames are tested; their covariance includes the body's shake of
whole images. After a bump too large for the matching, all images of the camera are displaced by one shift.

    watch = BumpDetector(rig)
    for step in run(source, rig):
        alarm = watch.update(step.frame_set.pulse, step.detections, step.points)
        if alarm and alarm.camera:
            ...  # reorient.reoriented(...)
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mosca.calibration.monitoring.large_shift import LargeShiftDetector
from mosca.calibration.monitoring.rotation_information import FrameSums, frame_sums
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.distributions import chi2
from mosca.data.rig import Rig
from mosca.data.tracks import Points


@dataclass(frozen=True)
class BumpSettings:
    """Settings of the bump test."""

    windows: tuple[int, ...] = (5, 20, 80)
    """Numbers of last frames that are tested."""
    significance: float = 1e-10
    """Probability of a false alarm per test."""
    least_px: float = 0.2
    """Smaller image shifts are ignored (calibration errors, warming up)."""
    least_frames: int = 10
    """Duration from which a shift counts."""
    least_points: float = 8.0
    """Images per frame that must show a shift; otherwise a few half-hidden markers are taken for a bump (measured on
    a drone with eight)."""
    lead: float = 25.0
    """Chi-square by which the camera must explain the residuals better than any other to be named."""
    body_px: float = 0.03
    """Shake of a camera's whole image, rms an axis and frame."""
    camera_sigma_px: float = 0.03
    """Random error of an image point in addition to its detection's."""
    lost_share: float = 0.3
    """A camera was bumped far if fewer than this share of the expected points are matched, while as many of its
    images have one common shift."""
    lost_frames: int = 20
    """Frames examined for ``lost_share``."""


@dataclass(frozen=True)
class Alarm:
    """A camera was bumped."""

    camera: str | None
    """None where the residuals do not determine which of ``suspects``."""
    suspects: tuple[str, ...]
    since: int
    """First frame of the change."""
    shift_px: float
    """Shift of its image (rms over the points)."""
    turn_rad: tuple[float, float, float]
    """(3,) rotation about its own axes that explains the shift, NaN where only the shift is known."""
    chi_square: float
    """Chi-square of the change, with 3 degrees of freedom."""
    significance: float
    """Probability of such a change without a bump."""

    @property
    def message(self) -> str:
        """The alarm in a line."""
        size = f"its image is {self.shift_px:.2f} px off since frame {self.since}"
        if self.camera is None:
            return (
                f"one of the cameras {', '.join(self.suspects)} was bumped ({size}); which one, these cameras alone "
                "cannot tell: calibrate the exterior orientation anew"
            )
        return f"camera '{self.camera}' was bumped: {size}; re-orient it from the tracked points, and fix its mount"


class BumpDetector:
    """Detects bumped cameras; ``update`` takes each frame set's points and raises at most one alarm a bump."""

    def __init__(self, rig: Rig, settings: BumpSettings | None = None) -> None:
        self.settings = settings or BumpSettings()
        self.rig = rig
        self._frames: deque[FrameSums] = deque(maxlen=max(self.settings.windows))
        self._lost = LargeShiftDetector(rig, self.settings.lost_share, self.settings.lost_frames)
        self._count = 0
        self._limit = float(chi2.isf(self.settings.significance, 3))

    def update(self, frame: int, detections: Mapping[str, Detections], points: Points) -> Alarm | None:
        """Take the points of frame number ``frame`` and the detections they were made from; return an alarm if a
        camera was bumped.
        """
        s = self.settings
        self._count += 1
        self._frames.append(frame_sums(self.rig, frame, detections, points, s.camera_sigma_px, s.body_px))
        alarm = self._shifted() or self._lost_one(frame, detections, points)
        if alarm is not None:
            self.restart(self.rig)
        return alarm

    def restart(self, rig: Rig) -> None:
        """Forget all frames and go on with ``rig``, in which the bumped camera has its new pose."""
        self.rig = rig
        self._frames.clear()
        self._lost = LargeShiftDetector(rig, self.settings.lost_share, self.settings.lost_frames)

    def _shifted(self) -> Alarm | None:
        every = list(self._frames)
        for window in self.settings.windows:
            # tests are a fifth of a window apart, which delays an alarm by no more than that
            if len(every) < window or self._count % max(1, window // 5):
                continue
            change = changes(every[-window:])
            if change.statistic.max(initial=0.0) < self._limit:
                continue
            k = int(np.argmax(change.statistic))
            if change.shift_px[k] < self.settings.least_px:
                continue
            return self._alarm(every, k)
        return None

    def _alarm(self, every: list[FrameSums], k: int) -> Alarm | None:
        first = _since(every, k)
        change = changes(every[first:])
        lead = change.statistic[k] - change.statistic
        rivals = [name for i, name in enumerate(self.rig.names) if lead[i] < self.settings.lead]
        if self.rig.names[k] not in rivals:
            return None  # over the whole change another camera explains it better: wait for more frames
        # of two cameras that disagree, either may be right
        named = len(rivals) == 1 and len(self.rig.names) > 2
        best = int(np.argmax(change.statistic))
        if change.shift_px[best] < self.settings.least_px or len(every) - first < self.settings.least_frames:
            return None
        if np.mean([one.count[best] for one in every[first:]]) < self.settings.least_points:
            return None
        if not named and len(self.rig.names) > 2 and len(every) - first < self.settings.windows[-1] // 2:
            return None  # a few more frames will decide which
        return Alarm(
            self.rig.names[k] if named else None,
            tuple(rivals if len(self.rig.names) > 2 else self.rig.names),
            every[first].frame,
            float(change.shift_px[best]),
            tuple(change.turn_rad[best].tolist()) if named else (float("nan"),) * 3,
            float(change.statistic[best]),
            float(chi2.sf(change.statistic[best], 3)),
        )

    def _lost_one(self, frame: int, detections: Mapping[str, Detections], points: Points) -> Alarm | None:
        found = self._lost.update(frame, detections, points)
        if found is None:
            return None
        return Alarm(
            found.camera, (found.camera,), found.since, found.shift_px, (float("nan"),) * 3, found.chi_square,
            float(chi2.sf(found.chi_square, 1))
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Changes:
    """For each camera (c,) as the only one bumped: ``turn_rad`` (c, 3), its ``statistic`` (c,) chi-square with 3
    degrees of freedom, and ``shift_px`` (c,) rms of its image.
    """

    turn_rad: Array
    statistic: Array
    shift_px: Array


def changes(frames: list[FrameSums]) -> Changes:
    """Return the rotation of each camera that would explain the sums of ``frames``.

    Generalised least squares with E v = M[:, k] w and Cov v = M + M B M, summed over frames. M is pseudo-inverted,
    since some rotations change no residual (two cameras).
    """
    v = sum((f.pull for f in frames), np.zeros_like(frames[0].pull))
    m = sum((f.information for f in frames), np.zeros_like(frames[0].information))
    spread = sum((f.spread for f in frames), np.zeros_like(m))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(spread), 1e-300))
    values, vectors = np.linalg.eigh(spread * scale[:, None] * scale)
    good = values > 1e-9 * max(values[-1], 1e-300)
    white = (vectors[:, good] / np.sqrt(values[good])).T * scale
    pulled, design = white @ v, white @ m
    cameras = len(v) // 3
    turn, statistic = np.zeros((cameras, 3)), np.zeros(cameras)
    for k in range(cameras):
        own = design[:, 3 * k : 3 * k + 3]
        root = np.linalg.norm(own, axis=0)
        if (root == 0).any():
            continue
        turn[k] = np.linalg.lstsq(own / root, pulled, rcond=1e-6)[0] / root
        statistic[k] = float(np.sum((own @ turn[k]) ** 2))
    square = sum((f.image_square for f in frames), np.zeros((cameras, 3, 3)))
    count = sum((f.count for f in frames), np.zeros(cameras))
    shift = np.sqrt(np.einsum("ci,cij,cj->c", turn, square, turn) / np.maximum(count, 1))
    return Changes(turn, statistic, shift)


def _since(every: list[FrameSums], k: int) -> int:
    """Return the frame (by index) from which on camera k's rotation explains most: the likeliest time of change."""
    starts = range(len(every))
    return max(starts, key=lambda first: changes(every[first:]).statistic[k])
