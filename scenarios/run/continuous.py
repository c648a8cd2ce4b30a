"""Processing of a scenario's frames by ``mosca.continuous``: tracks, counts and notes of the run."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mosca.continuous.association.associate import AssociationSettings
from mosca.continuous.estimator.estimate import ContinuousSettings
from mosca.continuous.moving_cameras.body_worn import Worn, reconstruct_worn
from mosca.continuous.reconstruct import EstimatedClock, Reconstructed, reconstruct
from mosca.data.arrays import Array
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.pipeline import PipelineSettings
from mosca.synchronisation import Assembly
from scenarios.build.worn_rig import known_lamps
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected


def pulses_ns(spec: Scenario) -> Array:
    """Return the pulses' nominal mid-exposures (t,), session clock [ns]."""
    capture = spec.capture
    return np.rint((np.arange(capture.pulses) / capture.frame_rate_hz + 0.5 * capture.exposure_s) * 1e9).astype(
        np.int64
    )


def collect_continuous(
    source: FrameSource,
    rig: Rig,
    settings: PipelineSettings,
    spec: Scenario,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Collected, Reconstructed | Worn]:
    """Run ``mosca.continuous`` on a source's frames; tracks at the pulses' instants."""
    keys = spec.continuous
    assert keys is not None
    begin = time.perf_counter()

    def attend(done: int) -> None:
        if progress is not None:
            progress(done, max(done, spec.capture.pulses * len(rig.cameras)))

    gathering = AssociationSettings(settings, keys.clocks, keys.search_s)
    wanted = ContinuousSettings(clocks=keys.estimate, limbs=keys.limbs, knot_s=keys.knot_s)
    worn: Worn | None = None
    if keys.moving:
        known, lamps = known_lamps(spec, rig)
        worn = reconstruct_worn(source, rig, known, lamps, gathering, wanted, attend=attend)
        found = worn.reconstructed
    else:
        found = reconstruct(source, rig, gathering, wanted, attend=attend)
    tracks = found.tracks(pulses_ns(spec))
    assembly = Assembly(frames=sum(found.gathered.count.frames.values()))
    assembly.notes.update({f"continuous {k + 1}": line for k, line in enumerate(found.findings)})
    if worn is None:
        assembly.notes.update({f"clock {one.camera}": clock_line(one) for one in found.clocks[1:]})
    else:
        assembly.notes.update(lamp_notes(worn))
    seconds = {"continuous": time.perf_counter() - begin, "estimate": float(found.estimated.seconds)}
    return Collected(tracks, (), -1, assembly, seconds, {}), found if worn is None else worn


def clock_line(clock: EstimatedClock) -> str:
    """Return a camera's clock in words, with 95 % intervals."""
    line = (
        f"starts {clock.offset_s:+.6f} s (+- {1.96 * clock.offset_sigma_s:.1g}) against the first camera's, runs "
        f"{-1e6 * clock.drift / (1.0 + clock.drift):+.2f} ppm (+- {1.96e6 * clock.drift_sigma:.1g}) fast"
    )
    if clock.row_time_s:
        line += f", {1e6 * clock.row_time_s:.3g} us (+- {1.96e6 * clock.row_time_sigma_s:.1g}) from row to row"
    return line


def record_clocks(found: Reconstructed) -> dict[str, Any]:
    """Return offsets, drifts and their standard deviations, camera by camera, for the record."""
    return {
        one.camera: {
            "origin_ns": one.origin_ns,
            "offset_s": one.offset_s,
            "offset_sigma_s": one.offset_sigma_s,
            "drift_ppm": 1e6 * one.drift,
            "drift_sigma_ppm": 1e6 * one.drift_sigma,
            "row_time_us": 1e6 * one.row_time_s,
            "row_time_sigma_us": 1e6 * one.row_time_sigma_s,
        }
        for one in found.clocks
    }


def lamp_notes(worn: Worn) -> dict[str, str]:
    """Return notes on how cameras and lamps were found."""
    found = worn.reconstructed
    known = np.isfinite(worn.lamp_poses.centres).all(axis=2).mean(axis=0)
    shares = ", ".join(
        f"{name} {100 * share:.0f} %" for name, share in zip(found.rig.names, known, strict=True) if share < 1.0
    )
    code, images = (sum(int((one >= 0).sum()) for one in of) for of in (worn.by_code, worn.lamp))
    return {
        "lamps": (
            f"{code} images of lamps were told by their numbers, {images - code} by where they had to be; they lie "
            f"{worn.lamp_rms_px:.2f} px rms an axis from the estimated poses"
        ),
        "poses": f"lamps alone told where cameras were at these shares of the instants: {shares or 'all'}",
    }
