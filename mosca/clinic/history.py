"""Earlier evidence: warnings of the calibration that a take uses, and the cameras' health in the take's record."""

from collections.abc import Sequence

from mosca.clinic.causes import Diagnosis, merged
from mosca.data.calibration import Finding
from mosca.data.distributions import norm
from mosca.diagnostics.camera_health import CameraHealth, HealthSettings

CAUSE_OF = {
    "mirrored-pose": "mirrored-pose", "little-depth": "weak-calibration", "few-views": "weak-calibration",
    "weak-link": "weak-calibration", "little-coverage": "weak-calibration", "weak-parameter": "weak-calibration",
    "no-link": "weak-calibration", "wrong-size": "wrong-scale", "mixed-units": "wrong-scale",
    "scale-error": "wrong-scale", "rig-moved": "camera-moved", "interior-ran-away": "wrong-lens",
    "lens-model": "wrong-lens",
}  # fmt: skip
"""Finding of a calibration -> the cause that it warns of; findings that are not listed warn of none."""
NO_CHANCE = 1.0
"""P-value given to a warning, which is no test of the take: it ranks behind every test."""


def calibration_causes(findings: Sequence[Finding]) -> list[Diagnosis]:
    """Return the causes that a calibration's warnings and refusals point to, each once."""
    return merged(
        Diagnosis(CAUSE_OF[one.code], NO_CHANCE, (said(one),), camera=one.camera)
        for one in findings
        if one.severity != "note" and one.code in CAUSE_OF
    )


def said(one: Finding) -> str:
    """Return a finding as a line of evidence."""
    return f"calibration, {'refused' if one.severity == 'refuse' else 'warning'} {one.code}: {one.message}"


def health_causes(cameras: Sequence[CameraHealth], period_s: float, alpha: float) -> list[Diagnosis]:
    """Return cameras that exposed late in a run, by whole periods or any time; ``alpha``: of all cameras together."""
    settings, found = HealthSettings(), []
    for one in cameras:
        if not abs(one.late_s) > settings.late_s:  # NaN: not known
            continue
        chance = 2 * len(cameras) * float(norm.sf(abs(one.late_s) / one.late_sigma_s))
        periods = round(one.late_s / period_s)
        whole = periods != 0 and abs(one.late_s - periods * period_s) < settings.late_s + 3 * one.late_sigma_s
        text = (
            f"camera '{one.name}' exposes {1e3 * abs(one.late_s):.2f} ms {'later' if one.late_s > 0 else 'earlier'} "
            f"than the others' mean ({1e6 * settings.late_s:.0f} us allowed; p = {chance:.1g})"
        )
        if chance < alpha:
            code = "frames-one-off" if whole else "sync-lost"
            found.append(Diagnosis(code, chance, (text,), camera=one.name, figures={"late_s": one.late_s}))
    return merged(found)


def poorly_connected(cameras: Sequence[CameraHealth]) -> list[str]:
    """Return the cameras that a run could not judge: their detections hardly meet those of others."""
    return [
        f"camera '{one.name}': in the run {100 * one.connected:.0f} % of its detections met those of other cameras; "
        "give its recording and --rig, so that the cause can be looked for"
        for one in cameras
        if one.connected < HealthSettings().poor_share
    ]
