"""The record of a run, and the further data for its page."""

import math
from collections.abc import Mapping
from dataclasses import asdict, astuple, replace
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.data.truth import Truth
from mosca.diagnostics.camera_health import CameraHealth
from mosca.diagnostics.sensor import Estimate, LearnedSensor
from mosca.machines.vibration.analysis import Vibration
from mosca.skeleton.isb_angles import isb_angles
from reports.evidence import CameraView, ErrorTable, Evidence, MarkerCounts
from reports.metrics import METRICS
from reports.record import Metric, MetricBlocks, RunRecord
from scenarios.build.cameras import Calibrated, deliveries
from scenarios.run.people import Person
from scenarios.run.provenance import provenance
from scenarios.run.vibration import vibration_evidence
from scenarios.run.virtual import virtual_evidence
from scenarios.score.controls import control_verdict
from scenarios.score.delivery import expected_sets, expected_share, frame_losses, losses, weakest
from scenarios.score.limits import loose_limits
from scenarios.score.people import true_motion
from scenarios.score.sensor import StatedSensor
from scenarios.score.tracks import SEEN_SHARE, limits_met
from scenarios.spec.limits import end_of
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected, Score, Scored
from scenarios.virtual.objects import ShownPoses


def record_of(
    spec: Scenario, name: str, source: str, worth: Scored, timings: Mapping[str, float], known: Calibrated
) -> RunRecord:
    """Return the record of a run of ``source``; ``known``: the nominal calibration."""
    scores, collected, not_judged = worth.scores, worth.collected, worth.not_judged
    limits = {metric: limit for metric, limit in _limits(spec, worth).items() if metric not in not_judged}
    met = limits_met(scores, limits, lambda metric: METRICS[metric].sense)
    rows = tuple(
        _metric(metric, score, limits.get(metric), met, spec.breaks.get(metric))
        for metric, score in scores.items()
        if np.isfinite(score.value)
    )
    broken = [metric for metric, ok in met.items() if not ok]
    notes = " ".join(collected.assembly.notes.values())
    unnoticed = [phrase for phrase in spec.told if phrase not in notes]
    if spec.expect == "fail" and not not_judged:
        passed, verdict = control_verdict(scores, limits, met, spec.breaks)
    else:
        passed, verdict = _verdict(spec, broken, not_judged)
    incomplete = [name for name in ("sets_complete", "frames_complete") if name in broken]
    if incomplete and incomplete[0] not in spec.breaks:
        passed, verdict = False, f"{verdict}; {_missing(spec, collected)}"
    verdict = "; ".join((verdict, *loose_limits(rows, spec.loose_limit)))
    if unnoticed and not not_judged:
        passed, verdict = False, f"{verdict}; not noticed: {'; '.join(unnoticed)}"
    return RunRecord(
        scenario=name,
        title=spec.title,
        seed=spec.seed,
        source=source,
        model_gap=spec.model_gap,
        expect=spec.expect,
        passed=passed,
        verdict=verdict,
        metrics=rows,
        premises=worth.premises,
        counts=_counts(spec, collected),
        cameras=_cameras(collected),
        joints=worth.joints,
        modes=worth.modes,
        self_orientation=worth.self_orientation,
        error_budget=worth.error_budget,
        enough_alone=worth.enough_alone,
        source_account=collected.account,
        timings={key: float(value) for key, value in timings.items()},
        rig=_rig_words(spec),
        not_judged=not_judged,
        provenance={
            **provenance(),
            "model_gap_rms_px": round(known.gap_rms_px, 6),
            "model_gap_max_px": round(known.gap_max_px, 6),
            "parameters": spec.model_dump(mode="json"),
        },
    )


def position_limit_mm(spec: Scenario) -> float | None:
    """Return the limit of the rms position error [mm], stated itself or as a share of the space's longest edge."""
    given = {"position_rms": 1e3, "relative_accuracy": 1e3 * max(spec.working_space.size_m)}
    known = [(name, spec.limits[name], scale) for name, scale in given.items() if name in spec.limits]
    ends = [scale * (end_of(name, one) if isinstance(one, tuple) else one) for name, one, scale in known]
    return min(ends, default=None)


