"""The pipeline: frames -> frame sets -> detections -> correspondences -> points -> tracks.

It does not depend on where the frames come from. ``run`` is a generator: one Step a trigger pulse.
"""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from typing import Protocol

import numpy as np

from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import Matched, MatchSettings, match_counted
from mosca.correspondence.shared_turns import Shared, without_turns
from mosca.correspondence.typical_size import TypicalSize
from mosca.data.arrays import Array
from mosca.data.detections import Detections, Seen
from mosca.data.frames import CameraInfo, FrameSet, FrameSource
from mosca.data.rays import Predicted, RayTable
from mosca.data.rig import Rig, focal_px
from mosca.data.tracks import Points, Samples
from mosca.detection.cut_targets.mend import CutTargets
from mosca.detection.detect import DetectionSettings
from mosca.detection.scheduler import LOOK_SETS, FrameSetDetector, detect_ahead, most_ahead
from mosca.diagnostics.camera_health import Health, HealthSettings
from mosca.diagnostics.noise_model import ImageNoise
from mosca.diagnostics.sensor import Sensors
from mosca.errors import InputError
from mosca.synchronisation import Assembly, AssemblySettings, assemble
from mosca.tracking.motion_scale import FieldWidth
from mosca.tracking.nearest_neighbour import NearestSettings, NearestTracker
from mosca.tracking.tracker import Tracker, TrackSettings

MOST_DETECTIONS = 5000
"""Detections an image may have; matching many more would take minutes a frame set."""
FEWEST_SETS = 4
"""Fewest frame sets of a recording from which errors of cameras are learned: one or two updates, each with one or two
independent residuals a camera, determine a variance to a factor of three. Of MyPTV's three sets, 114 of the 117
published particles lie within 0.2 mm, and 111 with 2."""
COARSER_STARTS = (1.0, 3.0, 9.0)
"""Image errors, over the setting, with which the first sets are matched. Images that err by ten times what is assumed
meet by chance alone, and what few points show is as small. Of 40 drawn takes of 4 to 12 markers whose cameras'
distortion (1 px) is forgotten, 4 find hardly a point with (1,), none with these; of one scenario with 40 markers
(0.6 px) (1, 9) and (1, 2, 4) find the same, (1, 27) hardly any."""
CLEARLY_MORE = 2.0
"""Times as many images that a coarser start must join to points, to be taken: with 1.2, 1.5 and 3 it gives the same
in all of these takes. Where half of the images are joined, no other start is tried; one that joins
fewer is not taken: with two of four calibrations swapped, chance joins up to a fifth."""

STEADY_SETS = 400.0
"""Frame sets over which a camera's mean turn is taken. Half or twice of it gives the same in takes of 100 sets."""


