"""A process of its own that serves an ArraySource; used by the long tests.

Reads a line to start the pulses, prints its counts when they have ended.
"""

import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from array_source import ArraySource

from hardware.emulate.faults import Faults
from hardware.emulate.serve import served

SHAPE, KEPT = (491, 656), 200


def main() -> None:
    address, pulses, faults = sys.argv[1], int(sys.argv[2]), json.loads(sys.argv[3])
    source = ArraySource(4, KEPT, SHAPE)
    own = {f"cam{k}": Faults(**{"seed": k, **faults}) for k in range(4)}
    with served(source, ahead=KEPT, loop=True, first_address=address, faults=own) as up:
        print("ready", flush=True)
        sys.stdin.readline()
        up.start(100.0)
        began, used = time.monotonic(), time.process_time()
        last = up.devices[-1]
        while last.counts().get("pulses", 0) < pulses:
            time.sleep(0.001)
        up.line.stop()
        cores = (time.process_time() - used) / (time.monotonic() - began)
        sys.stdin.readline()
        counts = [dict(device.counts()) for device in up.devices]
        print(json.dumps({"cores": cores, "pulses": last.counts()["pulses"], "counts": counts}), flush=True)


if __name__ == "__main__":
    main()
