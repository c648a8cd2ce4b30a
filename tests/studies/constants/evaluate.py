"""Evaluates the takes with changed constants, each in a process that is forked off with everything compiled."""

import multiprocessing
import time
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from tests.studies.constants import run_time
from tests.studies.constants.headlines import Headline
from tests.studies.constants.screen import Figures, Question

LONGEST_S, TIMES_LONGER = 60.0, 10.0
"""A process that needs longer than both, the second in what the takes need unchanged, has no end."""


def measured(takes: Sequence[Headline]) -> Figures:
    """Return the figures of all takes; a take that raises has none."""
    found: dict[str, Mapping[str, float]] = {}
    for take in takes:
        try:
            found[take.name] = take.figures()
        except Exception as error:  # a constant that makes a stage fail is one that matters: the figures are missing
            print(f"{take.name}: {type(error).__name__}: {str(error)[:200]}", flush=True)
            found[take.name] = {}
    return found


class Forked:
    """``Answers`` from ``processes`` at a time, until ``ends`` (``time.monotonic``)."""

    def __init__(self, takes: Sequence[Headline], processes: int, ends: float) -> None:
        self.takes, self.processes, self.ends = takes, processes, ends
        measured(takes)  # compiles
        begin = time.monotonic()
        self.base = measured(takes)
        self.longest_s = max(LONGEST_S, TIMES_LONGER * (time.monotonic() - begin))

    def __call__(self, questions: Sequence[Question]) -> Iterator[tuple[Question, Figures]]:
        """Yield each question with its figures."""
        fork = multiprocessing.get_context("fork")
        waiting = list(questions)
        running: dict[Connection, tuple[Question, Any, float]] = {}
        while running or (waiting and time.monotonic() < self.ends):
            while waiting and len(running) < self.processes and time.monotonic() < self.ends:
                question = waiting.pop(0)
                here, there = fork.Pipe(duplex=False)
                process = fork.Process(target=self._answer, args=(question, there))
                process.start()
                there.close()
                running[here] = question, process, time.monotonic()
            ready = set(wait(list(running), timeout=1.0))
            for pipe, (question, process, begin) in list(running.items()):
                if pipe not in ready and time.monotonic() - begin < self.longest_s:
                    continue
                figures: Figures = {}
                if pipe in ready:
                    try:
                        figures = pipe.recv()
                    except EOFError:
                        print(f"{question}: the process crashed", flush=True)
                else:
                    print(f"{question}: no end within {self.longest_s:.0f} s", flush=True)
                    process.kill()
                process.join()
                pipe.close()
                del running[pipe]
                yield question, figures

    def _answer(self, question: Question, pipe: Connection) -> None:
        keys, factor = question
        run_time.set_factors(dict.fromkeys(keys, factor))
        # takes that are not tried keep their figures
        pipe.send({**self.base, **measured([take for take in self.takes if take.shows(keys)])})
        pipe.close()
