"""From a take to its likeliest cause: gather the evidence once, test each cause, order the causes found.

A whole take raises a false alarm with chance ``FALSE_ALARMS`` at most: each test has its share (Bonferroni). The
order is: contradictions between files; causes of the rays' misfit, by their deviance; faults that images and stamps
show, which come first where no cause explains half of the misfit; faults that tracks show. A later cause is often a
consequence of an earlier one: a moved camera loses markers and swaps labels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.clinic.causes import CAUSES, Diagnosis
from mosca.clinic.geometry import MOVED_PX, geometry_causes
from mosca.clinic.images import MARKERS, ImageWitness, image_causes, reflection_causes
from mosca.clinic.lost_camera import lost_cameras
from mosca.clinic.misfit import residuals_of
from mosca.clinic.observations import CONNECTED, LADDER_PX, PointImages, observe
from mosca.clinic.stamps import StampWitness, WitnessedSource, row_causes, stamp_causes, track_stamp_causes
from mosca.clinic.tracks import TAPE_M, label_causes, length_causes, places_of, swap_causes
from mosca.data.bodies import BodyPoses
from mosca.data.detections import Seen
from mosca.data.frames import CameraInfo, FrameSource
from mosca.data.rig import Rig
from mosca.data.settings import DetectionSettings
from mosca.data.tracks import Tracks
from mosca.detection.scheduler import FrameSetDetector, detect_ahead
from mosca.errors import InputError
from mosca.synchronisation import assemble

FALSE_ALARMS = 1e-3
"""Chance of an alarm in a take without a fault."""
ALPHA = FALSE_ALARMS / len(CAUSES)
"""Chance of a false alarm for each cause."""
NO_MARKERS = (
    f"in no camera {100 * MARKERS:.0f} % of what is detected meets other cameras' rays: these are other things than "
    "markers (a board: mosca calibrate), or the rig is not theirs"
)
GEOMETRY, WITNESSES, TRACKS = range(3)
KIND = {
    "other-resolution": GEOMETRY, "wrong-lens": GEOMETRY, "camera-moved": GEOMETRY, "mirrored-pose": GEOMETRY,
    "mixed-calibrations": GEOMETRY, "warming": GEOMETRY, "frames-one-off": GEOMETRY, "dropped-unnoticed": GEOMETRY,
    "sync-lost": GEOMETRY, "rolling-shutter": GEOMETRY, "arrival-stamps": WITNESSES, "focus-drift": WITNESSES,
    "saturated": WITNESSES, "reflections": WITNESSES, "markers-merged": WITNESSES, "wrong-scale": TRACKS,
    "weak-calibration": TRACKS, "labels-swapped": TRACKS, "bodies-swapped": TRACKS,
}  # fmt: skip


@dataclass(frozen=True)
class KnownLengths:
    """Lengths [m] that a person measured between two markers of a rigid body, and their standard deviation [m]."""

    lengths_m: tuple[float, ...] = ()
    sigma_m: float = TAPE_M


@dataclass(frozen=True)
class ClinicReport:
    """Causes found, likeliest first; ``looked_at``: data that the evidence uses, a line each; ``not_judged``: reasons
    why a fault might have gone unseen, a line each.
    """

    causes: tuple[Diagnosis, ...]
    looked_at: tuple[str, ...]
    not_judged: tuple[str, ...] = ()


def diagnose_sizes(rig: Rig, cameras: Sequence[CameraInfo]) -> list[Diagnosis]:
    """Return the cameras whose images differ in size from the rig file."""
    infos = {info.name: info for info in cameras}
    wrong = [
        f"camera '{c.name}': images are {infos[c.name].width} x {infos[c.name].height} px, the rig file says "
        f"{c.width} x {c.height}"
        for c in rig.cameras
        if c.name in infos and (c.width, c.height) != (infos[c.name].width, infos[c.name].height)
    ]
    return [Diagnosis("other-resolution", 0.0, tuple(wrong))] if wrong else []


def diagnose_frames(source: FrameSource, rig: Rig, known: KnownLengths | None = None) -> ClinicReport:
    """Return the faults found in the frames of ``source``, or in the rig with which they are measured."""
    if wrong := diagnose_sizes(rig, source.cameras):
        return ClinicReport(tuple(wrong), ("sizes of the images and of the rig file",))
    missing = [name for name in rig.names if name not in [info.name for info in source.cameras]]
    if missing:
        raise InputError(f"camera '{missing[0]}' of the rig sends no frames; give the cameras the same names in both")
    images, stamps = ImageWitness(source.cameras), StampWitness()
    look = FrameSetDetector(DetectionSettings(), {info.name: info.bit_depth for info in source.cameras}, {})
    seen: list[Seen] = []
    for frame_set, detections, seconds in detect_ahead(
        look, assemble(WitnessedSource(source, stamps), source.cameras), 0, 1, None, 64
    ):
        images.attend(frame_set, detections)
        # keep the frame set without its images: a take of minutes must fit into memory
        bare = {name: replace(f, image=None, status="dropped") for name, f in frame_set.frames.items()}
        seen.append((replace(frame_set, frames=bare), detections, seconds))
    rate_hz = source.cameras[0].frame_rate_hz
    if not seen:
        return ClinicReport((), (), ("there are no frames",))
    observed = observe(seen, rig)
    connected = dict(zip(rig.names, observed.connected.tolist(), strict=True))
    found = image_causes(images, connected, rate_hz, ALPHA)
    told = [
        f"{len(seen)} frame sets of {len(rig.cameras)} cameras, {len(observed)} points, matched to "
        f"{observed.matched_px:g} px; in points: "
        + ", ".join(f"{n} {100 * s:.0f} %" for n, s in zip(rig.names, observed.connected, strict=True))
    ]
    if not len(observed) or observed.connected.max() < MARKERS:
        found += stamp_causes(stamps, None, 1.0 / rate_hz, ALPHA)
        return ClinicReport(tuple(in_order(found)), tuple(told), (NO_MARKERS,))
    residuals = residuals_of(observed, rig, rate_hz)
    if not len(residuals.rest):
        short = (
            f"no point is followed over enough of the {len(seen)} frame sets to have a speed; give a longer take",
        )
        found += stamp_causes(stamps, None, 1.0 / rate_hz, ALPHA)
        return ClinicReport(tuple(in_order(found)), tuple(told), short)
    told.append(
        f"rays meet to {residuals.unit_weight:.2f} times the stated noise, those of the half of the markers that fit "
        f"best to {residuals.better_half:.2f}"
    )
    lost = lost_cameras(seen, rig, observed)
    geometry = geometry_causes(residuals, rig, 1.0 / rate_hz, ALPHA)
    found += stamp_causes(stamps, residuals, 1.0 / rate_hz, ALPHA)
    found += row_causes(stamps, residuals, rig, MOVED_PX)
    found += lost + [one for one in geometry if one.code not in [other.code for other in lost]]
    if not lost:
        found += reflection_causes(seen, rig, observed, ALPHA)
    if known is not None and not lost and not geometry:
        found += length_causes(observed, known.lengths_m, known.sigma_m, ALPHA)
    unseen = () if lost or geometry else _not_judged(observed, rig)
    return ClinicReport(tuple(in_order(found)), tuple(told), unseen)


def _not_judged(observed: PointImages, rig: Rig) -> tuple[str, ...]:
    """Return why a fault of the rig may be hidden where rays meet badly for no known cause."""
    worst = int(np.argmin(observed.connected))
    if observed.matched_px <= LADDER_PX[0] or observed.connected[worst] >= CONNECTED:
        return ()
    share = 100 * observed.connected[worst]
    return (
        f"camera '{rig.names[worst]}': {share:.0f} % of its detections are in points: wrong pairs "
        "of rays hide a fault of the rig; give a take with fewer markers, which most cameras see whole",
    )


def diagnose_tracks(tracks: Tracks | None, bodies: BodyPoses | None) -> ClinicReport:
    """Return the faults that labels, stamps and body poses show, of a run or of a client's recording of a stream."""
    found, told, unseen = [], [], []
    if tracks is not None:
        if not np.isfinite(tracks.xyz).all(axis=1).any():
            unseen.append("no marker has a position in the tracks")
        found += label_causes(tracks, ALPHA)
        found += track_stamp_causes(tracks, ALPHA)
        told.append(f"{len(set(tracks.label.tolist()) - {''})} labels in {len(tracks)} samples")
    if bodies is not None:
        known = np.isfinite(bodies.position).all(axis=1)
        if not known.any():
            unseen.append("no body has a pose")
        found += swap_causes(
            places_of(bodies.body[known], bodies.frame[known], bodies.position[known]), ALPHA, bodies=True
        )
        told.append(f"{len(set(bodies.body.tolist()))} bodies")
    return ClinicReport(tuple(in_order(found)), tuple(told), tuple(unseen))


def joined(one: ClinicReport, other: ClinicReport) -> ClinicReport:
    """Return two reports as one."""
    return ClinicReport(
        tuple(in_order([*one.causes, *other.causes])),
        (*one.looked_at, *other.looked_at),
        (*one.not_judged, *other.not_judged),
    )


def in_order(found: Sequence[Diagnosis]) -> list[Diagnosis]:
    """Return the causes, likeliest first, each code once."""
    best: dict[str, Diagnosis] = {}
    for one in sorted(found, key=lambda one: (KIND[one.code], one.score, one.p_value)):
        best.setdefault(one.code, one)
    return list(best.values())