@dataclass(frozen=True)
class PipelineSettings:
    """Settings of all stages."""

    detection: DetectionSettings = field(default_factory=DetectionSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    track: TrackSettings = field(default_factory=TrackSettings)
    volume: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Box (low (3,), high (3,)) [m, world] in which targets can be; other points are no targets. None: everywhere."""
    workers: int = 0
    """Threads that detect in later frame sets, besides the one that matches and tracks (which also detects when it
    would wait): one fewer than there are cores. 0: each set is detected when needed, as in a live run."""
    split: int | None = None
    """Threads among which the cameras of a set are then divided, which brings its tracks sooner (None: 2 in a live
    run, else 1). The tracks are the same."""
    nearest: NearestSettings | None = None
    """Nearest-neighbour tracking of the guide, a baseline for comparisons, instead of ``track``."""
    lookahead: int = 64
    """Frame sets that are read before the first one is processed, to learn backgrounds, blur and noise; 0 in a live
    run."""
    assembly: AssemblySettings = field(default_factory=AssemblySettings)
    """How frames become frame sets."""


@dataclass(frozen=True, eq=False)
class Step:
    """Results of one trigger pulse."""

    frame_set: FrameSet
    detections: Mapping[str, Detections]
    points: Points
    samples: Samples
    """Points whose identity is now certain, some of earlier pulses."""
    seconds: Mapping[str, float]
    """Computing time of each stage until the step was ready; the health is computed afterwards
    (``mosca.diagnostics.camera_health.Health.seconds``)."""
    noise: ImageNoise | None = None
    """Errors of image points besides detection noise with which the set was matched; None for a step of several
    rigs."""


class Keeper(Protocol):
    """Monitors the rig while it runs, and may correct it: ``mosca.calibration.monitoring.rig_keeper.RigKeeper``."""

    rig: Rig

    def attend(self, frame: int, detections: Mapping[str, Detections], points: Points) -> None:
        """Take a frame set's points; afterwards, ``rig`` is the one for measuring the next frame set."""


def run(
    source: FrameSource,
    rig: Rig,
    settings: PipelineSettings | None = None,
    assembly: Assembly | None = None,
    backgrounds: Mapping[str, Array] | None = None,
    keeper: Keeper | None = None,
    health: Health | None = None,
    sensors: Sensors | None = None,
) -> Iterator[Step]:
    """Turn a source's frames into tracks, pulse by pulse.

    InputError where the source lacks a camera of the rig or sends images of another size, and for a background of a
    camera that the rig lacks.

    Parameters
    ----------
    source
        Yields the frames.
    rig
        Calibrated cameras.
    settings
        Of all stages.
    assembly
        Counts of frames and gaps, filled while running.
    backgrounds
        Camera -> image (H, W) of the static scene, subtracted before detection; cameras may be left out.
    keeper
        Monitors the rig and may correct it while running.
    health
        Health of the cameras, filled while running.
    sensors
        Properties of the cameras' sensors from the images, filled while running.
    """
    check_source(source, rig)
    settings = PipelineSettings() if settings is None else settings
    sets = assemble(source, source.cameras, settings.assembly, assembly)
    yield from run_sets(sets, source.cameras, rig, settings, backgrounds, keeper, health, sensors)


def run_sets(
    sets: Iterable[FrameSet],
    cameras: Sequence[CameraInfo],
    rig: Rig,
    settings: PipelineSettings | None = None,
    backgrounds: Mapping[str, Array] | None = None,
    keeper: Keeper | None = None,
    health: Health | None = None,
    sensors: Sensors | None = None,
) -> Iterator[Step]:
    """Turn frame sets of ``cameras`` into tracks; else as ``run``. Sets may be missing, never reordered."""
    settings = PipelineSettings() if settings is None else settings
    backgrounds = {} if backgrounds is None else backgrounds
    for name in backgrounds:
        if name not in rig.names:
            raise InputError(
                f"background: camera '{name}' given; the rig has {', '.join(rig.names)}; "
                "give the cameras the same names in both"
            )
    look = FrameSetDetector(settings.detection, {info.name: info.bit_depth for info in cameras}, backgrounds)
    attend = None if sensors is None else sensors.attend
    seen = detect_ahead(look, sets, settings.workers, settings.split or 1, attend, settings.lookahead)
    yield from run_seen(seen, rig, settings, keeper, health)


def run_seen(
    seen: Iterable[Seen],
    rig: Rig,
    settings: PipelineSettings | None = None,
    keeper: Keeper | None = None,
    health: Health | None = None,
) -> Iterator[Step]:
    """Turn frame sets with their detections, and the seconds that these took, into tracks; else as ``run``.

    For detections without their images: from a recording that has only detections, or from other machines.
    """
    settings = PipelineSettings() if settings is None else settings
    health = Health.of(rig, settings.match) if health is None else health
    low, high = settings.volume or ((-np.inf,) * 3, (np.inf,) * 3)
    volume = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    tracker = Tracker(settings.track) if settings.nearest is None else NearestTracker(settings.nearest)
    field_width, matcher, cut = FieldWidth(rig), _Matcher(settings.match, volume), CutTargets()
    if settings.lookahead > 0 and keeper is None:
        seen = _errors_first(seen, rig, matcher, health)

    for frame_set, detections, seconds in seen:
        check_detections(detections, frame_set.pulse)
        timer = _StageTimer({"detect": seconds})
        predicted = tracker.predict(frame_set.time_ns * 1e-9)
        timer.lap("predict")
        noise = health.noise
        bundle, found = matcher.match(rig, detections, predicted, noise)
        typical_m = matcher.typical_m if settings.match.mend else 0.0
        mended = cut.mended(frame_set, detections, rig, bundle, found.points, predicted, typical_m)
        if mended is not None:
            detections = mended
            bundle, found = matcher.match(rig, detections, predicted, noise, learn=False)
        points = matcher.without_turns(rig, bundle, found, noise)
        timer.lap("match")
        if (width_m := field_width.learn(points)) is not None:
            tracker.scale_to(width_m)
        samples = tracker.update(points, frame_set.pulse, frame_set.time_ns, noise.jitter_s)
        if (worst_m := settings.track.worst_sigma_m) is not None:
            tracked, samples = len(samples), samples.certain(worst_m)
            health.withheld += tracked - len(samples)
        timer.lap("track")
        measured_with = rig
        if keeper is not None:
            keeper.attend(frame_set.pulse, detections, points)
            rig = keeper.rig
            timer.lap("keep")
        yield Step(frame_set, detections, points, samples, timer.laps, noise)
        # off the latency path
        health.attend(measured_with, frame_set, detections, points, bundle)
    health.nameless = tracker.waiting


def check_detections(detections: Mapping[str, Detections], pulse: int) -> None:
    """Raise InputError where an image shows more targets than any target field has: its noise was detected."""
    for name, found in detections.items():
        if len(found) > MOST_DETECTIONS:
            raise InputError(
                f"camera '{name}', pulse {pulse}: {len(found)} detections, {MOST_DETECTIONS} are allowed; noise or "
                "background is taken for targets: lower detection.false_alarms, raise detection.minimum_size_px, or "
                "give a background"
            )


def check_source(source: FrameSource, rig: Rig) -> None:
    """Raise InputError where the source's cameras are not the rig's."""
    given = {info.name: info for info in source.cameras}
    for camera in rig.cameras:
        if camera.name not in given:
            raise InputError(
                f"camera '{camera.name}' of the rig sends no frames; the source has {', '.join(given)}; "
                "give the cameras the same names in both"
            )
        info = given[camera.name]
        if (info.width, info.height) != (camera.width, camera.height):
            raise InputError(
                f"camera '{camera.name}': images are {info.width} x {info.height}, the rig file says "
                f"{camera.width} x {camera.height}; use the calibration made at this size"
            )


class _SteadyTurns:
    """Mean turns (c, 2) of a rig's cameras [rad]. What stays is no shake, but an error of calibration or lens model.

    A wrong orientation turns a camera, and is removed like shake. The misfit of a lens model may look like a turn
    where the targets are, and moves points more if it is taken for one. The share of it in the mean turns is that of
    the images' own variance in their mean square; the turns' estimate allows for the smooth part of the misfit.
    """

    def __init__(self) -> None:
        self._rig: Rig | None = None
        self._sets, self._mean = 0.0, np.zeros((0, 2))

    def kept(self, rig: Rig, noise: ImageNoise) -> Array:
        """Return the part of the mean turns that is not to be removed."""
        if rig is not self._rig:
            self._rig, self._sets, self._mean = rig, 0.0, np.zeros((len(rig.cameras), 2))
        square = float(np.mean((self._mean * focal_px(rig)[:, None]) ** 2))
        own = float(np.mean(noise.sigma_px**2 - noise.shared_px**2 - noise.field_px**2))
        return self._mean * (min(1.0, own / square) if square > 0.0 else 1.0)

    def learn(self, turns: Array) -> None:
        """Take the turns of a frame set."""
        if turns.any():
            # the mean starts at no turn, which weighs as one frame set
            self._sets = min(self._sets + 1.0, STEADY_SETS)
            self._mean = self._mean + (turns - self._mean) / (self._sets + 1.0)


class _Matcher:
    """Matches frame sets; learns the targets' size and the cameras' steady turns."""

    def __init__(self, settings: MatchSettings, volume: tuple[Array, Array]) -> None:
        self._settings, self._unjudged = settings, replace(settings, judge_sizes=False)
        self._volume, self._sizes, self._steady = volume, TypicalSize(), _SteadyTurns()

    def untaught(self) -> "_Matcher":
        """Return a matcher with the same settings that has learned nothing."""
        return _Matcher(self._settings, self._volume)

    def start_from(self, other: "_Matcher") -> None:
        """Take over what another matcher has learned."""
        self._sizes, self._steady = other._sizes, other._steady

    @property
    def typical_m(self) -> float:
        """Diameter of the targets [m]; 0 where they are not of one size, or it is not known."""
        return self._sizes.diameter_m if self._settings.judge_sizes and self._sizes.alike else 0.0

    def match(
        self,
        rig: Rig,
        detections: Mapping[str, Detections],
        predicted: Predicted,
        noise: ImageNoise,
        learn: bool = True,
    ) -> tuple[RayTable, Matched]:
        """Return the rays of a frame set and the points that they make; sizes are learned from them."""
        sizes = self._sizes
        table = make_ray_table(rig, detections, noise.sigma_px, self._settings.target, sizes.area_noise)
        first, settings = not sizes.known, self._settings if sizes.alike else self._unjudged
        found = match_counted(table, predicted, settings, self._volume, sizes.diameter_m, sizes.hidden)
        if learn:
            sizes.learn(found.points, table)
        if first and not sizes.alike:
            found = match_counted(table, predicted, self._unjudged, self._volume, sizes.diameter_m, sizes.hidden)
        return table, found

    def without_turns(self, rig: Rig, table: RayTable, found: Matched, noise: ImageNoise) -> Points:
        """Return a frame set's points without the turns of the cameras, of which the steady part is learned."""
        if not self._settings.turns:
            return found.points
        shared = Shared(noise.shared_px, noise.field_px, self._steady.kept(rig, noise))
        points, turns = without_turns(found.points, found.trusts, table, shared)
        self._steady.learn(turns)
        return points


def _errors_first(seen: Iterable[Seen], rig: Rig, matcher: _Matcher, health: Health) -> Iterator[Seen]:
    """Return all of ``seen`` after a trial match of the first, so that errors and sizes are known from the start.

    This is not done in shorter recordings: from a few sets, the cameras' own errors are less certain than the
    setting. Where there are fewer than ``FEWEST_SETS``, the setting is used throughout.
    """
    left = iter(seen)
    first = list(islice(left, 1))
    room = most_ahead(first[0][0]) if first else 0
    if room >= FEWEST_SETS:
        first.extend(islice(left, (LOOK_SETS if room >= LOOK_SETS else FEWEST_SETS) - 1))
        if len(first) < FEWEST_SETS:
            health.keep_start()
    if len(first) == LOOK_SETS:
        health.start_from(_learned_from(first, rig, matcher, health.settings))
    return chain(first, left)


def _learned_from(first: Sequence[Seen], rig: Rig, matcher: _Matcher, settings: HealthSettings) -> Health:
    """Return what the first sets show of the image points' errors, from the start that joins clearly most images."""
    best, taught, most = Health(rig, settings), matcher.untaught(), 0
    fewest = min(3, len(rig.cameras))
    for coarser in COARSER_STARTS:
        trial, own = Health(rig, replace(settings, start_px=coarser * settings.start_px)), matcher.untaught()
        joined = detected = 0
        for frame_set, detections, _ in first:
            check_detections(detections, frame_set.pulse)
            table, found = own.match(rig, detections, Predicted.nothing(), trial.noise)
            points = own.without_turns(rig, table, found, trial.noise)
            trial.attend(rig, frame_set, detections, points, table)
            joined += int(points.n_cameras[points.n_cameras >= fewest].sum())
            detected += len(table.rays)
        # a coarser start joins some by chance alone
        if joined > CLEARLY_MORE * most and (coarser == COARSER_STARTS[0] or CLEARLY_MORE * joined >= detected):
            best, taught, most = trial, own, joined
        if CLEARLY_MORE * most >= detected:
            break
    matcher.start_from(taught)
    return best


class _StageTimer:
    """Computing time of the stages of one step [s]."""

    def __init__(self, laps: Mapping[str, float]) -> None:
        self._last = time.perf_counter()
        self.laps = dict(laps)

    def lap(self, name: str) -> None:
        here = time.perf_counter()
        self.laps[name] = here - self._last
        self._last = here
