"""A station without cameras: prepared detections, sent pulse by pulse; targets encode their camera and pulse.

As a program: ``python ready_station.py NAME ENDPOINT CAMERA,CAMERA PULSES RATE TARGETS``: prints ``ready``, reads a
line ``START_MONOTONIC_NS FIRST``, plays until PULSES are over or a line ``end`` comes, and prints the number of
pulses sent. With ``now`` after TARGETS frames arrive when this program gets to run.
"""

import sys
import threading
import time

import numpy as np

from hardware.transport import Trust, open_transport
from hardware.transport.sender import Sender
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo

SIZE = (656, 491)


def infos(cameras, rate):
    return [CameraInfo(name, *SIZE, 8, rate) for name in cameras]


def ready(camera, pulse, targets):
    """Detections that no other camera or pulse has."""
    xy = np.column_stack([np.full(targets, pulse % 600 + 0.25), np.arange(targets) + sum(camera.encode()) / 7])
    ones = np.ones(targets)
    return Detections(camera, xy, np.tile(1e-4 * np.eye(2), (targets, 1, 1)), 5 * ones, 200 * ones, ones)


def pulse_in(found):
    return round(found.xy_px[0, 0] - 0.25)


def play(sender, cameras, pulses, rate, start_ns, targets=5, first=0, stop=lambda: False, due=True):
    """Send ``pulses`` of a trigger line whose pulse 0 is at ``start_ns`` (true time); counts from ``first``.

    ``due``: frames arrive when they are due, however busy the machine; else when this program gets to run.
    Returns how many pulses were sent.
    """
    sender.set_state("armed")
    period = 1e9 / rate
    for pulse in range(first, pulses):
        wait = (start_ns + pulse * period - time.monotonic_ns()) * 1e-9
        if wait > 0:
            time.sleep(wait)
        if stop():
            return pulse - first
        if pulse == first:
            sender.set_state("running")
        for name in cameras:
            late = time.monotonic_ns() - (start_ns + round(pulse * period)) if due else 0
            arrival = sender.now_ns() - late
            number = pulse - first
            sender.send(name, number, round(number * period), 0, arrival, ready(name, pulse, targets))
    return max(pulses - first, 0)


def main():
    name, endpoint, cameras, pulses, rate, targets, *more = sys.argv[1:]
    names = cameras.split(",")
    # a clock of its own, as another PC has
    offset = sum(name.encode()) * 10**12
    jam = {} if "now" in more else {"jam_s": 60.0}  # a busy machine must not make it drop messages
    transport = open_transport(connect=[endpoint], trust=Trust(bytes(range(32))), **jam)
    with Sender(
        transport, name, infos(names, float(rate)), "# no rig\n", lambda: time.monotonic_ns() + offset
    ) as sender:
        print("ready", flush=True)
        start, first = map(int, sys.stdin.readline().split())
        end = threading.Event()
        threading.Thread(target=lambda: sys.stdin.readline() and end.set(), daemon=True).start()
        sent = play(
            sender, names, int(pulses), float(rate), start, int(targets), first, end.is_set, "now" not in more
        )
    print(sent, flush=True)


if __name__ == "__main__":
    main()
