"""Labels without training, measured: real takes with identities taken away, and the twin's people, whose markers the
template has not seen. ``python -m tests.studies.labels_auto [DATA [SEED ...]]`` prints the table of docs/identity.md;
each SEED draws the twin's people, their motions and what is hidden anew (0 without one).
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Tracks
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.labelling.automatic.label import AutomaticLabels, AutomaticSettings, label_automatically
from mosca.labelling.automatic.template import MarkerTemplate, read_template
from twin.scenes.actions import ACTIONS
from twin.scenes.actor import build_actor

CMU = {"LFWT": "LASI", "RFWT": "RASI", "LBWT": "LPSI", "RBWT": "RPSI", "RBAC": "RBAK", "LSHN": "LTIB", "RSHN": "RTIB"}
GAIT2354 = {
    f"{side}.{theirs}": side + ours
    for side in "LR"
    for theirs, ours in {
        "ASIS": "ASI", "Acromium": "SHO", "Bicep": "UPA", "Elbow": "ELB", "Heel": "HEE", "Toe.Tip": "TOE",
        "Toe.Lat": "MT5", "Thigh.Front": "THF", "Thigh.Upper": "THI", "Shank.Front": "SHN", "Temple": "FHD",
    }.items()
}  # fmt: skip
"""What the template calls markers of another lab's set."""


SURE = 0.95
"""Least probability of the labels that are scored."""


@dataclass(frozen=True, eq=False)
class Take:
    """Markers of a person: names (m), positions (t, m, 3) [m], NaN where not seen."""

    names: Sequence[str]
    xyz: Array
    rate_hz: float


def real_take(path: Path, names: dict[str, str]) -> Take:
    """Return a labelled file's markers; ``names``: what the template calls them."""
    tracks = read_tracks(path)
    own, column = np.unique(tracks.label, return_inverse=True)
    frames, row = np.unique(tracks.frame, return_inverse=True)
    xyz = np.full((len(frames), len(own), 3), np.nan)
    xyz[row, column] = tracks.xyz
    short = [name.split(":")[-1] for name in own.tolist()]
    rate = (len(frames) - 1) * 1e9 / float(tracks.time_ns.max() - tracks.time_ns.min())
    return Take([names.get(name, name) for name in short], xyz, rate)


def twin_take(action: str, stature_m: float, markers: int, seconds: float, seed: int = 1) -> Take:
    """Return the twin's person in a built-in action, at 100 Hz."""
    scene = build_actor(
        duration_s=seconds, box_center_m=np.array([0, 0, 1.5]), box_size_m=np.array([6.0, 6.0, 3.0]),
        rng=np.random.default_rng(seed), action=action, stature_m=stature_m, markers=markers,  # type: ignore[arg-type]
    )  # fmt: skip
    data = mujoco.MjData(scene.model)
    rows = []
    for k in range(round(seconds * 100)):
        data.qpos[:] = scene.configuration_at(k / 100)
        mujoco.mj_kinematics(scene.model, data)
        rows.append(data.geom_xpos[list(scene.marker_geoms)].copy())
    return Take(scene.marker_names, np.array(rows), 100.0)


def spoiled(
    take: Take, rng: np.random.Generator, gaps: float, shuffled: bool, ghosts: float = 0.0, noise_m: float = 3e-4
) -> tuple[Tracks, Array]:
    """Return tracks without labels and what each sample is ("" a ghost).

    ``gaps``: share of samples hidden, 5 to 40 frames at a time; after each gap a track has another number, or, where
    ``shuffled``, after each sample. ``ghosts``: samples of no marker, as a share, that drift about the person for up
    to 30 frames.
    """
    t, m = take.xyz.shape[:2]
    seen = np.isfinite(take.xyz[:, :, 0])
    while (~seen).mean() < gaps:
        first = int(rng.integers(t))
        seen[first : first + int(rng.integers(5, 40)), int(rng.integers(m))] = False
    begins = seen & ~np.concatenate([np.zeros((1, m), dtype=bool), seen[:-1]])
    number = np.cumsum(begins.T.ravel()).reshape(m, t).T
    row, column = np.nonzero(seen)
    xyz, track, what = take.xyz[seen], number[seen], np.array(take.names)[column]
    left, parts = round(ghosts * len(row)), [(row, xyz, track, what)]
    while left > 0:
        length = int(rng.integers(1, 31))
        first = int(rng.integers(max(1, t - length)))
        rows = np.arange(first, min(first + length, t))
        path = (
            np.nanmean(take.xyz[first], axis=0)
            + rng.normal(0, 0.5, 3)
            + rng.normal(0, 0.003, (len(rows), 3)).cumsum(0)
        )
        parts.append((rows, path, np.full(len(rows), number.max() + len(parts)), np.full(len(rows), "")))
        left -= len(rows)
    row, xyz, track, what = (np.concatenate(column) for column in zip(*parts, strict=True))
    if shuffled:
        track = rng.permutation(len(row))
    order = np.lexsort((track, row))
    n = len(order)
    tracks = Tracks(
        frame=row[order], time_ns=np.round(row[order] * 1e9 / take.rate_hz), track=track[order], label=np.full(n, ""),
        xyz=xyz[order] + rng.normal(0, noise_m, (n, 3)), covariance=np.full((n, 3, 3), np.nan),
        n_cameras=np.zeros(n), residual_px=np.full(n, np.nan), status=np.full(n, "measured"),
    )  # fmt: skip
    return tracks, what[order]


