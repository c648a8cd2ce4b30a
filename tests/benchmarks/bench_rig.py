"""Four GigE Vision cameras at 100 Hz with all kinds of faults: does any frame get a wrong pulse number?

    python tests/benchmarks/bench_rig.py [PULSES [TAKE]]

TAKE: a recording of 60 pulses at 50 Hz that is served; without one it is rendered. On a machine with other load run
it with ``nice -n -10``, as a capture gives itself where permitted.

The twin serves a take in another process (``mosca twin serve``), losing 1 % of the packets and 0.5 % of the trigger
pulses, with clocks that drift by up to 50 ppm and a camera that reboots; the rig is read through the source and the
assembly that a capture uses, and each image is compared with the expected one of its pulse. The memory of both
processes is sampled each second: its growth is a line through the means of ten parts of the run, without the first.
"""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from scipy.stats import linregress

from hardware.settings import read_hardware
from hardware.source import HardwareSource
from mosca.recording import open_recording
from mosca.synchronisation import Assembly, AssemblySettings, assemble

TAKE_HZ, TAKE_PULSES = 50.0, 60
FAULTS = ("--loss", "0.01", "--withhold", "0.005", "--reboot", "cam2@8", "--drift", "50")


def main(pulses: int, take: Path | None = None) -> None:
    """Print the counts of each camera's frames, and how many are in a wrong set."""
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "rig.toml"
        mosca = [sys.executable, "-m", "scenarios.cli.main"]
        if take is None:
            take = Path(folder) / "take"
            run = [*mosca, "run", "rigs/any_source", "--record", str(take), "--out", f"{folder}/run"]
            subprocess.run(run, check=True, stdout=subprocess.DEVNULL)
        with open_recording(take) as source:
            shown = {(f.camera, round(f.time_ns * TAKE_HZ / 1e9)): np.array(f.image) for f in source}
        serve = [*mosca, "twin", "serve", str(take), "--loop", "--rate", "100", "--trigger", "serial"]
        serve += ["--address", "127.0.0.60", "--rig-out", str(rig), *FAULTS]
        with subprocess.Popen(serve) as server:
            try:
                while not rig.exists() and server.poll() is None:
                    time.sleep(0.1)
                with Memory({"reading": os.getpid(), "serving": server.pid}) as memory:
                    grab(rig, pulses, shown)
                print(*memory.lines(), sep="\n")
            finally:
                server.send_signal(signal.SIGINT)


class Memory:
    """What ``processes`` hold of the machine's memory (resident, in MiB), each second while it is entered."""

    def __init__(self, processes: dict[str, int]) -> None:
        self._processes, self._seen = processes, []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> "Memory":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        page = os.sysconf("SC_PAGE_SIZE") / 2**20
        while not self._over.wait(1.0):
            held = [int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in self._processes.values()]
            self._seen.append((time.monotonic() / 60, *(pages * page for pages in held)))

    def lines(self) -> list[str]:
        """Return the growth of each process in MiB a minute, with its standard error."""
        if len(self._seen) < 30:
            return ["memory: too short a run"]
        parts = np.array([part.mean(axis=0) for part in np.array_split(np.array(self._seen), 10)])
        told = []
        for k, name in enumerate(self._processes, start=1):
            line = linregress(parts[1:, 0], parts[1:, k])
            told.append(
                f"memory of {name}: {parts[1, k]:.1f} MiB, at the end {parts[-1, k]:.1f}; grows by "
                f"{line.slope:+.3f} +- {line.stderr:.3f} MiB a minute"
            )
        return told


def grab(rig: Path, pulses: int, shown: dict[tuple[str, int], np.ndarray]) -> None:
    """Read ``pulses`` pulses of ``rig`` and compare each image with the one ``shown`` at its pulse."""
    assembly, wrong = Assembly(), 0
    begin = time.process_time()
    with HardwareSource(read_hardware(rig), pulses) as source:
        for frame_set in assemble(source, source.cameras, AssemblySettings(open_pulses=100), assembly):
            for name, frame in frame_set.frames.items():
                wrong += not np.array_equal(frame.image, shown[name, frame_set.pulse % TAKE_PULSES])
    cores = (time.process_time() - begin) * 100 / pulses
    print(f"{assembly.sets} sets, {assembly.complete_sets} complete; frames of another pulse: {wrong}")
    for name, count in assembly.cameras.items():
        one = source.statistics.cameras[name]
        print(
            f"{name}: {count.delivered} delivered, {count.dropped} dropped, {one.failed} failed, "
            f"{one.relocked} relocked, {one.reopened} reopened, "
            f"{one.driver.get('n_resent_packets', 0)} packets resent"
        )
    print(*source.statistics.notes, sep="\n")
    print(f"reading and comparing took {cores:.2f} cores")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 6000, Path(sys.argv[2]) if len(sys.argv) > 2 else None)
