"""A station without cameras: detections that are ready, sent pulse by pulse; every target says whose and when it is.

As a program: ``python ready_station.py NAME ENDPOINT CAMERA,CAMERA PULSES RATE TARGETS``: says ``ready``, then takes
a line ``START_MONOTONIC_NS FIRST``.
"""

import sys
import time

import numpy as np

from hardware.transport import open_transport
from hardware.transport.sender import Sender
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo

SIZE = (656, 491)


def infos(cameras, rate):
    return [CameraInfo(name, *SIZE, 8, rate) for name in cameras]


def ready(camera, pulse, targets):
    """Detections that no other camera or pulse has."""
    xy = np.column_stack(
        [np.full(targets, pulse % 600 + 0.25), np.arange(targets) + sum(camera.encode()) / 7]
    )
    ones = np.ones(targets)
    return Detections(camera, xy, np.tile(1e-4 * np.eye(2), (targets, 1, 1)), 5 * ones, 200 * ones, ones)


def pulse_in(found):
    return round(found.xy_px[0, 0] - 0.25)


def play(sender, cameras, pulses, rate, start_ns, targets=5, first=0, stop=lambda: False):
    """Send ``pulses`` of a trigger line whose pulse 0 is at ``start_ns`` (true time); counts from ``first``."""
    sender.say("armed")
    period = 1e9 / rate
    for pulse in range(first, pulses):
        wait = (start_ns + pulse * period - time.monotonic_ns()) * 1e-9
        if wait > 0:
            time.sleep(wait)
        if stop():
            return
        if pulse == first:
            sender.say("running")
        for name in cameras:
            arrival = sender.now_ns()
            number = pulse - first
            sender.send(name, number, round(number * period), 0, arrival, ready(name, pulse, targets))


def main():
    name, endpoint, cameras, pulses, rate, targets = sys.argv[1:]
    names = cameras.split(",")
    # a clock of its own, as another PC has
    offset = sum(name.encode()) * 10**12
    transport = open_transport(connect=[endpoint])
    with Sender(
        transport, name, infos(names, float(rate)), "# no rig\n", lambda: time.monotonic_ns() + offset
    ) as sender:
        print("ready", flush=True)
        start, first = map(int, sys.stdin.readline().split())
        play(sender, names, int(pulses), float(rate), start, int(targets), first)


if __name__ == "__main__":
    main()
