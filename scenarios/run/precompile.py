"""The first run after an installation or an update compiles kernels: the twin's and the pipeline's side by side."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from mosca.data.frames import FrameSource
from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.spec.scenario import load_scenario

PIPELINE = (("mosca.precompile", "points"), ("mosca.precompile", "look"))
"""What a run compiles beside itself; meanwhile it compiles the twin and the calibration, as long a piece of work."""
TWIN = (("scenarios.run.precompile",),)
TESTS = (("mosca.precompile", "look_twice"), ("mosca.precompile", "points"), ("mosca.precompile", "calibration"))
RICH = Path(__file__).parents[1] / "library" / "light" / "actor_in_context.toml"
"""A scenario that uses most functions of the twin."""


def compile_side_by_side(source: FrameSource) -> None:
    """Where no compiled kernels are kept yet, compile the pipeline's in processes of their own beside the twin's.

    numba compiles one function at a time in a process. Without a folder to keep them in, nothing is done here:
    each kernel is then compiled when it is first called.
    """
    with compiling(PIPELINE):
        for _frame in source:
            break


def compile_beforehand() -> None:
    """Compile what processes that start afterwards would each compile for themselves, where none is kept yet."""
    with compiling(TESTS + TWIN):
        pass


@contextmanager
def compiling(programs: Sequence[tuple[str, ...]]) -> Iterator[None]:
    """Run programs that compile, where no kernels are kept yet, while the block runs; leave it when they are done."""
    from mosca.correspondence.match import match_rays
    from mosca.detection.frame_set_kernel import detect_frame_set
    from mosca.numba_support.cache import is_compiled
    from twin.cameras.render.target import render_chosen

    if all(map(is_compiled, (detect_frame_set, match_rays, render_chosen))):
        yield
        return
    quiet = subprocess.DEVNULL
    beside = [
        subprocess.Popen([sys.executable, "-m", *words], stdin=quiet, stdout=quiet, stderr=quiet)
        for words in programs
    ]
    try:
        yield
        for process in beside:
            process.wait()
    finally:
        for process in beside:
            process.terminate()


def first_frames() -> int:
    """Render the first frames of a rich scenario, small; returns how many."""
    spec = load_scenario(RICH, ("cameras.size_px=[164, 122]", "cameras.pixel_pitch_mm=0.04"))
    scene, cameras = build_scene(spec, RICH.parent), virtual_cameras(spec, true_rig(spec, RICH.parent))
    with twin_source(spec, scene, cameras, workers=1) as source:
        return sum(1 for _frame in islice(source, len(cameras)))


if __name__ == "__main__":
    first_frames()
