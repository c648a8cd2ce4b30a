"""Claims on a Dask cluster: the same bytes as without one, whatever dies meanwhile."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from claim_work import slow_work, work
from test_claim import write_claim

from mosca.errors import InputError
from scenarios.studies.campaign.campaign import run_claim
from scenarios.studies.campaign.collect import KeptRuns
from scenarios.studies.campaign.engine import LocalEngine
from scenarios.studies.campaign.result import write_result

pytest.importorskip("distributed", reason="distributed is not installed (pip install 'mosca-testbench[cluster]')")
from scenarios.studies.campaign import cluster as cluster_module
from scenarios.studies.campaign.cluster import ClusterEngine

TESTS = Path(__file__).parent
START_S = 60


class Cluster:
    """A scheduler and workers, each a process of its own."""

    def __init__(self, folder):
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.workers = []
        self.scheduler = None
        self.start_scheduler()

    def start_scheduler(self):
        self.scheduler = self._begin("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port",
                                     str(self.port), "--no-dashboard")  # fmt: skip
        self._wait(lambda: socket.create_connection(("127.0.0.1", self.port), 1).close())

    def start_worker(self, *more):
        self.workers.append(
            self._begin("distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-dashboard", *more)
        )

    def wait_for_workers(self, count):
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=START_S)

    def kill(self, process):
        # the group: a nanny would begin its worker again
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def close(self):
        for process in (*self.workers, self.scheduler):
            if process.poll() is None:
                self.kill(process)

    def _begin(self, module, *words):
        paths = [str(TESTS), str(TESTS.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            [sys.executable, "-m", module, *words], cwd=self.folder, env=environment, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    @staticmethod
    def _wait(attempt):
        until = time.monotonic() + START_S
        while True:
            try:
                return attempt()
            except OSError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)


@pytest.fixture
def cluster(tmp_path):
    """A scheduler without workers."""
    made = Cluster(tmp_path)
    yield made
    made.close()


def bytes_of(engine, path, folder, of=work, **rest):
    """Return the result file that an engine gives."""
    try:
        result = run_claim(path, engine, work=of, kept=KeptRuns(of, folder), **rest)
    finally:
        engine.close()
    write_result(result.document, folder / "out")
    return (folder / "out" / "result.json").read_bytes()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_equal_bytes_with_two_and_four_workers_and_what_dies_meanwhile(tmp_path, cluster):
    path = write_claim(tmp_path, limit="0.104 mm")
    alone = bytes_of(LocalEngine(2), path, tmp_path / "alone", slow_work)
    for _ in range(2):
        cluster.start_worker()
    cluster.wait_for_workers(2)
    assert bytes_of(ClusterEngine(cluster.address), path, tmp_path / "two", slow_work) == alone
    for _ in range(2):
        cluster.start_worker()
    cluster.wait_for_workers(4)

    def disturb(done, most):
        if done >= 20 and not disturbed:
            disturbed.append("worker")
            cluster.kill(cluster.workers[0])
        if done >= 80 and len(disturbed) == 1:
            disturbed.append("scheduler")
            cluster.kill(cluster.scheduler)
            cluster.start_scheduler()
            cluster.start_worker()

    disturbed: list[str] = []
    assert bytes_of(ClusterEngine(cluster.address), path, tmp_path / "four", slow_work, told=disturb) == alone
    assert disturbed == ["worker", "scheduler"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_stays_away_loses_nothing(tmp_path, cluster, monkeypatch):
    monkeypatch.setattr(cluster_module, "PATIENCE_S", 1.0)
    path = write_claim(tmp_path, runs=60, limit="0.104 mm")
    alone = bytes_of(LocalEngine(1), path, tmp_path / "alone", slow_work)
    cluster.start_worker()
    cluster.wait_for_workers(1)

    def kill(done, most):
        if done >= 15 and cluster.scheduler.poll() is None:
            cluster.kill(cluster.scheduler)

    with pytest.raises(InputError, match="the same command goes on"):
        bytes_of(ClusterEngine(cluster.address), path, tmp_path / "kept", slow_work, told=kill)
    kept = len(list((tmp_path / "kept").glob("*.run")))
    assert 15 <= kept < 60
    first = []
    resumed = bytes_of(LocalEngine(1), path, tmp_path / "kept", slow_work, told=lambda done, most: first.append(done))
    assert resumed == alone
    assert first[0] >= 15


@pytest.mark.filterwarnings("ignore")
def test_equal_bytes_with_one_worker(tmp_path, cluster):
    path = write_claim(tmp_path, runs=60, limit="0.104 mm")
    alone = bytes_of(LocalEngine(1), path, tmp_path / "alone")
    cluster.start_worker()
    cluster.wait_for_workers(1)
    assert bytes_of(ClusterEngine(cluster.address), path, tmp_path / "one") == alone


def test_nobody_at_the_address_is_told(monkeypatch):
    monkeypatch.setattr(cluster_module, "CONNECT_S", 0.5)
    with pytest.raises(InputError, match="no Dask scheduler answers within 0 s") as error:
        ClusterEngine("tcp://127.0.0.1:9")
    assert "\n" not in str(error.value)


@pytest.mark.filterwarnings("ignore")
def test_workers_with_threads_are_refused(cluster):
    cluster.start_worker("--nthreads", "2")
    cluster.wait_for_workers(1)
    with pytest.raises(InputError, match="has 2 threads"):
        ClusterEngine(cluster.address)
