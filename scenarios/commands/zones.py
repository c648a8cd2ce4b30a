"""Stitching of the tracks files of zones into one."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import check_tracks_file, read_tracks, write_tracks
from mosca.stitching.stitch import stitched
from scenarios.commands.labels import rate_of
from scenarios.run.zones import stitching_line


def stitch_files(paths: Sequence[Path], out: Path, fps: float | None) -> list[str]:
    """Stitch tracks files, one per zone, into ``out``; return the lines to print. A zone has the name of its file."""
    check_tracks_file(out)
    names = [path.stem if sum(p.stem == path.stem for p in paths) == 1 else str(path) for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"zones: {', '.join(map(str, paths))}: a file is given twice; each zone has its own")
    result = stitched({name: read_tracks(path) for name, path in zip(names, paths, strict=True)})
    write_tracks(result.tracks, out, rate_of(result.tracks, fps, paths[0]))
    return [
        f"{len(np.unique(result.tracks.track))} tracks with {len(result.tracks)} samples in {out}",
        stitching_line(result.handed_over, result.merged),
        *result.notes,
    ]
