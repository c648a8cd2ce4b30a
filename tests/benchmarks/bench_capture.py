"""What a capture costs: 4 cameras of 656 x 491 px at 100 Hz, dark and noisy, on a source in this process.

``python tests/benchmarks/bench_capture.py [SECONDS] [FOLDER]`` prints processor time per second of capture (all
threads; the frames are made before), what the fake cameras alone cost, and bytes against a raw write of them.
"""

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "scenarios"))

from capture_rig import RATE, SIZE, Line, dark_noise, openers, write_rig

from hardware.settings import read_hardware
from hardware.source import HardwareSource
from scenarios.lab.capture import CaptureRequest, capture

NAMES = ("a", "b", "c", "d")


def measured(work):
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def raw(folder, images, pulses):
    with open(folder / "raw.bin", "wb", buffering=0) as file:
        for pulse in range(pulses):
            for _ in NAMES:
                file.write(images[pulse % len(images)])
    return (folder / "raw.bin").stat().st_size


def source_alone(rig, images, pulses):
    opener, trigger = openers(Line(), dict.fromkeys(NAMES, images))
    with HardwareSource(read_hardware(rig), pulses, opener, trigger) as source:
        return sum(1 for _ in source)


def main(seconds, folder):
    pulses = round(seconds * RATE)
    images = dark_noise(n=32)
    rig = write_rig(folder / "rig.toml", NAMES)
    print(f"4 x {SIZE[0]} x {SIZE[1]} x {RATE:g} Hz, {pulses} pulses")
    size, wall, cpu = measured(lambda: raw(folder, images, pulses))
    print(f"raw write             {size / 1e6:8.0f} MB  {cpu / seconds:6.3f} cores at real time, in {wall:.2f} s")
    (folder / "raw.bin").unlink()
    frames, wall, base = measured(lambda: source_alone(rig, images, pulses))
    print(f"cameras and numbering {frames:8d} fr  {base / wall:6.3f} cores")
    for what in ("frames", "detections"):
        out = folder / what
        request = CaptureRequest(rig, out, frames=pulses, detections=what == "detections")
        outcome, wall, cpu = measured(
            lambda request=request: capture(request, None, *openers(Line(), dict.fromkeys(NAMES, images)))
        )
        kept = (out / "recording.mcap").stat().st_size
        print(
            f"capture {what:13s} {kept / 1e6:8.1f} MB  {cpu / wall:6.3f} cores, {(cpu - base) / wall:6.3f} beyond "
            f"the cameras; 1 : {size / kept:.1f} of raw; {outcome.lost} sets lost, whole {outcome.whole}"
        )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(dir=sys.argv[2] if len(sys.argv) > 2 else None) as name:
        main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0, Path(name))
