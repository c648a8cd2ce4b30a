"""Pictures of each disturbance, with and without it, made by the twin itself."""

from collections.abc import Callable

from reports.fidelity import Crop
from scenarios.fidelity import pictures_camera, pictures_light
from scenarios.fidelity.demo_scene import Panels

CROPS: tuple[Panels, ...] = (*pictures_camera.CROPS, *pictures_light.CROPS)


def all_crops(progress: Callable[[int, int], None] = lambda done, total: None) -> list[Crop]:
    """Return all pictures; the same bytes each time."""
    made = []
    for number, make in enumerate(CROPS):
        progress(number, len(CROPS))
        made.append(make())
    progress(len(CROPS), len(CROPS))
    return made
