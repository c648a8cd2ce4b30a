"""The take to which a person's skeleton is fitted before the measurement: rendered, measured, labelled, cached.

It is cached by the content of all its inputs (``scenarios.run.kept_calibrations``): rendering a take of 24 s for six
cameras takes minutes.
"""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.errors import InputError
from mosca.labelling.automatic.label import label_automatically
from mosca.labelling.automatic.template import read_template
from mosca.pipeline import PipelineSettings
from mosca.skeleton.marker_frames import MarkerFrames, labels_of, marker_frames
from scenarios.build.cameras import twin_source
from scenarios.build.scene import build_scene
from scenarios.run.kept_calibrations import cache_folder, kept
from scenarios.run.pipeline import collected_of
from scenarios.score.people import labelled_by_truth
from scenarios.spec.scenario import Premises, Scenario
from scenarios.spec.scenes import ActorScene
from scenarios.spec.skeleton import ACTION, SkeletonSpec
from scenarios.types import RunOptions
from twin.cameras.virtual_camera import VirtualCamera

TAKE_SEED = 0x7A4E
"""Added to the scenario's seed: the take has other shake and noise than the measurement, but the same person."""
MOST_KEPT = 20
"""Most takes that are cached, the last used ones (15 MB each)."""


def calibration_take(
    spec: Scenario,
    folder: Path,
    cameras: tuple[VirtualCamera, ...],
    rig: Rig,
    settings: PipelineSettings,
    options: RunOptions,
) -> MarkerFrames:
    """Return the labelled markers of the calibration take of ``spec``, measured with ``rig``.

    The cameras are those of the measurement, with its disturbances from its beginning. InputError where the frames of
    the measurement are not the twin's: then there is no such take of the person.
    """
    assert spec.skeleton is not None
    if options.source != "twin":
        raise InputError(
            f"--source {options.source}: skeleton.fit_to = 'range_of_motion' is for the twin alone, which can make "
            "that movement; add --set skeleton.fit_to=take, and leave skeleton.calibration_s out"
        )
    take = take_of(spec)
    inputs = (take, cameras, rig, settings.volume)
    made = lambda: _measured(take, folder, cameras, rig, settings, options)  # noqa: E731
    return kept(inputs, made, cache_folder().with_name("takes"), code=Path(__file__), most=MOST_KEPT)


def take_of(spec: Scenario) -> Scenario:
    """Return the scenario of the calibration take: another action and length, without keys that only scores use."""
    assert spec.skeleton is not None
    assert isinstance(spec.scene, ActorScene)
    return spec.model_copy(
        update={
            "title": "",
            "description": "",
            "expect": "pass",
            "told": (),
            "scene": spec.scene.model_copy(update={"action": ACTION}),
            "capture": spec.capture.model_copy(update={"duration_s": spec.skeleton.calibration_s}),
            "calibration": None,
            "fault": None,
            "skeleton": SkeletonSpec(labels=spec.skeleton.labels),
            "length": (),
            "premises": Premises(),
            "limits": {},
            "breaks": {},
        }
    )


def _measured(
    take: Scenario,
    folder: Path,
    cameras: tuple[VirtualCamera, ...],
    rig: Rig,
    settings: PipelineSettings,
    options: RunOptions,
) -> MarkerFrames:
    options = replace(options, rrd=None, record_to=None)
    with ExitStack() as stack:
        scene = build_scene(take, folder)
        seeded = take.model_copy(update={"seed": take.seed + TAKE_SEED})
        twin = stack.enter_context(twin_source(seeded, scene, cameras, options.workers))
        collected = collected_of(twin, twin, rig, settings, take, options, stack)
        labelled = with_labels(take, collected.tracks, twin.truth())
    return marker_frames(labelled, labels_of(labelled), rig)


def with_labels(spec: Scenario, tracks: Tracks, truth: Truth) -> Tracks:
    """Return ``tracks`` with the names of their markers, by ``skeleton.labels``."""
    if spec.skeleton is not None and spec.skeleton.labels == "auto":
        return label_automatically(tracks, read_template()).tracks
    return labelled_by_truth(tracks, truth, max(spec.working_space.size_m))
