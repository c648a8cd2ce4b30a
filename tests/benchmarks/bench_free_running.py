"""Free-running cameras by the points' speed: completeness, error, its bound, clocks and covariance, a line a run.

Run: ``python -m tests.benchmarks.bench_free_running [--scenario continuous/free_running_short] [--rate 30]
[--speeds 0.5 1 2 4] [--seeds 1 2 3 4 5 6] [--set KEY=VALUE ...] [--keep DIR]``.

The scenario's frames are rendered and detected once (``--keep``: detections are kept there and read again), all else
is the production path. *least*: the Bayesian Cramer-Rao bound of what the true motion's spectrum, the true errors
and the true names let be known (``tests/studies/free_running_bound.py``), where all cameras run and where two do.
*both*: the bound over all instants at which two cameras run at least. *most*: share of the seen samples that
lie within 1 % of the space, as counts as found, of an estimator at the bound, for errors along one axis (depth).
*given*: rms error and nees of the same estimate from the same image points with their true names and errors, true
clocks to begin with and the truth as initial curves: what detection and motion leave; association can only lose.
*all*, *two*: rms error where all cameras run and where two do. *strands*: image tracks a camera, against the markers
that it films.
"""

import argparse
import pickle
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from mosca.camera.projection import project_with_jacobians
from mosca.continuous.association.associate import AssociationSettings, gather_seen
from mosca.continuous.association.coarse_sync import ClockTie
from mosca.continuous.association.correspondence import observed
from mosca.continuous.association.frame_detections import CameraDetections, detect_in_frames
from mosca.continuous.association.tracklets_2d import tracklets
from mosca.continuous.estimator.estimate import ContinuousSettings, estimate
from mosca.continuous.findings import STEP_S, on_curves_clock
from mosca.continuous.model.observations import TimedObservations
from mosca.continuous.reconstruct import BETTER_PX, reconstruct_gathered
from mosca.continuous.resample import tracks_on_grid
from mosca.data.rig import Rig
from mosca.data.truth import Truth
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene, pipeline_settings
from scenarios.run.continuous import pulses_ns
from scenarios.score.continuous import clock_scores
from scenarios.score.tracks import metrics, pair
from scenarios.spec.catalog import find
from scenarios.spec.scenario import Scenario, load_scenario
from scenarios.types import TruthPairs
from tests.studies.free_running_bound import least_variance, spectrum
from twin.scenes.scene import SceneSampler


@dataclass(frozen=True)
class Take:
    """What the cameras of a scenario saw, and the truth."""

    name: str
    spec: Scenario
    rig: Rig
    settings: PipelineSettings
    seen: tuple[CameraDetections, ...]
    truth: Truth


def taken(name: str, overrides: Sequence[str], workers: int = 2) -> Take:
    """Return what the scenario's cameras see."""
    path = find(name)
    spec = load_scenario(path, tuple(overrides))
    rig = true_rig(spec, path.parent)
    cameras = virtual_cameras(spec, rig)
    settings = pipeline_settings(spec)
    with twin_source(spec, build_scene(spec, path.parent), cameras, workers) as source:
        seen = detect_in_frames(source, rig.names, settings.detection)
        return Take(name, spec, calibrated(spec, cameras).rig, settings, seen, source.truth())


def kept(folder: Path | None, name: str, overrides: Sequence[str]) -> Take:
    """Return ``taken``, from ``folder`` where it was kept."""
    if folder is None:
        return taken(name, overrides)
    path = folder / ("_".join([name, *overrides]).replace("/", "-") + ".pickle")
    if not path.exists():
        path.write_bytes(pickle.dumps(taken(name, overrides)))
    take: Take = pickle.loads(path.read_bytes())
    return take


