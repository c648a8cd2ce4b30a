"""Values passed between the stages of a run: options, results, scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.detections import Detections
from mosca.data.frames import FrameSource
from mosca.data.joint_motion import JointMotion
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth

if TYPE_CHECKING:
    from mosca.continuous.moving_cameras.body_worn import Worn
    from mosca.continuous.reconstruct import Reconstructed
    from mosca.diagnostics.camera_health import CameraHealth
    from mosca.diagnostics.sensor import LearnedSensor
    from mosca.machines.vibration.analysis import Vibration
    from mosca.synchronisation import Assembly
    from reports.evidence import CameraView, KeptSet, MeasuredBy
    from scenarios.score.sensor import StatedSensor
    from scenarios.score.virtual_objects import ObjectErrors
    from scenarios.virtual.objects import ShownPoses
    from twin.cameras.expected_image import Expected
    from twin.cameras.virtual_camera import VirtualCamera
    from twin.scenes.scene import Scene

Progress = Callable[[int, int], None]
"""Function that is called with the number of steps done and the number of all steps."""


RRD_IMAGES = 100
"""Default number of frame sets whose images are in a Rerun log: some ten megabytes with four cameras."""


@dataclass(frozen=True)
class RunOptions:
    """Options of a scenario's run."""

    source: str = "twin"
    """``twin``, ``recording:DIR`` or ``hardware:RIG.toml``."""
    workers: int = 1
    """Rendering threads."""
    rrd: Path | None = None
    """A Rerun log to write while running."""
    rrd_images: int = RRD_IMAGES
    """Number of frame sets whose images are logged, evenly over the run."""
    record_to: Path | None = None
    """A folder into which to record the frames."""
    truth: Path | None = None
    """Truth for frames that are not the twin's; default: ``truth.npz`` beside a recording."""
    progress: Progress | None = None
    stage: Callable[[str], None] | None = None
    """Called with the name of each stage that begins."""
    page: bool = True
    """Whether to keep the images for the run's page, which take longer than a short run's measurements."""


class TruthSource(FrameSource, Protocol):
    """A frame source with ground truth: the twin."""

    scene: Scene
    virtual: tuple[VirtualCamera, ...]

    @property
    def truth_xyz(self) -> Sequence[Array]:
        """True marker positions (m, 3) [m] for each pulse exposed so far."""
        ...

    def truth(self) -> Truth:
        """Return the truth of all pulses that were exposed."""
        ...

    def expected(self, pulse: int) -> tuple[Expected, ...]:
        """Return each camera's image of a pulse without noise."""
        ...


@dataclass(frozen=True)
class CameraFrames:
    """Frames of one camera of a continuous run."""

    expected: int
    """Expected number, by the scenario's duration and the camera's rate, or by the take itself if it is longer."""
    arrived: int
    """Number of frames with a usable image."""
    unusable: int
    """Number of frames without a usable image."""
    span_s: float
    """Time from the first usable frame to the last, by the camera's own clock [s]."""
    least: float
    """Share that must arrive: the limit, or the share after the losses that the scenario states."""

    @property
    def share(self) -> float:
        """Share of the expected frames that arrived, at most 1."""
        return min(1.0, self.arrived / self.expected)


@dataclass(frozen=True, eq=False)
class Collected:
    """Data kept from a run of the pipeline."""

    tracks: Tracks
    views: tuple[CameraView, ...]
    """A picture of each camera at ``view_pulse``."""
    view_pulse: int
    assembly: Assembly
    """Counts of frames and frame sets, and notes."""
    seconds: Mapping[str, float]
    """Computing time by stage [s]."""
    detections: Mapping[int, Mapping[str, Detections]]
    """Pulse -> camera -> detections, of the pulses for which the Cramer-Rao bound is computed."""
    cameras: tuple[CameraHealth, ...] = ()
    sensors: tuple[LearnedSensor, ...] = ()
    """The cameras' sensors as estimated from the images."""
    stated: Mapping[str, StatedSensor] = field(default_factory=dict)
    """Camera -> its sensor as stated in the scenario."""
    account: Mapping[str, Any] = field(default_factory=dict)
    """The source's own account of the frames that it received."""
    frames: Mapping[str, CameraFrames] = field(default_factory=dict)
    """Camera -> its frames, of a continuous run; empty for frame sets."""
    kept_sets: tuple[KeptSet, ...] = ()
    """Images of some frame sets, for the page."""
    measured_by: MeasuredBy | None = None


