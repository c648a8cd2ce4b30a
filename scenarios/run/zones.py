"""Zones of a scenario: reconstruction of each zone, and stitching of their tracks into one set."""

from collections.abc import Iterator, Sequence

import numpy as np

from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.detection.scheduler import FrameSetDetector, detect_ahead
from mosca.diagnostics.camera_health import Health
from mosca.diagnostics.sensor import Sensors
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, Step, check_source
from mosca.stitching.run import Zone, check_zones, of_zones, run_zones
from mosca.stitching.stitch import stitched
from mosca.synchronisation import Assembly, assemble
from scenarios.build.scene import MARGIN
from scenarios.spec.scenario import Scenario


def zones_of(spec: Scenario, rig: Rig) -> tuple[Zone, ...]:
    """Return the scenario's zones (maybe none) with the cameras of ``rig``; InputError for an unknown camera."""
    zones = []
    for one in spec.zone:
        unknown = [name for name in one.cameras if name not in rig.names]
        if unknown:
            raise InputError(
                f"[[zone]] name = '{one.name}': no camera '{unknown[0]}'; the rig has {', '.join(rig.names)}"
            )
        half = MARGIN * np.array(one.size_m) / 2
        low, high = np.array(one.center_m) - half, np.array(one.center_m) + half
        cameras = tuple(rig.camera(name) for name in one.cameras)
        zones.append(Zone(one.name, Rig(cameras), (low[0], low[1], low[2]), (high[0], high[1], high[2])))
    check_zones(zones)
    return tuple(zones)


def zone_steps(
    source: FrameSource,
    zones: Sequence[Zone],
    rig: Rig,
    settings: PipelineSettings,
    assembly: Assembly,
    healths: Sequence[Health],
    sensors: Sensors,
) -> Iterator[Step]:
    """Reconstruct tracks from a source's frames, zone by zone; ``rig``: that of all cameras."""
    check_source(source, rig)
    sets = assemble(source, source.cameras, settings.assembly, assembly)
    look = FrameSetDetector(settings.detection, {info.name: info.bit_depth for info in source.cameras})
    seen = detect_ahead(look, sets, settings.workers, settings.split or 1, sensors.attend, settings.lookahead)
    yield from run_zones(seen, zones, settings, healths)


def tracks_of_all(tracks: Tracks, zones: Sequence[Zone], assembly: Assembly) -> Tracks:
    """Return the tracks of ``run_zones`` as one set; remarks on the zones are added to the notes."""
    result = stitched(of_zones(tracks, zones))
    assembly.notes["zones"] = stitching_line(result.handed_over, result.merged)
    for k, note in enumerate(result.notes):
        assembly.notes[f"zones {k + 1}"] = note
    return result.tracks


def stitching_line(handed_over: int, merged: int) -> str:
    """Return the numbers of stitched targets and samples in words."""
    return f"{handed_over} targets handed over between zones, {merged} samples merged from two zones or more"
