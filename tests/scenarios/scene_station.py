"""A station with cameras of its own, as a program: frames that are drawn ahead, detected and sent by the product.

``python scene_station.py NAME ENDPOINT CAMERA,CAMERA FIRST ALL PULSES RATE TARGETS [PAIRS]``; cameras FIRST and on of
a ring of ALL; PAIRS 0: those whose images touch are not fitted together. Prints ``ready`` when it waits for the
start.
"""

import sys
import time

from station_scene import image, rig

from hardware.transport import Trust, open_transport
from hardware.transport.sender import Sender
from mosca.data.frames import CameraInfo, Frame
from mosca.detection.detect import DetectionSettings
from scenarios.lab.station import run_station
from scenarios.lab.station_source import PacedRecording

SIZE = (656, 491)
DRAWN = 12


class Looped:
    """Drawn frames, again and again."""

    def __init__(self, cameras, pulses, rate, targets):
        self._pictures = {c.name: [image(c, k, rate, targets) for k in range(DRAWN)] for c in cameras}
        self._pulses, self._rate = pulses, rate
        self.cameras = tuple(CameraInfo(c.name, c.width, c.height, 8, rate) for c in cameras)

    def __iter__(self):
        for pulse in range(self._pulses):
            for name, pictures in self._pictures.items():
                # there and back again, so that nothing jumps
                turn = pulse % (2 * DRAWN - 2)
                picture = pictures[min(turn, 2 * DRAWN - 2 - turn)]
                yield Frame(name, pulse, round(pulse * 1e9 / self._rate), 500_000, picture)

    def close(self):
        pass


def main():
    name, endpoint, names, first, count, pulses, rate, targets, *pairs = sys.argv[1:]
    whole = rig(tuple(f"c{k}" for k in range(int(count))), SIZE)
    cameras = whole.cameras[int(first) : int(first) + len(names.split(","))]
    own = [
        type(c)(n, c.width, c.height, c.lens, c.world_from_camera)
        for c, n in zip(cameras, names.split(","), strict=True)
    ]
    source = PacedRecording(Looped(own, int(pulses), float(rate), int(targets)))
    settings = DetectionSettings(split_pairs=pairs == ["1"])
    offset = sum(name.encode()) * 10**12
    sender = Sender(
        open_transport(connect=[endpoint], trust=Trust(bytes(range(32)))),
        name,
        source.cameras,
        "",
        lambda: time.monotonic_ns() + offset,
    )
    source.gate.sender = sender
    print("ready", flush=True)
    totals = run_station(source, sender, settings)
    print(
        f"{1e3 * totals.seconds / max(totals.detected, 1):.2f} ms a frame, {sender.skipped} skipped", file=sys.stderr
    )


if __name__ == "__main__":
    main()