class TrueCurves:
    """The truth as curves, through the markers' positions at all frames' true instants."""

    def __init__(self, truth: Truth) -> None:
        assert truth.frames is not None
        self.points = truth.names
        time_s, first = np.unique(truth.frames.exposure_mid_ns * 1e-9, return_index=True)
        self.time_s, self.xyz = time_s, truth.frames.xyz[first]

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Return (t, points, 3)."""
        flat = self.xyz.reshape(len(self.xyz), -1)
        columns = [np.interp(time_s, self.time_s, one) for one in flat.T]
        return np.column_stack(columns).reshape(len(time_s), -1, 3)


def true_ties(take: Take) -> tuple[ClockTie, ...]:
    """Return how the cameras' stamps are tied to the session's clock in truth."""
    frames = take.truth.frames
    assert frames is not None
    ties = []
    for c, one in enumerate(take.seen):
        own = frames.camera == c
        half = int(one.frame_ns[0] - frames.stamp_ns[own][0])
        origin = int(one.frame_ns[0])
        rate, offset = np.polyfit(
            (frames.stamp_ns[own] + half - origin) * 1e-9, frames.exposure_mid_ns[own] * 1e-9, 1
        )
        ties.append(ClockTie(origin, float(offset), float(rate) - 1.0))
    return tuple(ties)


def estimate_settings(take: Take) -> ContinuousSettings:
    """Return the scenario's settings of the estimate."""
    keys = take.spec.continuous
    assert keys is not None
    return ContinuousSettings(clocks=keys.estimate, limbs=keys.limbs, knot_s=keys.knot_s)


def named(take: Take, curves: TrueCurves) -> TimedObservations:
    """Return the image points with their true names at their stamps' true instants, with their true random errors."""
    errors = take.spec.errors
    noise = np.full(len(take.seen), errors.body_px)
    found, _row = observed(take.seen, true_ties(take), take.rig, curves, noise, BETTER_PX)
    rows = range(len(found))
    flow = (curves.at(found.time_s + STEP_S)[rows, found.point] - curves.at(found.time_s)[rows, found.point]) / STEP_S
    by = jacobians(take, found, curves)
    late = np.einsum("nai,ni->na", by, flow) * errors.trigger_jitter_s
    return replace(found, covariance_px2=found.covariance_px2 + late[:, :, None] * late[:, None])


def jacobians(take: Take, found: TimedObservations, curves: TrueCurves) -> np.ndarray:
    """Return the derivatives (n, 2, 3) of image points by their points' positions [px/m]."""
    xyz = curves.at(found.time_s)[range(len(found)), found.point]
    by = np.empty((len(found), 2, 3))
    for c, camera in enumerate(take.rig.cameras):
        own = found.camera == c
        by[own] = project_with_jacobians(camera, xyz[own]).by_point
    return by


def least_errors(take: Take, found: TimedObservations, curves: TrueCurves) -> np.ndarray:
    """Return the bound's variances (t, points) [m^2] at the truth's instants."""
    scene = build_scene(take.spec, find(take.name).parent)
    of_motion = spectrum(lambda t: SceneSampler(scene).at(t).marker_xyz, 0.0, scene.duration_s)
    by, at = jacobians(take, found, curves), take.truth.time_ns * 1e-9
    parts = [
        least_variance(at, found.time_s[own], by[own], found.covariance_px2[own], of_motion)
        for own in (found.point == p for p in range(len(curves.points)))
    ]
    return np.stack(parts, axis=1)


def phases(take: Take) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks (t,) of the truth's instants at which all cameras ran, and two of three."""
    frames = take.truth.frames
    assert frames is not None
    mid = [frames.exposure_mid_ns[frames.camera == c] for c in range(len(take.seen))]
    at = take.truth.time_ns
    running = sum(((at >= m.min()) & (at <= m.max())).astype(int) for m in mid)
    return running == len(mid), running == 2


def rms_mm(squares: np.ndarray) -> float:
    """Return the root of the mean of ``squares`` [m^2] in mm, NaN of none."""
    return 1e3 * float(np.sqrt(np.mean(squares))) if squares.size else np.nan


