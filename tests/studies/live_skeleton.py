"""A person followed live among unlabelled tracks with ghosts, occlusions and swapped numbers: names and cost.

Run: ``python -m tests.studies.live_skeleton [--actions ACTION ...] [--ghosts 0.05] [--hidden 0.05] [--swaps 1]``.
The actor's 53 anatomical markers without cameras, skin "moderate", the subject fitted to a range of motion. Markers
are hidden for 0.2 s on average and come back as a new track; ghosts last 0.2 s on average, half of them within 5 cm
of a marker, with which they move, the others about the person; so many times a second two markers within 15 cm of
each other exchange their tracks' numbers. ``f1`` is that of the labels from the first pose on, ``f1 all`` from the
first frame; ``wrong`` the share of labels that are; times are of the processor.
"""

import argparse
import time
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.tracks import Samples
from mosca.skeleton.fit import FittedSubject, fit_subject
from mosca.skeleton.live import LiveSkeleton
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.track import track_subject
from tests.studies.skeleton_actor import NOISE_M, actor_take

WORN = {"marker_set": "anatomical", "seat_sigma_m": 0.005}
LASTS_S = 0.2
NEAR_M, SWAPPED_M = 0.05, 0.15


@dataclass(frozen=True, eq=False)
class Disturbed:
    """Samples of each frame, and of each sample the index of its marker, -1 for a ghost's."""

    samples: list[Samples]
    marker: list[Array]


def disturbed(frames: MarkerFrames, ghosts: float, hidden: float, swaps_hz: float, seed: int = 1) -> Disturbed:
    """Return the markers as tracks without labels: a share of them ``hidden``, and ``ghosts`` as a share of m."""
    rng = np.random.default_rng(seed)
    n, m = frames.seen.shape
    period = 1e-9 * float(np.diff(frames.time_ns).mean())
    stop = min(1.0, period / LASTS_S)
    begin = stop * hidden / (1 - hidden)
    gone, number, following = np.zeros(m, dtype=bool), np.arange(m), m
    alive: list[tuple[int, int, Array]] = []  # number, marker that it moves with or -1, offset or place
    samples, markers = [], []
    for k in range(n):
        back = gone & (rng.random(m) < stop)
        away = ~gone & (rng.random(m) < begin)
        gone = (gone & ~back) | away
        number[back] = following + np.arange(back.sum())
        following += int(back.sum())
        xyz = frames.xyz[k]
        if rng.random() < swaps_hz * period:
            number = _swapped(number, xyz, ~gone, rng)
        alive = [one for one in alive if rng.random() >= stop]
        for _ in range(rng.poisson(ghosts * m * stop)):
            if rng.random() < 0.5:
                alive.append((following, int(rng.integers(m)), rng.normal(0, NEAR_M / np.sqrt(3), 3)))
            else:
                middle = np.nanmean(xyz, axis=0)
                alive.append((following, -1, middle + rng.uniform(-1, 1, 3)))
            following += 1
        false = [offset + (xyz[of] if of >= 0 else 0.0) for _, of, offset in alive]
        there = np.flatnonzero(~gone & np.isfinite(xyz[:, 0]))
        places = np.concatenate([xyz[there], np.reshape(false, (-1, 3))])
        ids = np.concatenate([number[there], np.array([one[0] for one in alive], dtype=np.int64)])
        order = rng.permutation(len(ids))
        count = len(ids)
        samples.append(
            Samples(
                np.full(count, frames.frame[k]), np.full(count, frames.time_ns[k]), ids[order], places[order],
                np.tile(NOISE_M**2 * np.eye(3), (count, 1, 1)), np.full(count, 4), np.full(count, 0.1),
                np.zeros(count, np.int8),
            )
        )  # fmt: skip
        markers.append(np.concatenate([there, np.full(len(alive), -1)])[order])
    return Disturbed(samples, markers)


