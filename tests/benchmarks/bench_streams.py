"""NatNet clients that read a stream of 200 markers and 10 bodies at 100 Hz: frames, values, stamps, cost, latency.

    python tests/benchmarks/bench_streams.py [SECONDS]

Unicast: the package natnet, a plain client that stamps each message as it comes, one client that never reads, one
that is dead, and one that sends mutated packets. Multicast: natnet and motioncapture. Each is a process of its own.
"""

import gc
import json
import os
import random
import resource
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "hardware"))
import natnet_clients as clients  # noqa: E402

BODIES = tuple(f"body{k}" for k in range(10))
RATE_HZ, MARKERS = 100.0, 200
GROUP = "239.255.42.97"


def the_take(seconds):
    """Return tracks and poses of the benchmark."""
    return clients.take(seconds=seconds, markers=MARKERS, labelled=150, bodies=BODIES, rate_hz=RATE_HZ)


def serve(seconds, group, wanted):
    """Play once so many clients are there; print the ports, then what it cost."""
    from hardware.streams.content import TakeFrames
    from hardware.streams.play import StreamPlayer

    frames = TakeFrames(*the_take(seconds))
    with clients.server(frames.model, group=group or None) as served:
        print(served.command_port, served.data_port, flush=True)
        clients.until(lambda: served.connected() >= wanted)
        time.sleep(1.5)
        player = StreamPlayer(served)
        began, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        player.play(frames, 1 / RATE_HZ)
        late = player.late_s
        told = {
            "cores": (time.process_time() - began) / seconds,
            "late_p50_ms": float(1e3 * np.quantile(late, 0.5)),
            "late_p99_ms": float(1e3 * np.quantile(late, 0.99)),
            "grown_kB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory,
            "clients": [[one.sent, one.dropped, one.left] for one in served.clients()],
            "counts": dict(served.counts),
        }
    print(json.dumps(told), flush=True)


def natnet_reads(seconds, port, data_port, group):
    """Compare every frame that natnet gets with the take."""
    import natnet

    tracks, poses = the_take(seconds)
    gc.disable()  # millions of kept objects: a collection lasts longer than the socket's buffer
    got = []
    where = {"command_port": port, "data_port": data_port, "use_multicast": bool(group)}
    client = natnet.NatNetClient("127.0.0.1", "127.0.0.1", group or "239.255.42.99", **where)
    client.on_data_frame_received_event.handlers.append(got.append)
    client.connect(timeout=60)
    client.run_async()
    n = round(seconds * RATE_HZ)
    idle = time.monotonic() + seconds + 30
    while len(got) < n and time.monotonic() < idle:
        time.sleep(0.1)
    client.shutdown()
    xyz = tracks.xyz.astype("f4").reshape(n, MARKERS, 3)
    places = poses.position.astype("f4").reshape(n, len(BODIES), 3)
    wrong, apart = 0, []
    for one in got:
        k = one.prefix.frame_number - 1000
        same = np.array_equal([m.pos for m in one.labeled_markers], xyz[k])
        same = same and np.array_equal([b.pos for b in one.rigid_bodies], places[k])
        wrong += not same
        apart.append(one.suffix.stamp_camera_mid_exposure * 1e-7 - one.suffix.timestamp)
    print(json.dumps({
        "natnet": "multicast" if group else "unicast", "frames": len(got), "of": n, "wrong": wrong,
        "stamps_off_ms": float(1e3 * np.ptp(apart)) if apart else None,
    }))  # fmt: skip


def plain_reads(seconds, port):
    """Stamp each message as it comes."""
    with clients.PlainClient(port) as client:
        n = round(seconds * RATE_HZ)
        idle = time.monotonic() + seconds + 30
        while len(client.messages) < n and time.monotonic() < idle:
            client.send(10)
            time.sleep(0.5)
        delay = np.array([one.came - one.transmit for one in client.frames])
    p50, p99, most = 1e3 * np.array([*np.quantile(delay, [0.5, 0.99]), delay.max()])
    print(json.dumps({"plain": len(delay), "of": n, "added_ms": {"p50": p50, "p99": p99, "max": most}}))


def motioncapture_reads(seconds, port):
    """Count the frames that motioncapture gets, and compare its bodies."""
    import motioncapture

    where = {"hostname": "127.0.0.1", "interface_ip": "127.0.0.1", "port_command": str(port)}
    client = motioncapture.connect("optitrack", where)
    n = round(seconds * RATE_HZ)
    numbers, wrong = [], 0
    while not numbers or numbers[-1] < n - 1:
        client.waitForNextFrame()
        bodies = client.rigidBodies
        k = int(bodies["body0"].position[2])
        numbers.append(k)
        wrong += any([*one.position] != [BODIES.index(name), 2.0, k] for name, one in bodies.items())
        wrong += len(bodies) != len(BODIES)
    print(json.dumps({"motioncapture": len(set(numbers)), "of": n, "wrong": wrong}))


def misbehave(seconds, port):
    """Never read, die, and send 10,000 mutated packets over the time."""
    from test_natnet_server import mutated

    hello = b"\0\0\0\0"
    sleeper = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    dead = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for one in (sleeper, dead):
        one.bind(("127.0.0.1", 0))
        one.sendto(hello, ("127.0.0.1", port))
    time.sleep(1.0)
    dead.close()
    rng, bad = random.Random(1), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bad.bind(("127.0.0.1", 0))
    for k in range(10_000):
        bad.sendto(mutated(rng), ("127.0.0.1", port))
        if k % 100 == 0:
            sleeper.sendto(b"\x0a\0\0\0", ("127.0.0.1", port))
            time.sleep(seconds / 110)
    print(json.dumps({"misbehaved": True}))


def run(seconds, group, readers, wanted):
    """Start a server and its readers; print what each tells."""
    start = [sys.executable, __file__]
    with subprocess.Popen(
        [*start, "serve", str(seconds), group, str(wanted)], stdout=subprocess.PIPE, text=True
    ) as up:
        ports = up.stdout.readline().split()
        made = []
        for name in readers:
            more = [*ports, group] if name == "natnet" else ports[:1]
            made.append(subprocess.Popen([*start, name, str(seconds), *more], stdout=subprocess.PIPE, text=True))
        for one in made:
            print("  ", one.communicate(timeout=seconds + 120)[0].strip())
        print("  ", up.stdout.read().strip())


def main():
    """Run the part that is named, or all."""
    words = sys.argv[1:]
    if words and words[0] in ("serve", "natnet", "plain", "motioncapture", "misbehave"):
        seconds = float(words[1])
        match words[0]:
            case "serve":
                serve(seconds, words[2], int(words[3]))
            case "natnet":
                natnet_reads(seconds, int(words[2]), int(words[3]), words[4])
            case "plain":
                plain_reads(seconds, int(words[2]))
            case "motioncapture":
                motioncapture_reads(seconds, int(words[2]))
            case _:
                misbehave(seconds, int(words[2]))
        return
    seconds = float(words[0]) if words else 60.0
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {seconds:g} s, {threading.active_count()} thread")
    print("unicast")
    run(seconds, "", ("natnet", "plain"), 2)
    print("unicast beside a client that never reads, a dead one and 10,000 mutated packets")
    run(seconds, "", ("natnet", "plain", "misbehave"), 4)
    print("multicast")
    run(seconds, GROUP, ("natnet", "motioncapture"), 2)


if __name__ == "__main__":
    main()
