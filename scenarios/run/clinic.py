"""A scenario whose fault the clinic must name first: frames with the fault, the assumed rig, a verdict."""

from contextlib import ExitStack

from mosca.clinic.diagnose import ClinicReport, KnownLengths, diagnose_frames, diagnose_tracks
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.tracks import table
from mosca.pipeline import PipelineSettings, run
from scenarios.build.planted_faults import PlantedSource, swapped
from scenarios.run.pipeline import recorded
from scenarios.spec.scenario import Scenario
from scenarios.types import RunOptions, TruthSource


def clinic_report(
    spec: Scenario, source: FrameSource, twin: TruthSource | None, believed: Rig, settings: PipelineSettings,
    options: RunOptions, stack: ExitStack,
) -> ClinicReport:  # fmt: skip
    """Return the clinic's report on the frames of ``source``, with the faults of ``spec`` planted in them.

    The clinic gets frames, the assumed rig, and the input of a person, but no truth.
    """
    told = spec.clinic
    assert told is not None
    read = recorded(PlantedSource(source, told), twin, options, spec, stack)
    if told.swapped is not None:
        tracks = table([step.samples for step in run(read, believed, settings)])
        return diagnose_tracks(swapped(tracks, told.swapped, spec.capture.frame_rate_hz), None)
    lengths = () if told.known_length_m is None else (told.known_length_m,)
    return diagnose_frames(read, believed, KnownLengths(lengths))


def verdict(spec: Scenario, report: ClinicReport) -> tuple[bool, str]:
    """Return whether the right cause ranks first, and the same in words."""
    told = spec.clinic
    assert told is not None
    codes = [one.code for one in report.causes]
    first = codes[0] if codes else "none"
    more = f" (then {', '.join(codes[1:])})" if codes[1:] else ""
    if first == "none" and report.not_judged:
        return False, f"not judged: {report.not_judged[0]}"
    if first == told.cause:
        evidence = f": {report.causes[0].evidence[-1]}" if report.causes else ""
        return True, f"diagnosed as it must be: {first}{more}{evidence}"
    return False, f"not diagnosed: '{told.cause}' should have come first; first was {first}{more}"