def with_changed(record: RunRecord, changed: Mapping[str, tuple[Any, Any]]) -> RunRecord:
    """Return ``record`` with the differences from the scenario's file: key -> (value there, value of this run)."""
    if not changed:
        return record
    return replace(record, provenance={**record.provenance, "changed": {key: list(v) for key, v in changed.items()}})


def _rig_words(spec: Scenario) -> str:
    return "true" if spec.session is None else f"estimated from a {spec.session.target}"


def _limits(spec: Scenario, worth: Scored) -> dict[str, float | tuple[float, float]]:
    """Return the scenario's limits; all frame sets, or frames, must have come except for the stated losses."""
    if "frames_complete" in worth.scores:
        return {"frames_complete": weakest(worth.collected.frames).least} | spec.limits
    if "sets_complete" not in worth.scores:
        return dict(spec.limits)
    stated = deliveries(spec, worth.collected.assembly.cameras)
    pulses = _pulses(spec, worth.collected)
    return {"sets_complete": expected_share(stated, pulses, pulses / spec.capture.frame_rate_hz)} | spec.limits


def _pulses(spec: Scenario, collected: Collected) -> int:
    """Return the number of pulses for which there must be frame sets."""
    return expected_sets(collected.assembly, spec.capture.pulses, collected.account)


def _missing(spec: Scenario, collected: Collected) -> str:
    """Return a description of the missing frames."""
    if collected.frames:
        return frame_losses(collected.frames)
    return losses(collected.assembly, _pulses(spec, collected), spec.capture.frame_rate_hz)


def _metric(
    name: str,
    score: Score,
    limit: float | tuple[float, float] | None,
    met: Mapping[str, bool],
    within: tuple[float, float] | None,
) -> Metric:
    kind = METRICS[name]
    if isinstance(limit, tuple):
        within, limit = within or limit, end_of(name, limit)
    return Metric(
        name, score.value, kind.unit, score.n, score.ci95, "none", limit, kind.sense, met.get(name),
        MetricBlocks(score.sums, score.weights) if score.sums else None, within=within,
    )  # fmt: skip


def _verdict(spec: Scenario, broken: list[str], not_judged: tuple[str, ...]) -> tuple[bool, str]:
    """Return whether the run is as claimed, and the same in words. A limit that could not be judged does not pass."""
    found = "every limit is met" if not broken else f"broken: {', '.join(broken)}"
    if not_judged:
        rest = [name for name in spec.limits if name not in not_judged and name not in broken]
        found = f"broken: {', '.join(broken)}; " if broken else f"met: {', '.join(rest)}; " if rest else ""
        return False, f"{found}not judged, for want of a truth: {', '.join(not_judged)}"
    return not broken, found


def _counts(spec: Scenario, collected: Collected) -> dict[str, Any]:
    assembly = collected.assembly
    tracks = collected.tracks
    samples = {"tracks": len(np.unique(tracks.track)), "samples": len(tracks)}
    if collected.frames:
        return {
            "expected_frames": sum(one.expected for one in collected.frames.values()),
            "frames": assembly.frames,
            "corrupt": sum(one.unusable for one in collected.frames.values()),
            **samples,
            "notes": dict(assembly.notes),
        }
    return {
        "expected_sets": _pulses(spec, collected),
        "frames": assembly.frames,
        "frame_sets": assembly.sets,
        "complete_sets": assembly.complete_sets,
        "empty_sets": assembly.empty_sets,
        "dropped": sum(c.dropped for c in assembly.cameras.values()),
        "corrupt": sum(c.corrupt for c in assembly.cameras.values()),
        "late": sum(c.late for c in assembly.cameras.values()),
        **samples,
        "skipped_sets": assembly.skipped_sets,
        "notes": dict(assembly.notes),
    }