def bound(take: Take) -> tuple[float, ...]:
    """Return the least error [mm] where all cameras run, where two do and over both, the share of samples that it
    lets be found, and rms error [mm] and nees of the estimate with true names, true clocks and curves to begin with.
    """
    curves = TrueCurves(take.truth)
    found = named(take, curves)
    least = least_errors(take, found, curves)
    done = estimate(found, take.rig, estimate_settings(take), curves)
    when = take.truth.time_ns
    periods = [one.period_s for one in take.seen]
    tracks = tracks_on_grid(done.curves, on_curves_clock(found, done), take.rig, when * 1e-9, when, periods)
    space = max(take.spec.working_space.size_m)
    pairs = pair(tracks, take.truth, space)
    scores = metrics(pairs, space)
    whole, two = phases(take)
    both = whole | two
    most = float(chi2.cdf((0.01 * space) ** 2 / least[both], 1).sum()) / max(int(pairs.seen_mask.sum()), 1)
    bounds = rms_mm(least[whole]), rms_mm(least[two]), rms_mm(least[both]), most
    return *bounds, 1e3 * scores["position_rms"].value, scores["nees"].value


def figures(take: Take) -> tuple[dict[str, float], TruthPairs]:
    """Return the figures of a take, and its errors."""
    keys = take.spec.continuous
    assert keys is not None
    began = time.perf_counter()
    space = max(take.spec.working_space.size_m)
    gathered = gather_seen(take.seen, take.rig, AssociationSettings(take.settings, keys.clocks, keys.search_s))
    found = reconstruct_gathered(gathered, take.rig, estimate_settings(take))
    pairs = pair(found.tracks(pulses_ns(take.spec)), take.truth, space)
    scores = metrics(pairs, space) | clock_scores(found, take.truth)
    names = (
        "completeness",
        "position_rms",
        "nees",
        "coverage95",
        "clock_frames",
        "ghosts_per_frame",
        "identity_switches",
    )
    result = {name: scores[name].value if name in scores else np.nan for name in names}
    return result | {"markers": len(found.estimated.curves.points), "seconds": time.perf_counter() - began}, pairs


def line(take: Take, with_bound: bool) -> str:
    """Return the table's line of a take."""
    strands = "/".join(str(len(np.unique(tracklets(one)))) for one in take.seen)
    least = "{:6.3f} {:6.2f} {:6.3f} {:6.3f} {:6.3f} {:5.2f}".format(*bound(take)) if with_bound else 6 * "     -"
    try:
        f, pairs = figures(take)
    except InputError as refused:
        return f"{strands:>9} {least} refused: {str(refused)[:60]}"
    squares = (pairs.error_m**2).sum(axis=1)
    whole, two = (rms_mm(squares[phase[pairs.frame]]) for phase in phases(take))
    return (
        f"{strands:>9} {least} {f['completeness']:8.4f} {1e3 * f['position_rms']:6.3f} {whole:6.3f} {two:6.2f} "
        f"{f['clock_frames']:7.4f} {f['nees']:6.2f} {f['coverage95']:6.3f} {f['markers']:4.0f} "
        f"{f['ghosts_per_frame']:6.3f} {f['identity_switches']:4.0f} {f['seconds']:5.1f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="continuous/free_running_short")
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--speeds", type=float, nargs="+", default=[0.5, 1.0, 2.0, 4.0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5, 6])
    parser.add_argument("--set", dest="more", action="append", default=[])
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--no-bound", action="store_true")
    given = parser.parse_args()
    print(
        "m/s seed   strands  least    two   both   most  given  nees complete    rms    all    two   clock   nees "
        " cover mrks ghosts swch     s"
    )
    for speed in given.speeds:
        for seed in given.seeds:
            rate = (f"capture.frame_rate_hz={given.rate:g}", f"timing.rate_hz={given.rate:g}")
            take = kept(
                given.keep, given.scenario, (*rate, f"scene.speed_mps={speed:g}", f"seed={seed}", *given.more)
            )
            print(f"{speed:3g} {seed:4d} {line(take, not given.no_bound)}", flush=True)


if __name__ == "__main__":
    main()
