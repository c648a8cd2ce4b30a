"""One campaign of rendered runs in two processes and on Dask clusters: bytes of its result, and time for its runs.

    python -m tests.studies.claims_cluster [--runs 50 100 200]

The claim has one look, at its last run, so that all runs are made. Each way has an empty store of runs. The cluster
of four workers loses a worker after a tenth of the runs and its scheduler after four tenths. Processor time is that
of this process and of all processes that it started and that have ended.
"""

import argparse
import hashlib
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tomli_w

from scenarios.studies.campaign.campaign import run_claim
from scenarios.studies.campaign.cluster import ClusterEngine
from scenarios.studies.campaign.collect import KeptRuns
from scenarios.studies.campaign.engine import Engine, LocalEngine
from scenarios.studies.campaign.result import RESULT, write_result
from scenarios.studies.campaign.worker import run_task
from tests.studies.claims_images import claim_document, rig_kind

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scenarios"))
from test_claim_cluster import Cluster

Told = Callable[[int, int], None]


def written(folder: Path, runs: int) -> Path:
    """Write a claim on one kind of rig that makes all of its ``runs``, and return its path."""
    path = folder / f"claim_{runs}.toml"
    document = claim_document(rig_kind(np.random.default_rng(1)), 3e-4, 1, runs)
    path.write_text(tomli_w.dumps({**document, "looks": [runs]}), encoding="utf-8")
    return path


def measured(name: str, path: Path, engine: Engine, told: Told = lambda done, most: None) -> bytes:
    """Make a campaign with an empty store of runs, print its time, and return the bytes of its result."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            result = run_claim(path, engine, told=told, kept=KeptRuns(run_task, Path(folder)))
        finally:
            engine.close()
        write_result(result.document, Path(folder) / "out")
        content = (Path(folder) / "out" / RESULT).read_bytes()
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    spent = sum(one.ru_utime + one.ru_stime for one in (own, others))
    digest = hashlib.sha256(content).hexdigest()[:16]
    wall = time.perf_counter() - begun
    print(f"{name}: {result.document['runs']} runs, {wall:.1f} s, processor time so far {spent:.1f} s, {digest}",
          flush=True)  # fmt: skip
    return content


def losing(cluster: Cluster, lost: list[str]) -> Told:
    """Return what kills a worker and the scheduler of a cluster on the way."""

    def told(done: int, most: int) -> None:
        if done >= 0.1 * most and not lost:
            lost.append("worker")
            cluster.kill(cluster.workers[0])
        if done >= 0.4 * most and len(lost) == 1:
            lost.append("scheduler")
            cluster.kill(cluster.scheduler)
            cluster.start_scheduler()
            cluster.start_worker()

    return told


def main() -> None:
    """Print a line for each way, and whether all gave the same bytes."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--runs", type=int, nargs="+", default=[50, 100, 200])
    options = given.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root)
        for runs in options.runs:
            path = written(folder, runs)
            found = {measured("2 processes", path, LocalEngine(2))}
        for workers in (2, 4):
            cluster = Cluster(folder)
            try:
                for _ in range(workers):
                    cluster.start_worker()
                cluster.wait_for_workers(workers)
                lost: list[str] = []
                told = losing(cluster, lost) if workers == 4 else lambda done, most: None
                found.add(measured(f"Dask, {workers} workers", path, ClusterEngine(cluster.address), told))
                print(f"killed on the way: {', '.join(lost) or 'none'}")
            finally:
                cluster.close()
    print("the same bytes" if len(found) == 1 else f"{len(found)} different results")


if __name__ == "__main__":
    main()
