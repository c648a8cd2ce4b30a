"""Labels from a template of a marker set, from a labelled take of the person, or from a surface model of a face."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mosca.data.files.file_kind import file_kind
from mosca.data.files.toml import read_toml
from mosca.data.files.whole_file import check_writable
from mosca.errors import InputError
from mosca.formats.bodies.model_file import write_model
from mosca.formats.tracks.csv_columns import integers, write_columns
from mosca.formats.tracks.tracks_file import check_tracks_file, read_tracks, write_tracks
from mosca.labelling.automatic.label import AutomaticLabels, label_automatically
from mosca.labelling.automatic.personal import personal_template
from mosca.labelling.automatic.template import MarkerTemplate, read_template
from mosca.labelling.marker_model import learn_model
from mosca.labelling.surface.label import label_surface
from mosca.labelling.surface.model import LEAST_MARKERS, SurfaceModel, read_surface_model
from scenarios.commands.labels import rate_of

PROBABILITIES = ("frame", "track", "label", "probability")
"""Columns of the file of probabilities."""


def label_auto(
    path: Path,
    out: Path,
    set_name: str | None,
    static: Path | None,
    model: Path | None,
    probabilities: Path | None,
    fps: float | None,
) -> list[str]:
    """Name the tracks in ``path`` by a template, write them to ``out`` and return the lines to print.

    ``set_name``: a set of the template that comes with mosca, "face", or a file of a template or a surface model.
    ``static``: a labelled take of the same person and markers. ``model``: file for this person's marker model;
    ``probabilities``: file for those of the labels, sample by sample. InputError where these cannot be used.
    """
    check_tracks_file(out)
    for file, what, suffix in (
        (model, "a marker model", ".toml"),
        (probabilities, "a file of probabilities", ".csv"),
    ):
        if file is not None:
            if file.suffix.lower() != suffix:
                raise InputError(f"{file}: suffix '{file.suffix}' given; {what} is a {suffix} file")
            check_writable(file)
    template = _template(set_name)
    if static is not None:
        if isinstance(template, SurfaceModel):
            raise InputError(f"{static}: a static pose is of a body; leave out --static with --set {set_name}")
        template = personal_template(read_tracks(static), template, str(static))
    tracks = read_tracks(path)
    if isinstance(template, SurfaceModel):
        done = label_surface(tracks, template)
    else:
        done = _in_the_sets_names(label_automatically(tracks, template), template)
    rate = rate_of(done.tracks, fps, path)
    found = np.unique(done.tracks.label[done.tracks.label != ""]).tolist()
    if not found:
        wanted = (
            f"{LEAST_MARKERS} or more markers of the model must be seen in some frame, in metres"
            if isinstance(template, SurfaceModel)
            else "z must be up and the person stand in some frame, with ten or more markers of the set"
        )
        raise InputError(
            f"{path}: no track can be named; {wanted} (--set); or name tracks yourself: mosca labels learn"
        )
    write_tracks(done.tracks, out, rate)
    if model is not None:
        write_model(learn_model(done.tracks, None), model)
    if probabilities is not None:
        _write_probabilities(done, probabilities)
    return _lines(done, template, found, out)


def _in_the_sets_names(done: AutomaticLabels, template: MarkerTemplate) -> AutomaticLabels:
    """Return labels with the names of the set that was found."""
    called = dict(zip(template.names, template.called(done.set_name), strict=True))
    names = np.array([called.get(name, name) for name in done.tracks.label.tolist()], dtype=np.str_)
    return replace(done, tracks=replace(done.tracks, label=names))


def _write_probabilities(done: AutomaticLabels, path: Path) -> None:
    tracks, given = done.tracks, done.tracks.label != ""
    columns = (
        integers(tracks.frame[given]),
        integers(tracks.track[given]),
        tracks.label[given].tolist(),
        [f"{p:.6f}" for p in done.probability[given]],
    )
    write_columns(path, PROBABILITIES, columns)


def _template(set_name: str | None) -> MarkerTemplate | SurfaceModel:
    if set_name is not None and set_name.lower() == "face":
        return read_surface_model()
    if set_name is not None and set_name.lower().endswith(".toml"):
        path = Path(set_name)
        if file_kind(read_toml(path)) == "surface-model":
            return read_surface_model(path)
        return read_template(path)
    return read_template(set_name=set_name)


def _lines(done: AutomaticLabels, template: MarkerTemplate | SurfaceModel, found: list[str], out: Path) -> list[str]:
    label = done.tracks.label
    least = sorted((float(done.probability[label == name].min()), name) for name in found)
    lines = [
        f"{len(found)} of {len(template.names)} markers of the set found, with the least probability of each:",
        ", ".join(f"{name} {_stated(p)}" for p, name in least),
        f"{np.count_nonzero(label != '')} of {len(label)} samples have a label, in {out}",
    ]
    if done.set_name:
        lines.insert(1, f"the set is {done.set_name}: these are its names")
    return lines


def _stated(probability: float) -> str:
    return "> 0.999" if probability > 0.999 else f"{probability:.3f}"
