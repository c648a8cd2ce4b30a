"""Zones in parallel: one detection pass over all frames, then correspondence and tracking for each zone."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import tee

import numpy as np

from mosca.data.detections import Seen
from mosca.data.frames import FrameSet
from mosca.data.rig import Rig
from mosca.data.tracks import Points, Samples, Tracks
from mosca.diagnostics.camera_health import Health
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, Step, run_seen


@dataclass(frozen=True, eq=False)
class Zone:
    """A capture volume with cameras of its own."""

    name: str
    rig: Rig
    low_m: tuple[float, float, float]
    """Lower corner of the box of its targets [m, world]."""
    high_m: tuple[float, float, float]
    """Upper corner."""


def run_zones(
    seen: Iterable[Seen], zones: Sequence[Zone], settings: PipelineSettings, healths: Sequence[Health]
) -> Iterator[Step]:
    """Turn frame sets with the detections of all cameras into tracks, zone by zone; one Step a pulse, of all zones.

    A step's track numbers encode the zone (see ``of_zones``); a target that two zones see occurs twice until its
    tracks are stitched (``mosca.stitching.stitch``). ``seconds`` are sums over the zones. ``healths``: one of each
    zone. InputError where two zones share a camera: their errors would not be independent.
    """
    check_zones(zones)
    shares = tee(seen, len(zones))
    runs = [
        run_seen(
            _share(one, zone),
            zone.rig,
            replace(settings, volume=(zone.low_m, zone.high_m), lookahead=0),
            None,
            health,
        )
        for one, zone, health in zip(shares, zones, healths, strict=True)
    ]
    for steps in zip(*runs, strict=True):
        yield _joined(steps)


def check_zones(zones: Sequence[Zone]) -> None:
    """Raise InputError where the zones cannot be run side by side."""
    whose: dict[str, str] = {}
    for zone in zones:
        for camera in zone.rig.names:
            if camera in whose:
                raise InputError(
                    f"zones '{whose[camera]}' and '{zone.name}': both have camera '{camera}'; each zone has its own"
                )
            whose[camera] = zone.name


def of_zones(tracks: Tracks, zones: Sequence[Zone]) -> dict[str, Tracks]:
    """Return each zone's own tracks from the samples of ``run_zones``."""
    found = {}
    for k, zone in enumerate(zones):
        own = tracks.select(tracks.track % len(zones) == k)
        found[zone.name] = replace(own, track=own.track // len(zones))
    return found


def _share(seen: Iterable[Seen], zone: Zone) -> Iterator[Seen]:
    """Yield the detections of a zone's cameras, with their share of the detection time."""
    names = frozenset(zone.rig.names)
    for frame_set, detections, seconds in seen:
        share = sum(name in names for name in detections) / max(len(detections), 1)
        yield (
            replace(frame_set, frames={n: f for n, f in frame_set.frames.items() if n in names}),
            {name: found for name, found in detections.items() if name in names},
            seconds * share,
        )


def _joined(steps: Sequence[Step]) -> Step:
    """Return the steps of all zones as one."""
    frames = {name: frame for step in steps for name, frame in step.frame_set.frames.items()}
    detections = {name: found for step in steps for name, found in step.detections.items()}
    seconds = {stage: sum(step.seconds[stage] for step in steps) for stage in steps[0].seconds}
    samples = [replace(step.samples, track=step.samples.track * len(steps) + k) for k, step in enumerate(steps)]
    first = steps[0].frame_set
    return Step(
        FrameSet(first.pulse, first.time_ns, frames), detections, _points(steps), Samples.joined(samples), seconds
    )


def _points(steps: Sequence[Step]) -> Points:
    """Return the points of all zones; ``rays`` index the concatenated detections of the zones' cameras."""
    parts = [step.points for step in steps]
    widths = [np.asarray(part.rays).shape[1] for part in parts]
    rays = np.full((sum(map(len, parts)), sum(widths)), -1)
    row = column = 0
    for part, width in zip(parts, widths, strict=True):
        rays[row : row + len(part), column : column + width] = part.rays
        row, column = row + len(part), column + width
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in Points.__dataclass_fields__
        if name != "rays"
    }
    return Points(**columns, rays=rays)
