"""Labels of a scenario's tracks from a surface model."""

from pathlib import Path

from mosca.data.tracks import Tracks
from mosca.labelling.surface.label import label_surface
from mosca.labelling.surface.model import FACE, read_surface_model
from scenarios.build.scene import beside
from scenarios.score.people import with_labels_swapped
from scenarios.spec.faults import LabelFault
from scenarios.spec.scenario import Scenario


def surface_labels(spec: Scenario, folder: Path, tracks: Tracks) -> Tracks:
    """Return ``tracks`` with labels of the scenario's surface model, and with the scenario's fault, if there is one.

    The model's file is relative to ``folder``. InputError where it is not such a file.
    """
    assert spec.labels is not None
    model = read_surface_model(FACE if spec.labels.model == "face" else beside(spec.labels.model, folder))
    labelled = label_surface(tracks, model).tracks
    if isinstance(spec.fault, LabelFault):
        labelled = with_labels_swapped(labelled, spec.fault.pairs)
    return labelled
