"""The first run after an installation or an update compiles kernels: the twin's and the pipeline's side by side."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from twin.source import TwinSource


def compile_side_by_side(source: TwinSource) -> None:
    """Where no compiled kernels are kept yet, compile the pipeline's in processes of their own beside the twin's.

    numba compiles one function at a time in a process. Without a folder to keep them in, nothing is done here:
    each kernel is then compiled when it is first called.
    """
    with pipeline_compiling():
        for _frame in source:
            break


@contextmanager
def pipeline_compiling() -> Iterator[None]:
    """Compile the pipeline's kernels, where none are kept yet, while the block runs; leave it when they are."""
    kept = os.environ.get("NUMBA_CACHE_DIR")
    if kept is None or any(Path(kept).rglob("detect_kernels.*.nbi")):
        yield
        return
    quiet = subprocess.DEVNULL
    beside = [
        subprocess.Popen([sys.executable, "-m", "mosca.warm", part], stdin=quiet, stdout=quiet, stderr=quiet)
        for part in ("points", "look")
    ]
    try:
        yield
        for process in beside:
            process.wait()
    finally:
        for process in beside:
            process.terminate()
