"""Gives mutants to worker processes; ends one that takes too long, and goes on behind the mutant that killed it."""

import json
import os
import selectors
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

LIMIT_S = 20.0
"""For one mutant: of the processor's time, and ``PATIENCE`` times as much on the clock."""
PATIENCE = 10
"""A busy machine may leave a process without a processor; one that waits for ever takes no time of it."""
START_S = 180.0
"""For imports, seeds and a first compilation."""
GOOD = ("refused", "equal")
ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Report:
    """What came of a reader's mutants: counts by kind, and the failures as (number, kind, what there is to say)."""

    reader: str
    seed: str
    counts: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[int, str, str]] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """One line for people."""
        bad = sum(count for kind, count in self.counts.items() if kind not in GOOD)
        counts = f"{self.counts['refused']:6d} refused {self.counts['equal']:6d} equal {bad:5d} failures"
        kinds = ", ".join(f"{count} {kind}" for kind, count in self.counts.items() if kind not in GOOD)
        return f"{self.reader:24s} {sum(self.counts.values()):6d} mutants {counts}  {kinds}".rstrip()

    def add(self, number: int, kind: str, said: str) -> None:
        """Count one mutant."""
        self.counts[kind] += 1
        if kind not in GOOD:
            self.failures.append((number, kind, said))
        elif kind == "refused":
            self.refusals.append(said)


def fuzzed(reader: str, seed: str, first: int, last: int, table: str = "readers", limit_s: float = LIMIT_S) -> Report:
    """Return what comes of the mutants ``first`` to ``last`` of ``reader``.

    ``seed`` makes others of them; ``table``: the module of this folder that lists the reader.
    """
    report = Report(reader, seed)
    while first < last:
        first = _batch(report, (first, last), table, limit_s)
    return report


def _batch(report: Report, numbers: tuple[int, int], table: str, limit_s: float) -> int:
    """Give mutants to one worker until it ends; return the number of the next mutant."""
    first, last = numbers
    command = [sys.executable, "-m", "fuzz.worker", table, report.reader, report.seed, str(first), str(last)]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'tests'}{os.pathsep}{ROOT}", "OPENBLAS_NUM_THREADS": "1"}
    begun = first
    running, begun_s, waited = False, 0.0, 0
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as worker:
        assert worker.stdout is not None
        assert worker.stderr is not None
        os.set_blocking(worker.stdout.fileno(), False)
        errors, unfinished = b"", b""
        with selectors.DefaultSelector() as ready:
            ready.register(worker.stdout, selectors.EVENT_READ, "out")
            ready.register(worker.stderr, selectors.EVENT_READ, "err")
            while ready.get_map():
                events = ready.select(limit_s if running else START_S)
                waited = 0 if events else waited + 1
                if not events and running and waited < PATIENCE and _cpu_s(worker.pid) < begun_s + limit_s:
                    continue
                if not events:
                    worker.kill()
                    report.add(begun, "hang", f"more than {limit_s:g} s")
                    return begun + 1
                for key, _ in events:
                    data = os.read(key.fd, 65536)
                    if not data:
                        ready.unregister(key.fileobj)
                    elif key.data == "err":
                        errors = (errors + data)[-4000:]
                    else:
                        *lines, unfinished = (unfinished + data).split(b"\n")
                        for line in lines:
                            told = json.loads(line)
                            running, begun, begun_s = "begun" in told, told["number"], _cpu_s(worker.pid)
                            if not running:
                                report.add(told["number"], told["kind"], told["said"])
        code = worker.wait()
    text = errors.decode("utf-8", "replace")
    if running:
        report.add(begun, "died", f"exit code {code}: {text[-600:]}")
        return begun + 1
    if code != 0:
        raise RuntimeError(f"fuzz.worker {report.reader} ended with {code} between mutants: {text}")
    return last


def _cpu_s(pid: int) -> float:
    """Return the processor's time that a process has taken [s]; 0 where it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
