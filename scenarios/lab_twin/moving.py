"""Moving targets: timing of the cameras from a recording with calibrated cameras."""

from mosca.accuracy.lab_twin.estimates import Told
from mosca.accuracy.lab_twin.moving_targets import observe
from mosca.accuracy.lab_twin.timing import timing_estimates
from mosca.data.rig import Rig
from mosca.pipeline import run
from scenarios.lab_twin.recordings import LabRecording, opened


def timing_of(one: LabRecording | None, rig: Rig | None, names: tuple[str, ...], fps: float | None) -> list[Told]:
    """Return jitter, delays and row times of the cameras ``names``, or what is missing for them."""
    if one is None or rig is None:
        return timing_estimates(None, names)
    with opened(one, rig, fps) as source:
        seen = observe(run(source, rig), rig)
    return timing_estimates(seen, rig.names)