@dataclass(frozen=True, eq=False)
class TruthPairs:
    """Measured samples paired with true markers, over all frames (t) and markers (m)."""

    row: Array
    """(k,) for each pair: index of its sample in the tracks."""
    frame: Array
    """(k,) for each pair: index of its instant in the truth."""
    marker: Array
    """(k,) for each pair: index of the true marker."""
    track: Array
    """(k,) for each pair: number of the track."""
    error_m: Array
    """(k, 3) for each pair: measured minus true position [m]."""
    nees: Array
    """(k,) for each pair: normalised estimation error squared."""
    residual_px: Array
    n_cameras: Array
    """(k,) for each pair: number of cameras from which the sample was made."""
    views: Array
    """(k,) for each pair: number of cameras that saw the marker, from the truth alone."""
    seen: Array
    """Number of seen markers of each frame (t,)."""
    missed: Array
    """Number of seen markers without a sample, of each frame (t,)."""
    ghosts: Array
    """Number of samples without a marker, of each frame (t,)."""
    gate_m: Array
    """Largest distance of a pair in each frame (t,) [m]."""
    seen_mask: Array
    """Whether a marker is seen in a frame (t, m)."""

    @property
    def distance_m(self) -> Array:
        """3D distance of each pair (k,) [m]."""
        result: Array = np.linalg.norm(self.error_m, axis=1)
        return result


@dataclass(frozen=True)
class Score:
    """Value of a metric.

    ``sums`` and ``weights`` are per block of frames, so that two runs can be compared block by block;
    ``reports.metrics`` lists their meaning for each metric.
    """

    value: float
    n: int
    """Number of items behind the value."""
    ci95: tuple[float, float] | None = None
    """95 % confidence interval."""
    sums: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class MeasuredTracks:
    """Input of scoring: the tracks, the rig with which they were reconstructed, and other results."""

    collected: Collected
    rig: Rig
    cameras: tuple[str, ...]
    """Names of the cameras that decide whether a marker is seen."""
    synchronous: Callable[[], Tracks]
    """Runs the synchronous pipeline on the same frames and returns its tracks."""
    continuous: Reconstructed | Worn | None = None
    """The continuous reconstruction; None for frame sets."""
    bodies: tuple[RigidBody, ...] = ()
    poses: BodyPoses | None = None
    calibration_m2: Callable[[Array], Array] | None = None
    """Covariance (n, 3, 3) [m^2] that the error of the run's own calibration adds to points (n, 3) [m]."""
    joints: JointMotion | None = None
    """Joints of the scene's person."""
    labelled: Tracks | None = None
    """Tracks of the person, where their labels were found and are not those of the truth."""
    vibration: Vibration | None = None
    """Vibration of the scene's panel."""
    shown: ShownPoses | None = None
    """Virtual objects as they were shown."""
    nominal: Rig | None = None
    """The fixed cameras with the pipeline's lens model fitted to the true lenses, where these are known."""


@dataclass(frozen=True, eq=False)
class Scored:
    """Metrics and premises of a run, and the tracks and the truth that were compared."""

    scores: Mapping[str, Score]
    premises: Mapping[str, Any]
    collected: Collected
    """The collected data as scored: in the body's frame where cameras are worn."""
    truth: Truth | None
    """The truth in the same frame; None without a truth."""
    pairs: TruthPairs | None
    joints: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Joint -> its own figures (``scenarios.score.people.joint_table``)."""
    modes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """True mode -> its own figures (``scenarios.score.vibration``)."""
    not_judged: tuple[str, ...] = ()
    """Metrics with limits for which data are missing."""
    self_orientation: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Rows of the table (``scenarios.score.self_orientation``)."""
    error_budget: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Source of error -> its own figures."""
    enough_alone: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Source of error -> its size that alone gives the paper's difference."""
    objects: ObjectErrors | None = None
    """Errors of the virtual objects."""
