"""All checks of the virtual cameras against outside witnesses, in the order of the table."""

from collections.abc import Callable

from reports.fidelity import Check
from scenarios.fidelity.blur import pupil_blur
from scenarios.fidelity.hidden import occlusion
from scenarios.fidelity.peers import mujoco_renderer, pyrender_renderer
from scenarios.fidelity.printed import figures, profiles
from scenarios.fidelity.sensor import sensors
from scenarios.fidelity.shutter import motion
from scenarios.fidelity.static_markers import lens_models, real_lenses, still_markers

CHECKS: tuple[Callable[[bool], Check], ...] = (
    still_markers,
    real_lenses,
    lens_models,
    motion,
    pupil_blur,
    figures,
    profiles,
    occlusion,
    sensors,
    mujoco_renderer,
    pyrender_renderer,
)
"""Pure functions: whether to be quick -> Check. Each plants faults of its own, which it must catch."""


def run_checks(quick: bool, progress: Callable[[int, int], None] = lambda done, total: None) -> list[Check]:
    """Return the results of all checks; ``progress`` is called with the number done and the number of all."""
    found = []
    for number, check in enumerate(CHECKS):
        progress(number, len(CHECKS))
        found.append(check(quick))
    progress(len(CHECKS), len(CHECKS))
    return found