@dataclass(frozen=True)
class Score:
    """How right labels are, sample by sample."""

    precision: float
    recall: float
    """Of the samples of markers that the template knows."""
    strangers: float
    """Share of the samples of other markers that have a label; precision leaves these out."""
    right: Array
    """(n,) of the labelled samples."""
    probability: Array
    """(n,) that was stated for them."""

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.precision * self.recall / max(self.precision + self.recall, 1e-12)


def score(done: AutomaticLabels, tracks: Tracks, what: Array, template: MarkerTemplate) -> Score:
    """Return the score of labels for ``tracks``, whose samples are ``what`` (n,)."""
    # samples may come in another order within a frame: a position tells which is which
    ours, theirs = (np.lexsort((*one.xyz.T, one.frame)) for one in (done.tracks, tracks))
    label, truth, stated = done.tracks.label[ours], what[theirs], done.probability[ours]
    given = label != ""
    known = np.isin(truth, template.names)
    strange = ~known & (truth != "")
    strangers = float(given[strange].mean()) if strange.any() else 0.0
    given &= ~strange
    right = label[given] == truth[given]
    recall = right.sum() / max(known.sum(), 1)
    return Score(right.sum() / max(given.sum(), 1), recall, strangers, right, stated[given])


@dataclass(frozen=True)
class Measured:
    """What a take gave."""

    score: Score
    """Of the labels that are SURE."""
    everything: Score
    """Of those that are stated with 0.3 or more."""
    seconds: float
    """The processor's time."""


def measured(
    take: Take, template: MarkerTemplate, seed: int, gaps: float, shuffled: bool, ghosts: float = 0.0
) -> Measured:
    """Return what labels of a spoiled take are worth."""
    tracks, what = spoiled(take, np.random.default_rng(seed), gaps, shuffled, ghosts)
    start = time.process_time()
    done = label_automatically(tracks, template, AutomaticSettings(sure=0.3))
    seconds = time.process_time() - start
    kept = done.probability >= SURE
    sure = replace(done, tracks=replace(done.tracks, label=np.where(kept, done.tracks.label, "")))
    return Measured(score(sure, tracks, what, template), score(done, tracks, what, template), seconds)


def _row(title: str, rows: Sequence[Measured]) -> str:
    numbers = [[r.score.f1, r.score.precision, r.score.recall, r.seconds] for r in rows]
    least, mean = np.min(numbers, axis=0), np.mean(numbers, axis=0)
    return (
        f"| {title} | {len(rows)} | {mean[0]:.4f} ({least[0]:.4f}) | {mean[1]:.4f} ({least[1]:.4f}) | "
        f"{mean[2]:.4f} | {np.mean([r.score.strangers for r in rows]):.2f} | {np.max(numbers, axis=0)[3]:.0f} s |"
    )


def reliability(rows: Sequence[Measured]) -> list[str]:
    """Return the lines of a table: how many samples are stated with which probability, and how many are right."""
    right, stated = (np.concatenate([getattr(r.everything, name) for r in rows]) for name in ("right", "probability"))
    lines = ["| stated | samples | mean | right |", "|---|---|---|---|"]
    for low, high in pairwise((0.3, 0.5, 0.7, 0.9, 0.95, 0.99, 0.999, 1.01)):
        those = (stated >= low) & (stated < high)
        if those.any():
            share = right[those].mean()
            lines.append(f"| {low} to {min(high, 1.0)} | {those.sum()} | {stated[those].mean():.4f} | {share:.4f} |")
    return lines


def main(data: Path, seeds: Sequence[int]) -> None:
    """Print the tables; ``seeds`` of the twin's takes."""
    full, cmu = read_template(), read_template(set_name="cmu")
    walker = real_take(data / "people/cmu_02_01.c3d", {})
    as_full = Take([CMU.get(name, name) for name in walker.names], walker.xyz, walker.rate_hz)
    gait = real_take(data / "people/gait2354/subject01_walk1.trc", GAIT2354)
    gait = Take(gait.names, gait.xyz @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), gait.rate_hz)  # its y is up
    print("| take | n | F1 mean (least) | precision | recall | strangers | time |\n|---|---|---|---|---|---|---|")
    named = [measured(walker, cmu, k, 0.1, True) for k in range(3)]
    print(_row("CMU 02_01, set known, shuffled, 10 % gaps", named))
    unnamed = [measured(as_full, full, k, 0.1, True) for k in range(3)]
    print(_row("the same, set unknown", unnamed))
    print(_row("gait2354, set unknown", [measured(gait, full, k, 0.05, False) for k in range(2)]), flush=True)
    twins: list[Measured] = []
    for k, action in enumerate(ACTIONS):
        rows = []
        for seed, (j, stature) in product(seeds, enumerate((1.55, 1.75, 1.95))):
            take = twin_take(action, stature, (41, 50, 32)[(k + j) % 3], (5.0, 8.0)[k % 2], seed)
            rows.append(measured(take, full, seed, 0.05, False, 0.05))
        print(_row(f"twin, {action}, three bodies, set unknown, 5 % gaps, 5 % ghosts", rows), flush=True)
        twins += rows
    print("\n".join([*reliability(twins), "", *reliability([*named, *unnamed])]))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data"), [int(one) for one in sys.argv[2:]] or [0])