def _swapped(number: Array, xyz: Array, there: Array, rng: np.random.Generator) -> Array:
    """Return the tracks' numbers after a marker and the nearest other one exchanged theirs."""
    rows = np.flatnonzero(there)
    one = int(rng.choice(rows))
    away = np.linalg.norm(xyz[rows] - xyz[one], axis=1)
    away[rows == one] = np.inf
    other = int(rows[away.argmin()])
    number = number.copy()
    if away.min() < SWAPPED_M:
        number[[one, other]] = number[[other, one]]
    return number


@dataclass(frozen=True)
class Outcome:
    """Label scores, share of frames with a pose, time a frame, rms distance of joints from those of true labels."""

    f1: float
    f1_all: float
    wrong: float
    first_s: float
    posed: float
    p50_ms: float
    p99_ms: float
    rms_mm: float
    searches: int
    losses: int


def followed(subject: FittedSubject, frames: MarkerFrames, take: Disturbed) -> Outcome:
    """Return what live following makes of a take; joints are held against ``track_subject`` with true labels."""
    labels = np.array([*subject.model.labels, ""])
    right, given, true, cost, poses = [], [], [], [], []
    with LiveSkeleton(subject) as live:
        for k, samples in enumerate(take.samples):
            start = time.thread_time()
            pose = live.step(int(frames.frame[k]), int(frames.time_ns[k]), samples)
            cost.append(time.thread_time() - start)
            names = labels[take.marker[k]]
            right.append(int(((pose.label == names) & (names != "")).sum()))
            given.append(int((pose.label != "").sum()))
            true.append(int((names != "").sum()))
            poses.append(pose)
        searches, losses = live.searches, live.losses
    known = np.array([pose.q is not None for pose in poses])
    first = int(known.argmax()) if known.any() else len(known)
    best = track_subject(subject, frames).joints.centre
    off = [np.linalg.norm(p.joints.centre[0] - best[k], axis=1) for k, p in enumerate(poses) if p.joints is not None]
    usual = np.array(cost[first + 1 :]) * 1e3
    return Outcome(
        2 * sum(right[first:]) / max(sum(given[first:]) + sum(true[first:]), 1),
        2 * sum(right) / max(sum(given) + sum(true), 1),
        1 - sum(right) / max(sum(given), 1),
        float(1e-9 * (frames.time_ns[first] - frames.time_ns[0])) if known.any() else np.nan,
        float(known[first:].mean()) if known.any() else 0.0,
        *(np.quantile(usual, [0.5, 0.99]) if len(usual) else (np.nan, np.nan)),
        1e3 * float(np.sqrt(np.nanmean(np.square(off)))) if off else np.nan,
        searches,
        losses,
    )  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--actions", nargs="+", default=["walk", "dance", "boxing"])
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--ghosts", type=float, default=0.05)
    parser.add_argument("--hidden", type=float, default=0.05)
    parser.add_argument("--swaps", type=float, default=1.0)
    parser.add_argument("--subject", help="file of 'skeleton fit'  [default: fitted here, to a range of motion]")
    given = parser.parse_args()
    if given.subject:
        from pathlib import Path

        from mosca.formats.bodies.subject_file import read_subject

        subject = read_subject(Path(given.subject))
    else:
        model, movement, _ = actor_take("range_of_motion", 24.0, 10.0, 1, skin="moderate", **WORN)
        subject = fit_subject(model, movement)
    print("action    f1     f1 all  wrong  first s  posed  p50 ms  p99 ms  joints mm  searches losses")
    for action in given.actions:
        _, frames, _ = actor_take(action, given.seconds, given.rate, 1, skin="moderate", **WORN)
        take = disturbed(frames, given.ghosts, given.hidden, given.swaps)
        one = followed(subject, frames, take)
        print(
            f"{action:8} {one.f1:.4f}  {one.f1_all:.4f}  {one.wrong:.4f} {one.first_s:6.2f}  {one.posed:6.3f} "
            f"{one.p50_ms:6.1f}  {one.p99_ms:6.1f}  {one.rms_mm:8.2f}  {one.searches:6d} {one.losses:5d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
