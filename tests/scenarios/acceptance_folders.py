"""Folders with an acceptance test's inputs and results, made without cameras."""

import tomli_w
from acceptance_takes import bar_file, seven_lines

from mosca.formats.tracks.tracks_file import write_tracks


def write_take(folder, name="take", scale=1.00002, suffix=".npz", **rest):
    """Write tracks of a bar on seven lines and its acceptance file; return their paths."""
    folder.mkdir(exist_ok=True)
    tracks, artefact = folder / f"{name}{suffix}", folder / "bar.acceptance"
    write_tracks(seven_lines(scale, **rest), tracks, 100.0)
    artefact.write_text(tomli_w.dumps(_without_none(bar_file().model_dump(mode="json"))))
    return tracks, artefact


def _without_none(value):
    if isinstance(value, dict):
        return {key: _without_none(one) for key, one in value.items() if one is not None}
    return [_without_none(one) for one in value] if isinstance(value, list) else value
