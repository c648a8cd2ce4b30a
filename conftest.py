"""Scenario files are tests: pytest collects each ``scenarios/**/*.toml`` of the quick tier and runs it."""

import gc
import os
from collections.abc import Generator, Iterator
from pathlib import Path

# before numpy comes: see scenarios.cli.main
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

# the same examples each time: a failure must come from the change, not from the dice or the machine's speed
PATIENT = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", derandomize=True, **PATIENT)
# .ci/nightly: other examples each time, and more of them
settings.register_profile("night", max_examples=2000, **PATIENT)
settings.load_profile("same")

ROOT = Path(__file__).resolve().parent


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let ``--tier full`` collect the nightly scenarios too."""
    parser.addoption(
        "--tier", choices=["quick", "full"], default="quick", help="scenarios to collect (full: slow tests too)"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Before several workers start, compile once what each of them would compile for itself."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        from scenarios.run.precompile import compile_beforehand

        compile_beforehand()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Return one worker more than there are cores, for ``-n auto``: tests wait for a quarter of their time."""
    if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ:
        return None
    return len(os.sched_getaffinity(0)) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Give each worker a stretch of neighbours, and who is done some of another's.

    What tests of a file share, and kernels that only they compile, are then made once and not by each worker.
    """
    if config.getvalue("dist") != "load":
        return None
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave what collection makes, some 700,000 objects that stay, out of all searches for garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave what is marked slow to the night."""
    if config.getoption("--tier") == "full":
        return
    for item in items:
        if item.get_closest_marker("slow") is not None:
            item.add_marker(pytest.mark.skip(reason="slow: pytest --tier full runs it"))


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> "ScenarioFile | None":
    """Collect scenario files below the room of scenarios."""
    if file_path.suffix == ".toml" and ROOT / "scenarios" / "library" in file_path.parents:
        return ScenarioFile.from_parent(parent, path=file_path)
    return None


class ScenarioFile(pytest.File):
    """One scenario file: one test."""

    def collect(self) -> Iterator["ScenarioItem"]:
        """Yield the scenario where its tier is asked for."""
        from scenarios.spec.scenario import load_scenario

        tier = self.config.getoption("--tier")
        if tier == "full" or load_scenario(self.path).tier == "quick":
            yield ScenarioItem.from_parent(self, name=self.path.stem)


class ScenarioItem(pytest.Item):
    """Runs a scenario and holds it to its limits and its baseline."""

    def runtest(self) -> None:
        """Run; a broken limit, a control that was not caught, or a figure worse than in the baseline fails."""
        from scenarios.run.scenario import run_scenario
        from scenarios.spec.catalog import scenario_name
        from scenarios.spec.scenario import load_scenario
        from scenarios.suite.suite import BASELINES, Outcome, compared, complaints
        from scenarios.types import RunOptions

        name = scenario_name(self.path)
        result = run_scenario(load_scenario(self.path), name, self.path.parent, RunOptions(page=False))
        (outcome,) = compared([Outcome(name, result.record, "", 0.0)], BASELINES)
        if not outcome.passed:
            raise ScenarioFailed("; ".join(complaints(outcome)))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: object = None) -> str:
        """Tell a failed limit in one line."""
        if isinstance(excinfo.value, ScenarioFailed):
            return f"{self.path.name}: {excinfo.value}"
        return str(super().repr_failure(excinfo))


class ScenarioFailed(Exception):
    """A scenario did not end as it should."""


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data sets; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("MOSCA_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder} (set MOSCA_DATA)")
    return folder
