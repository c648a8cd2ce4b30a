"""Labels from a template of a marker set: no training, no static pose."""

from pathlib import Path

import numpy as np

from mosca.data.files.whole_file import check_writable
from mosca.errors import InputError
from mosca.formats.bodies.model_file import write_model
from mosca.formats.tracks.tracks_file import check_tracks_file, read_tracks, write_tracks
from mosca.labelling.automatic.label import AutomaticLabels, label_automatically
from mosca.labelling.automatic.template import MarkerTemplate, read_template
from mosca.labelling.marker_model import learn_model
from scenarios.commands.labels import rate_of


def label_auto(path: Path, out: Path, set_name: str | None, model: Path | None, fps: float | None) -> list[str]:
    """Name the tracks in ``path`` by a template, write them to ``out`` and return the lines to print.

    ``set_name``: a set of the template that comes with mosca, or a template file. ``model``: where to write this
    person's marker model. InputError where that cannot be.
    """
    check_tracks_file(out)
    if model is not None:
        if model.suffix.lower() != ".toml":
            raise InputError(f"{model}: suffix '{model.suffix}' given; a marker model is a .toml file")
        check_writable(model)
    template = _template(set_name)
    tracks = read_tracks(path)
    done = label_automatically(tracks, template)
    rate = rate_of(done.tracks, fps, path)
    found = [name for name in template.names if (done.tracks.label == name).any()]
    if not found:
        raise InputError(
            f"{path}: no track can be named; z must be up and the person stand in some frame, with ten or more "
            "markers of the set (--set); or name tracks yourself: mosca labels learn"
        )
    write_tracks(done.tracks, out, rate)
    if model is not None:
        write_model(learn_model(done.tracks, None), model)
    return _lines(done, template, found, out)


def _template(set_name: str | None) -> MarkerTemplate:
    if set_name is not None and set_name.lower().endswith(".toml"):
        return read_template(Path(set_name))
    return read_template(set_name=set_name)


def _lines(done: AutomaticLabels, template: MarkerTemplate, found: list[str], out: Path) -> list[str]:
    labelled = done.tracks.label != ""
    least = {name: float(done.probability[done.tracks.label == name].min()) for name in found}
    lines = [
        f"{len(found)} of {len(template.names)} markers of the set found: {', '.join(found)}",
        f"{np.count_nonzero(labelled)} of {len(done.tracks)} samples have a label, in {out}",
    ]
    doubtful = sorted((p, name) for name, p in least.items() if p < 0.99)
    if doubtful:
        lines.append("less sure than 0.99 somewhere: " + ", ".join(f"{name} {p:.2f}" for p, name in doubtful))
    return lines
