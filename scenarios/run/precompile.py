"""Compilation of kernels in the first run after an installation or an update: twin and pipeline in parallel."""

import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.spec.scenario import load_scenario

PIPELINE = tuple(("mosca.precompile", part) for part in ("points", "windows", "look"))
"""Programs that compile beside a run, which meanwhile compiles the twin and the calibration, a third of the work."""
TWIN = (("scenarios.run.precompile",),)
TESTS = tuple(("mosca.precompile", part) for part in ("look_twice", "points", "windows", "calibration"))
RICH = Path(__file__).parents[1] / "library" / "light" / "actor_in_context.toml"
"""A scenario that uses most functions of the twin."""


def compile_beforehand() -> None:
    """Compile kernels that processes started later would each compile for themselves, where none are cached yet."""
    with compiling(TESTS + TWIN) as compiled:
        compiled()


@contextmanager
def compiling(programs: Sequence[tuple[str, ...]]) -> Iterator[Callable[[], None]]:
    """Run programs that compile, where their kernels are not cached yet; the value of the block is a function that
    waits for them.

    Programs that still run at the end of the block are ended. Numba compiles one function at a time in a process.
    """
    from mosca.correspondence.match import match_rays
    from mosca.detection.cut_targets.window_fits import fit_windows
    from mosca.detection.frame_set_kernel import detect_frame_set
    from mosca.numba_support.cache import is_compiled

    kernels = [detect_frame_set, match_rays, fit_windows]
    if set(TWIN) <= set(programs):
        from twin.cameras.render.target import render_chosen

        kernels.append(render_chosen)
    if all(map(is_compiled, kernels)):
        yield lambda: None
        return
    quiet = subprocess.DEVNULL
    beside = [
        subprocess.Popen([sys.executable, "-m", *words], stdin=quiet, stdout=quiet, stderr=quiet)
        for words in programs
    ]

    def wait() -> None:
        for process in beside:
            process.wait()

    try:
        yield wait
    finally:
        for process in beside:
            process.terminate()


def first_frames() -> int:
    """Render the first frames of a rich scenario at small size; return their number."""
    spec = load_scenario(RICH, ("cameras.size_px=[164, 122]", "cameras.pixel_pitch_mm=0.04"))
    scene, cameras = build_scene(spec, RICH.parent), virtual_cameras(spec, true_rig(spec, RICH.parent))
    with twin_source(spec, scene, cameras, workers=1) as source:
        return sum(1 for _frame in islice(source, len(cameras)))


if __name__ == "__main__":
    first_frames()