def _cameras(collected: Collected) -> dict[str, dict[str, Any]]:
    """Return each camera's health, and the account of its frames; for a continuous run only the latter."""
    if collected.frames:
        return {name: asdict(one) | {"complete": one.share} for name, one in collected.frames.items()}
    counts = collected.assembly.cameras
    sensors = {one.name: {"sensor": sensor_record(one, collected.stated.get(one.name))} for one in collected.sensors}
    return {
        one.name: health_record(one)
        | (asdict(counts[one.name]) if one.name in counts else {})
        | sensors.get(one.name, {})
        for one in collected.cameras
    }


def sensor_record(one: LearnedSensor, stated: StatedSensor | None = None) -> dict[str, Any]:
    """Return the estimates of a sensor from the camera's images, for the record; an interval is [value, low, high].

    ``stated``: the sensor's values from a data sheet, where known.
    """
    values = {
        key: [float(f"{part:.5g}") for part in astuple(value)] if isinstance(value, Estimate) else value
        for key, value in vars(one).items()
    }
    del values["name"]
    return values | {"saturation_dn": one.saturation_dn, "stated": stated and asdict(stated)}


def health_record(one: CameraHealth) -> dict[str, Any]:
    """Return a camera's health for the record; unknown values are None."""
    values = {key: value for key, value in asdict(one).items() if key != "name"}
    values["residuals_px"] = [round(value, 4) for value in one.residuals_px]
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }


def evidence_of(
    spec: Scenario,
    rig: Rig,
    worth: Scored,
    person: Person | None = None,
    vibration: Vibration | None = None,
    shown: ShownPoses | None = None,
) -> Evidence:
    """Return the data for the page; without a truth these are only the tracks.

    ``person`` and ``vibration``: those of the scene; ``shown``: virtual objects, drawn where their errors are known.
    """
    collected, truth, pairs = worth.collected, worth.truth, worth.pairs
    base = Evidence(
        rig,
        np.array(spec.working_space.center_m),
        np.array(spec.working_space.size_m),
        collected.tracks,
        collected.views,
        kept_sets=collected.kept_sets,
        measured_by=collected.measured_by,
        vibration=None if vibration is None else vibration_evidence(vibration),
        virtual=None if shown is None or worth.objects is None else virtual_evidence(shown, worth.objects),
    )
    if person is not None:
        base = replace(base, angles=person.angles, joints=person.take.joints)
        if truth is not None and truth.joints is not None:
            true = true_motion(truth)
            base = replace(base, true_angles=isb_angles(true), true_joints=true)
    if truth is None or pairs is None:
        return base
    time_s = truth.time_ns * 1e-9
    pulse = min(max(collected.view_pulse, 0), len(truth.time_ns) - 1)
    beside = replace(
        base,
        truth_time_ns=truth.time_ns,
        truth_xyz=truth.xyz,
        truth_names=truth.names,
        errors=ErrorTable(pairs.frame, time_s[pairs.frame], pairs.marker, pairs.error_m, pairs.row),
    )
    if not truth.cameras:  # a user's own reference: the visibility of markers is unknown
        return beside
    return replace(
        beside,
        views=tuple(_with_truth(v, truth, pulse) for v in collected.views),
        could_see=_could_see(truth, rig),
        marker_seen=pairs.seen_mask.sum(axis=0),
        counts=MarkerCounts(time_s, pairs.seen, pairs.seen - pairs.missed, pairs.ghosts),
    )


def _could_see(truth: Truth, rig: Rig) -> Array | None:
    """Return whether each marker was visible to each of the rig's cameras (t, m, c); None if one has no truth."""
    if not set(rig.names) <= set(truth.cameras):
        return None
    seen: Array = truth.visible[:, :, [truth.cameras.index(name) for name in rig.names]] >= SEEN_SHARE
    return seen


def _with_truth(view: CameraView, truth: Truth, pulse: int) -> CameraView:
    c = truth.cameras.index(view.camera)
    xy: Array = truth.image_xy_px[pulse, :, c]
    return replace(view, true_xy_px=xy[np.isfinite(xy).all(axis=1) & (truth.visible[pulse, :, c] > 0)])
