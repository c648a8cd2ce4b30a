"""Reads mutants in a process of its own, with bounded memory, and tells of each what came of it.

``python -m fuzz.worker TABLE READER SEED FIRST LAST``: a line of JSON a mutant on the standard output.
"""

import importlib
import json
import os
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from random import Random
from typing import Any

from fuzz.mutants import mutant
from fuzz.reader import MUTANT, Reader
from fuzz.values import difference

from mosca.errors import MoscaError

MEMORY_BYTES = 1 << 30
"""Above what the imports and the seeds took."""


def outcome(reader: Reader, folder: Path, whole: Any) -> tuple[str, str]:
    """Return "refused", "equal" or the failure of what lies in ``folder``, and what there is to say.

    ``whole``: the values of the file before it was mutated.
    """
    try:
        values = reader.read(folder)
    except MoscaError as error:
        lines = str(error).splitlines()
        return ("refused", lines[0][:300]) if len(lines) == 1 else ("several lines", str(error)[:600])
    except MemoryError:
        return "memory", traceback.format_exc(limit=-4)
    except Exception:
        return "traceback", traceback.format_exc(limit=-4)
    try:
        expected = whole if reader.expect is None else reader.expect(folder)
    except Exception as error:
        return "differs", f"read, where an independent reader says: {type(error).__name__}: {error}"[:600]
    where = difference(values, expected)
    return ("equal", "") if where == "" else ("differs", where[:600])


def main(table: str, name: str, seed: str, first: int, last: int) -> None:
    """Write the outcomes of the mutants ``first`` to ``last`` of one reader, as lines of JSON."""
    told = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what libraries print
    warnings.simplefilter("ignore")
    reader = importlib.import_module(f"fuzz.{table}").READERS[name]
    with tempfile.TemporaryDirectory() as place:
        folders = []
        for k, make in enumerate(reader.seeds):
            folder = Path(place) / f"seed{k}"
            folder.mkdir()
            make(folder)
            folders.append((folder, reader.read(folder)))
            at_first = outcome(reader, folder, folders[-1][1])
            if at_first[0] != "equal":
                raise SystemExit(f"{name}: its seed {k} is not equal: {at_first}")
        used = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, resource.RLIM_INFINITY))
        for number in range(first, last):
            print(json.dumps({"number": number, "begun": True}), file=told, flush=True)
            folder, whole = folders[number % len(folders)]
            dice = Random(f"{name}/{seed}/{number}")
            here = Path(place) / MUTANT
            shutil.copytree(folder, here)
            files = sorted(one for pattern in reader.files for one in here.glob(pattern))
            victim = dice.choice(files)
            victim.write_bytes(mutant(victim.read_bytes(), reader.text(victim), dice))
            kind, said = outcome(reader, here, whole)
            shutil.rmtree(here)
            print(json.dumps({"number": number, "kind": kind, "said": said}), file=told, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:4], int(sys.argv[4]), int(sys.argv[5]))
