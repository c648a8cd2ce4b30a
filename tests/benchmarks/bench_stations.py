"""Latency of merging detections: two stations of four cameras, each in a network namespace of its own.

Run as root: ``python tests/benchmarks/bench_stations.py [--rate 100] [--seconds 20] [--targets 50] [--detect]
[--pairs]``.
Ready detections are sent as soon as their frames "arrive", so that the figure is transport and merging alone; with
``--detect`` frames of 656 x 491 are drawn ahead and detected by the stations. Printed are also its parts: from a
frame's arrival to its message's departure (a station processes its cameras one after the other), and from the last
message's departure to the merged set; and the delay of the machine's own wake-ups, the largest part on a busy
machine; ``nice -n -15`` helps.
"""

import argparse
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

TESTS = Path(__file__).resolve().parent.parent
for folder in (TESTS.parent, TESTS / "scenarios", TESTS / "hardware"):
    sys.path.insert(0, str(folder))

from namespaces import TRUST, pcs, why_not  # noqa: E402
from ready_station import SIZE  # noqa: E402

from hardware.transport import open_transport  # noqa: E402
from hardware.transport.receiver import Receiver  # noqa: E402
from hardware.transport.station_state import ReceiverSettings  # noqa: E402
from scenarios.lab.merge import summary_lines  # noqa: E402
from scenarios.run.priority import before_others, prompt  # noqa: E402

NAMES = {"A": "a1,a2,a3,a4", "B": "b1,b2,b3,b4"}


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--rate", type=float, default=100.0)
    asked.add_argument("--seconds", type=float, default=20.0)
    asked.add_argument("--targets", type=int, default=50)
    asked.add_argument("--detect", action="store_true")
    asked.add_argument("--pairs", action="store_true", help="touching images are fitted together")
    given = asked.parse_args()
    reason = why_not()
    if reason:
        sys.exit(reason)
    with pcs(2) as (a, b):
        measure(dict(zip("AB", (a, b), strict=True)), given)


def measure(two, given) -> None:
    """Run both stations and print delays and losses."""
    pulses = round(given.rate * given.seconds)
    sizes = {name: SIZE for names in NAMES.values() for name in names.split(",")}
    late: list[float] = []
    end = threading.Event()
    running = []
    settings = ReceiverSettings(queued=10**6, start_wait_s=120.0)
    endpoints = [pc.endpoint for pc in two.values()]
    try:
        with (
            before_others(),
            prompt(),
            Receiver(open_transport(listen=endpoints, trust=TRUST), ("A", "B"), sizes, settings=settings) as here,
        ):
            for k, (name, pc) in enumerate(two.items()):
                if given.detect:
                    more = (4 * k, 8, pulses, given.rate, given.targets, int(given.pairs))
                    script = TESTS / "scenarios" / "scene_station.py"
                else:
                    more = (pulses, given.rate, given.targets, "now")
                    script = TESTS / "hardware" / "ready_station.py"
                running.append(
                    pc.start(
                        script,
                        name,
                        pc.endpoint,
                        NAMES[name],
                        *more,
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        text=True,
                    )
                )
            for program in running:
                assert program.stdout.readline() == "ready\n"
            start = time.monotonic_ns() + 500_000_000
            if not given.detect:
                for program in running:
                    program.stdin.write(f"{start} 0\n")
                    program.stdin.flush()
            threading.Thread(target=wake, args=(late, end), daemon=True).start()
            before = time.process_time()
            sets = [s for s in here if s.pulse >= 50]
            cpu = time.process_time() - before
    finally:
        end.set()
        for program in running:
            program.kill()
            program.wait()
    arrived = 1e3 * np.array([(s.merged_ns - at) * 1e-9 for s in sets for at in s.arrived_ns.values()])
    left = 1e-6 * np.array([s.sent_ns[n] - at for s in sets for n, at in s.arrived_ns.items()])
    merged = 1e-6 * np.array([s.merged_ns - max(s.sent_ns.values()) for s in sets if s.sent_ns])
    print(f"{given.rate:g} Hz, {given.targets} targets, {'detected' if given.detect else 'ready'} at the stations")
    for title, values in (
        ("from the frame's arrival at its station", arrived),
        ("  of which until its message's departure", left),
        ("  and from a set's last departure", merged),
        ("the machine's own wake-ups are late by", 1e3 * np.array(late)),
    ):
        p = np.quantile(values, [0.5, 0.9, 0.99, 0.999])
        print(f"{title:42s} median {p[0]:6.2f}  90 % {p[1]:6.2f}  99 % {p[2]:6.2f}  99.9 % {p[3]:6.2f} ms")
    print(f"merging: {cpu / given.seconds:.2f} cores")
    print("\n".join(summary_lines(here.statistics)))


def wake(late, end) -> None:
    """Sleep for 10 ms again and again, and note how late it is."""
    while not end.is_set():
        before = time.monotonic()
        time.sleep(0.01)
        late.append(time.monotonic() - before - 0.01)


if __name__ == "__main__":
    main()
