"""Every part of the program that opens a port, in a network of its own; prints each local address that was open.

``listening_sockets.py [plant]``: with ``plant`` a socket on all interfaces is among them.
"""

import json
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from array_source import ArraySource

from hardware.drivers import gige, open_camera
from hardware.emulate.serve import served
from hardware.onboard.line_protocol import UdpLines
from hardware.settings import CameraHardware, TriggerTable
from hardware.streams.natnet.server import NatNetServer
from hardware.streams.natnet.settings import NatNetSettings
from hardware.transport import open_transport
from hardware.triggers.action import ActionTrigger

CAMERA = "127.0.6.1"
STREAMS = "127.0.6.2"
ENDPOINT = "tcp/127.0.0.1:7462"


def open_addresses():
    """Return (protocol, local address) of the sockets of this network that receive, in the kernel's hexadecimal."""
    found = set()
    for protocol, states in (("tcp", {"0A"}), ("tcp6", {"0A"}), ("udp", {"01", "07"}), ("udp6", {"01", "07"})):
        for line in Path(f"/proc/net/{protocol}").read_text().splitlines()[1:]:
            _, local, _, state, *_ = line.split()
            if state in states:
                found.add((protocol, local.partition(":")[0]))
    return found


def cameras():
    """Emulated cameras, discovery, a camera that is opened and armed, action commands."""
    with served(ArraySource(1, 5), first_address=CAMERA):
        gige.devices()
        settings = CameraHardware(driver="gige", address=CAMERA)
        camera = open_camera("cam0", settings)
        camera.configure(settings)
        camera.arm()
        yield
        trigger = ActionTrigger(TriggerTable(source="action", broadcast="127.255.255.255"), 100.0)
        trigger.start()
        while not trigger.report()["pulses"]:
            threading.Event().wait(0.01)
        yield
        trigger.close()
        camera.close()


def stations():
    """Both ends of the stations."""
    ends = [open_transport(connect=[ENDPOINT]), open_transport(listen=[ENDPOINT])]
    yield
    for end in ends:
        end.close()


def events():
    """Datagrams of other devices."""
    lines = UdpLines("imu", "127.0.0.1:0")
    yield
    lines.close()


def streams():
    """NatNet servers, unicast and multicast, with a client."""
    for group in (None, "239.255.42.99"):
        settings = NatNetSettings(address=STREAMS, command_port=0, data_port=0, group=group)
        with NatNetServer((), settings) as server, socket.socket(type=socket.SOCK_DGRAM) as client:
            client.bind((STREAMS, 0))
            client.settimeout(10)
            client.sendto(struct.pack("<HH", 0, 0), (STREAMS, server.command_port))
            client.recv(2048)
            yield


def planted():
    """What must be found."""
    with socket.create_server(("0.0.0.0", 7463)):
        yield


def main():
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    seen, over = set(), threading.Event()

    def look():
        while not over.wait(0.002):
            seen.update(open_addresses())

    looking = threading.Thread(target=look)
    looking.start()
    for part in (cameras, stations, events, streams, *([planted] if sys.argv[1:] == ["plant"] else [])):
        for _ in part():
            seen.update(open_addresses())
    over.set()
    looking.join()
    print(json.dumps(sorted(seen)))


if __name__ == "__main__":
    main()
