"""Tracks written while they are measured: what was measured is on the disk, whatever becomes of the program."""

import csv
from pathlib import Path
from typing import Self

import numpy as np

from mosca.data.tracks import Samples, table
from mosca.errors import InputError
from mosca.formats.tracks.tracks_csv import COLUMNS, cells_of, read_tracks_csv
from mosca.formats.tracks.tracks_file import check_tracks_file, write_tracks


class TracksLog:
    """Appends samples to ``PATH.part.csv``, in the order in which they become certain.

    ``finish`` writes them, sorted, to ``path`` in the format of its suffix and removes the part file; without it the
    part file stays. InputError for another suffix and where a part file of an earlier run still lies there.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        check_tracks_file(self.path)
        self.part = self.path.with_name(f"{self.path.name}.part.csv")
        try:
            self._file = open(self.part, "x", encoding="utf-8", newline="")  # noqa: SIM115  (closed by close)
        except FileExistsError:
            raise InputError(
                f"{self.part}: left by a run that was cut short; move it away or remove it"
            ) from None
        except OSError as error:
            raise InputError(f"{self.part}: cannot be written: {error.strerror}") from None
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(COLUMNS)
        self.samples = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def write(self, samples: Samples) -> None:
        """Append samples."""
        if len(samples):
            self._writer.writerows(zip(*cells_of(table([samples])), strict=True))
            self.samples += len(samples)

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Close the part file; it stays. May be called twice."""
        self._file.close()

    def finish(self, frame_rate_hz: float) -> int:
        """Write the tracks to their place and remove the part file; return how many tracks there are."""
        self.close()
        tracks = read_tracks_csv(self.part)
        tracks = tracks.select(np.lexsort((tracks.track, tracks.frame)))
        write_tracks(tracks, self.path, frame_rate_hz)
        self.part.unlink()
        return len(np.unique(tracks.track))
