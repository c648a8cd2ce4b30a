"""The second paper's tables 1 and 2, ours beside theirs: three alternating cameras, CMU motions, exact points.

Run: ``python tests/benchmarks/bench_continuous.py [--cameras known moving fixed] [--methods linear cubic neural ours]
[--worn] [MOTION ...]``; motions as in ``tests.studies.unsynchronised.MOTIONS`` (default: all ten; the first
one, the standing long jump, is table 1). Data: ``$MOSCA_DATA/cmu_mocap``.

RMSE [mm] of all points over all frames that the three cameras span. "known": cameras as they are, nothing aligned.
"moving": a pose of its own at every instant, as the paper's worn cameras have; datum is the first camera's pose and
its distance to the second; errors after one similarity for the whole motion. "fixed": one unknown pose for each
camera. Camera: rms error of the projection centres after the same similarity. Equal knots: a cubic spline fitted to
the truth itself with a knot each 4.5 frames, as many as six numbers each nine frames determine; no lower bound.
``--worn``: the cameras sit on belly, left wrist and right shin of the actor and move with them; errors after a
similarity for each frame, because such cameras have no datum in the world.
"""

import argparse
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from mosca.continuous.comparison_methods.interpolated import Interpolated, interpolated
from mosca.continuous.comparison_methods.neural import neural
from mosca.continuous.comparison_methods.synchronous import Cameras
from mosca.continuous.estimator.estimate import ContinuousSettings, estimate
from mosca.continuous.model.camera_paths import StillCameras
from mosca.continuous.model.observations import CameraPaths, Curves, TimedObservations
from mosca.data.arrays import Array
from mosca.data.rig import Pose, Rig
from tests.studies.unsynchronised import (
    JUMP,
    MOTIONS,
    TUNING,
    Score,
    equal_knots_m,
    observe,
    read_points,
    score,
    shared_frames,
    surround,
)
from tests.studies.unsynchronised_worn import worn

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "cmu_mocap"
METHODS = ("linear", "cubic", "neural", "ours")
PAPER = {
    "table 1": {"linear": (22.661, 24.366), "cubic": (6.881, 6.970), "neural": (5.572, 5.722)},
    "table 2": {"linear": (19.921, 21.057), "cubic": (4.649, 4.940), "neural": (4.313, 4.596)},
}
KNOT_FRAMES = 4.5
Row = dict[tuple[str, str, bool], Score]


def measured(name: str, cameras: list[str], methods: list[str], is_worn: bool) -> tuple[Row, float]:
    """Return scores by (cameras, method, with epipoles) of one motion, and what equal knots leave [m]."""
    truth = read_points(DATA, name)
    rig, paths = worn(DATA, name) if is_worn else (surround(truth), None)
    see = observe(truth, rig, paths=paths)
    frames, row = shared_frames(see, truth), Row()
    true_paths = paths or StillCameras.of(rig)
    for kind in cameras:
        for epipoles in (True,) if kind == "known" else (True, False):
            done: dict[str, Interpolated] = {}
            for method in methods:
                begun = time.perf_counter()
                if method in ("linear", "cubic"):
                    found = done[method] = interpolated(see, rig, method, kind, epipoles=epipoles)
                elif method == "neural":
                    found = neural(see, rig, done["cubic"], kind, epipoles=epipoles)
                else:
                    found = ours(see, rig, kind, epipoles)
                aligned = "each frame" if is_worn else "as is" if kind == "known" else "once"
                one = score(found, truth, frames, aligned=aligned, paths=found.paths, true_paths=true_paths)
                row[kind, method, epipoles] = one
                print(
                    f"  {name} {kind:6} {method:6} {'with' if epipoles else 'without':7} {1e3 * one.rms_m:8.3f} mm, "
                    f"cameras {1e3 * one.camera_m:7.3f} mm, {one.completeness:.3f} known, "
                    f"{time.perf_counter() - begun:.1f} s",
                    flush=True,
                )
    return row, equal_knots_m(truth, frames, KNOT_FRAMES)


@dataclass(frozen=True, eq=False)
class Ours:
    """The continuous-time estimate as ``Curves``, with the cameras' paths."""

    points: tuple[str, ...]
    curves: Curves
    paths: CameraPaths

    def at(self, time_s: Array) -> Array:
        """As ``Curves``."""
        return self.curves.at(time_s)


def ours(see: TimedObservations, rig: Rig, kind: Cameras, epipoles: bool) -> Ours:
    """Return our estimate; with unknown cameras it begins at the cubic baseline's curves and cameras."""
    if not epipoles:
        see = see.only(see.carried_by[see.point] < 0)
    settings = ContinuousSettings(cameras=kind)
    if kind == "known":
        done = estimate(see, rig, settings)
    else:
        start = interpolated(see, rig, "cubic", kind, epipoles=epipoles)
        first, last = start.instants_s[[0, -1]]
        see = see.only((see.time_s >= first - 1e-9) & (see.time_s <= last + 1e-9))
        rotations, centres = start.scene.rotations[0], start.scene.centres[0]
        cameras = (
            replace(camera, world_from_camera=Pose(rotations[k], centres[k])) for k, camera in enumerate(rig.cameras)
        )
        done = estimate(see, Rig(tuple(cameras)), settings, start, start.paths if kind == "moving" else None)
    return Ours(done.curves.points, done.curves, done.paths)


def table(title: str, rows: list[Row], references: list[float], cameras: list[str], methods: list[str]) -> None:
    """Print the means over ``rows`` in the layout of the paper's tables."""
    paper = PAPER.get(title, {})
    print(f"\n{title}: mean RMSE [mm] over {len(rows)} motion(s), equal knots {1e3 * np.mean(references):.3f}")
    head = "".join(f"{f'{k}, w/ epipoles':>22}{'w/o epipoles':>14}" for k in cameras)
    print(f"{'':8}{head}{'paper w/':>12}{'w/o':>9}")
    for method in methods:
        cells = ""
        for kind in cameras:
            for epipoles, width in ((True, 22), (False, 14)):
                # known cameras: epipoles have no information
                key = (kind, method, epipoles or kind == "known")
                cells += f"{1e3 * np.mean([row[key].rms_m for row in rows]):{width}.3f}"
        theirs = "".join(f"{value:{width}.3f}" for value, width in zip(paper.get(method, ()), (12, 9), strict=False))
        print(f"{method:8}{cells}{theirs}")
    for method in methods:
        for kind in cameras:
            if kind != "known":
                both = [1e3 * np.mean([row[kind, method, e].camera_m for row in rows]) for e in (True, False)]
                print(f"cameras' places, {kind}, {method}: {both[0]:.3f} mm with epipoles, {both[1]:.3f} without")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cameras", nargs="+", default=["known", "moving"], choices=["known", "moving", "fixed"])
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--worn", action="store_true", help="cameras on the actor's body")
    parser.add_argument("motions", nargs="*", help="default: all of MOTIONS")
    given = parser.parse_args()
    cameras = ["moving"] if given.worn else given.cameras
    rows, references = [], []
    wrong = [name for name in given.motions if name not in MOTIONS | TUNING]
    if wrong:
        parser.error(f"{wrong[0]}: no such motion; there are {', '.join(MOTIONS | TUNING)}")
    for name in given.motions or MOTIONS:
        row, reference = measured(name, cameras, given.methods, given.worn)
        rows.append(row)
        references.append(reference)
        if name == JUMP and not given.worn:
            table("table 1", [row], [reference], cameras, given.methods)
    table("worn" if given.worn else "table 2", rows, references, cameras, given.methods)


if __name__ == "__main__":
    main()
