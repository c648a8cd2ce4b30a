"""What a person or a server sees while work goes on."""

import re
import time

import numba
import numpy as np
import pytest

from scenarios.cli import progress
from scenarios.cli.progress import Progress
from scenarios.run.timed import StageTimes, timed


def test_a_line_says_how_far_and_how_long_still():
    shown = Progress("actor")
    begun = time.monotonic()
    with shown as moved:
        moved(0, 200)
        moved(50, 200)
        line = shown.line(begun + 10.0)
    # a quarter in 10 s: 30 s are left
    assert re.fullmatch(r"actor: (9|10) s, 50 of 200 \(25 %\), about (29|30) s left", line), line


def test_without_a_total_nothing_is_foretold():
    with Progress("take") as moved:
        moved(7, None)
        assert re.fullmatch(r"take: \d+ s, 7", shown_line(moved))


def test_a_stage_is_named():
    shown = Progress("actor")
    with shown:
        timings = StageTimes(shown.stage)
        with timed(timings, "frames_to_tracks"):
            assert re.fullmatch(r"actor: \d+ s, frames to tracks", shown.line(time.monotonic()))
    assert list(timings) == ["frames_to_tracks"]


def shown_line(moved) -> str:
    return moved.__self__.line(time.monotonic())


@pytest.mark.parametrize("is_first", [True, False])
def test_what_is_compiled_is_told_once(monkeypatch, is_first):
    monkeypatch.setattr(progress, "is_first_run", lambda: is_first)

    @numba.njit
    def twice(x):
        return 2 * x

    shown = Progress("actor")
    with shown:
        twice(True)
        assert "compiling" not in shown.line(time.monotonic())
        for kind in "bBhHiIlLfd":
            twice(np.dtype(kind).type(1))
        line = shown.line(time.monotonic())
        # after an edit some are compiled again, and nobody knows how many
        left = r" of about \d+, some \d+ s left" if is_first else ""
        assert re.search(r"compiling \(once after an installation\): \d+ functions" + left + "$", line)
        assert "compiling" not in shown.line(time.monotonic())
        twice(True)
        assert "compiling" not in shown.line(time.monotonic())


@pytest.fixture
def told(monkeypatch):
    """Lines of progress, as they come."""
    lines: list[str] = []
    monkeypatch.setattr(progress.click, "echo", lambda line, err: lines.append(line))
    monkeypatch.setattr(progress, "EVERY_S", 0.001)
    return lines


def until(reached):
    while not reached():
        time.sleep(0.001)


def test_lines_come_without_a_terminal_and_end_with_the_work(told):
    with Progress("suite") as moved:
        moved(1, 3)
        until(lambda: told)
    assert told[0].startswith("suite: ")
    count = len(told)
    time.sleep(0.05)
    assert len(told) == count


def test_what_is_done_is_said_once(told):
    """What is served goes on after its frames were rendered; lines about these do not."""
    with Progress("frames") as moved:
        moved(3, 3)
        until(lambda: told)
        time.sleep(0.1)
    assert sum("3 of 3 (100 %)" in line for line in told) == 1


def test_the_teller_ends_where_the_work_fails(monkeypatch):
    shown = Progress("take")
    with pytest.raises(ZeroDivisionError), shown:
        raise ZeroDivisionError
    assert not shown._teller.is_alive()


def test_what_a_stage_counts_ends_with_it(told):
    with Progress("uav") as moved:
        shown = moved.__self__
        shown.stage("frames to tracks")
        moved(100, 100)
        shown.stage("error budget")
        assert re.fullmatch(r"uav: \d+ s, error budget", shown.line(time.monotonic()))
        until(lambda: sum("error budget" in line for line in told) > 1)  # it goes on being told


def test_a_bar_on_a_terminal_counts_anew_with_each_stage(monkeypatch, capsys):
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)
    with Progress("uav") as moved:
        shown = moved.__self__
        moved(100, 100)
        shown.stage("error budget")
        [task] = shown._bar.tasks
        assert (task.completed, task.total) == (0, None)


def test_ctrl_c_between_what_is_counted_names_the_stage(capsys):
    shown = Progress("uav")
    shown.stage("error budget")
    with pytest.raises(KeyboardInterrupt), shown:
        raise KeyboardInterrupt
    assert capsys.readouterr().err == "uav: stopped, error budget\n"
