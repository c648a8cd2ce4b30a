"""NatNet clients that read a stream of 200 markers and 10 bodies at 100 Hz: frames, values, stamps, cost, latency.

    python tests/benchmarks/bench_streams.py [SECONDS] [awake]

``awake``: beside a busy process of the lowest priority on each core. Cores that fall asleep between frames, above all
those of a virtual machine, have cold caches at each frame, which costs time and processor.

Unicast: a plain client that stamps each message as it comes, alone and beside the package natnet, one client that
never reads, one that is dead, and one that sends mutated packets. Multicast: natnet and motioncapture. Each is a
process of its own.

Latency is taken apart by the kernel's stamp of a message: from the frame's transmission to the client's socket (the
server's and the network's part), and from there until the client's process runs (the operating system's part). Beside
it, in the same run, what two processes have that do nothing else than send and read as many bytes as often (a ping),
and a run in which each second second's ready bytes go straight into the clients' sockets: bounds without and with the
load that clients make at each frame. Frames that do not come are looked for in the clients' sockets: the kernel
counts what does not fit there.
"""

import gc
import json
import os
import random
import resource
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "hardware"))
import natnet_clients as clients  # noqa: E402

BODIES = tuple(f"body{k}" for k in range(10))
RATE_HZ, MARKERS = 100.0, 200
GROUP = "239.255.42.97"
SO_TIMESTAMPNS = 35
"""Linux: the kernel stamps what comes, in time of day [s, ns]."""
BYTES = 9882
"""Of a frame."""
PING_S = 0.0101
"""Between pings: not the frames' period, so that they fall at all times of it."""


def the_take(seconds):
    """Return tracks and poses of the benchmark."""
    return clients.take(seconds=seconds, markers=MARKERS, labelled=150, bodies=BODIES, rate_hz=RATE_HZ)


def serve(seconds, group, wanted, bare=""):
    """Play once so many clients are there; print the ports, then what it cost."""
    from hardware.streams.content import TakeFrames
    from hardware.streams.natnet.settings import NatNetSettings
    from hardware.streams.play import StreamPlayer
    from scenarios.run.priority import before_others, prompt

    frames = TakeFrames(*the_take(seconds))
    settings = {"group": group or None, "forget_s": NatNetSettings().forget_s}
    with before_others(), prompt(), clients.server(frames.model, **settings) as served:
        print(served.command_port, served.data_port, flush=True)
        clients.until(lambda: served.connected() >= wanted)
        time.sleep(1.5)
        player, taken, deliver = StreamPlayer(served), [], served.deliver

        def timed(outgoing):
            if bare and sent_bare(outgoing.frame.number):
                straight(served, outgoing)
            else:
                deliver(outgoing)
            taken.append(time.monotonic_ns() - outgoing.received_ns)

        served.deliver = timed
        began, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        player.play(frames, 1 / RATE_HZ)
        told = {
            "cores": (time.process_time() - began) / seconds,
            "handed_over_to_sent_ms": quantiles(1e-9 * np.array(taken)),
            "late_ms": quantiles(player.late_s),
            "grown_kB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory,
            "clients": [[one.sent, one.dropped, one.left] for one in served.clients()],
            "counts": dict(served.counts),
        }
    print(json.dumps(told), flush=True)


def sent_bare(number):
    """Return which frames go straight into the sockets: those of each second second."""
    return (number - 1000) // round(RATE_HZ) % 2 == 1


def straight(served, outgoing):
    """Send a frame's ready bytes to all clients, with its stamps and no account: the least there is."""
    data = bytearray(outgoing.encoded[served.settings.version])
    times = outgoing.mid_ns, outgoing.received_ns, outgoing.transmit_ns
    struct.pack_into("<QQQ", data, len(data) - 30, *(one // 100 for one in times))
    for client in served._clients.values():
        client.socket.send(data)


def quantiles(seconds):
    """Return p50, p99 and the largest of times [s] in ms, rounded to the microsecond."""
    p50, p99 = np.quantile(seconds, [0.5, 0.99])
    return {key: round(1e3 * float(one), 3) for key, one in (("p50", p50), ("p99", p99), ("max", np.max(seconds)))}


def lost_in_sockets():
    """Return how many messages did not fit in the buffers of this process's sockets, as Linux counts them."""
    own = {os.readlink(one.path) for one in os.scandir("/proc/self/fd") if os.path.lexists(one.path)}
    rows = [line.split() for line in Path("/proc/self/net/udp").read_text().splitlines()[1:]]
    return sum(int(row[-1]) for row in rows if f"socket:[{row[9]}]" in own)


def read_stamped(reader):
    """Return a message, the kernel's time of its coming and that of its reading [ns, monotonic]."""
    data, more, _, _ = reader.recvmsg(65536, 64)
    now, day = time.monotonic_ns(), time.time_ns()
    ((_, _, stamp),) = more
    whole, part = struct.unpack("qq", stamp)
    return data, whole * 1_000_000_000 + part - day + now, now


def stamping(reader):
    """Let the kernel stamp what comes to a socket; return the socket."""
    reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    reader.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    reader.settimeout(1.0)
    return reader


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
    lost = lost_in_sockets()
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
        "socket_lost": lost,
        "stamps_off_ms": float(1e3 * np.ptp(apart)) if apart else None,
    }))  # fmt: skip


def plain_reads(seconds, port, bare):
    """Stamp each message as it comes."""
    gc.disable()
    reader, to = stamping(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)), ("127.0.0.1", port)
    n, rows, size = round(seconds * RATE_HZ), [], 0
    with reader:
        reader.sendto(b"\0\0\0\0", to)
        idle = time.monotonic() + seconds + 30
        while len(rows) < n and time.monotonic() < idle:
            try:
                data, came, read = read_stamped(reader)
            except TimeoutError:
                reader.sendto(b"\x0a\0\0\0", to)
                continue
            if data[:2] == b"\x07\0":
                got = clients.Received(data, read)
                rows.append((round(got.transmit * 1e9), came, read, got.number))
                size = len(data)
                if len(rows) % 100 == 0:
                    reader.sendto(b"\x0a\0\0\0", to)
        lost = lost_in_sockets()
    told = {"plain": len(rows), "of": n, "socket_lost": lost, "bytes": size}
    straight_ones = np.array([bool(bare) and sent_bare(row[-1]) for row in rows])
    times = np.array([row[:3] for row in rows])
    print(json.dumps({**told, **latency(times[~straight_ones])}))
    if bare:
        print("   " + json.dumps({"bound": "straight into the sockets", **latency(times[straight_ones])}))


def latency(times):
    """Return the parts of the latency of messages sent, in the socket and read at ``times`` (n, 3) [ns]."""
    sent, came, read = times.T * 1e-9
    parts = {"added_ms": read - sent, "to_socket_ms": came - sent, "wake_up_ms": read - came}
    return {key: quantiles(one) for key, one in parts.items()}


def ping(seconds, size):
    """Send so many bytes in a period to a process that reads them and does nothing else: the bound of latency."""
    with subprocess.Popen([sys.executable, __file__, "echo", str(seconds)], stdout=subprocess.PIPE, text=True) as up:
        to, data = ("127.0.0.1", int(up.stdout.readline())), bytearray(size)
        late = []
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(to)
            begin, used = time.monotonic_ns(), time.process_time()
            for k in range(round(seconds / PING_S)):
                due = begin + round(k * PING_S * 1e9)
                time.sleep(max(0.0, (due - time.monotonic_ns()) * 1e-9))
                now = time.monotonic_ns()
                struct.pack_into("<q", data, 0, now)
                sender.send(data)
                late.append(1e-9 * (now - due))
            cores = (time.process_time() - used) / seconds
            sender.send(b"")
        found = json.loads(up.stdout.read())
    print(json.dumps({"bound": "ping", "cores": cores, "late_ms": quantiles(late), **found}))


def echo(_seconds):
    """Read pings until an empty one comes."""
    gc.disable()
    with stamping(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as reader:
        reader.bind(("127.0.0.1", 0))
        print(reader.getsockname()[1], flush=True)
        rows = []
        reader.settimeout(None)
        while len((found := read_stamped(reader))[0]):
            rows.append((*struct.unpack_from("<q", found[0]), *found[1:]))
    print(json.dumps(latency(np.array(rows))))


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
    missing = sorted(set(range(n)) - set(numbers))
    told = {"motioncapture": len(set(numbers)), "of": n, "wrong": wrong, "socket_lost": lost_in_sockets()}
    print(json.dumps({**told, "first_missing": missing[:10]}))


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


def run(seconds, group, readers, wanted, bare=""):
    """Start a server and its readers; print what each tells."""
    start = [sys.executable, __file__]
    with subprocess.Popen(
        [*start, "serve", str(seconds), group, str(wanted), bare], stdout=subprocess.PIPE, text=True
    ) as up:
        ports = up.stdout.readline().split()
        made = []
        for name in readers:
            more = {"natnet": [*ports, group], "plain": [ports[0], bare]}.get(name, ports[:1])
            made.append(subprocess.Popen([*start, name, str(seconds), *more], stdout=subprocess.PIPE, text=True))
        made.append(subprocess.Popen([*start, "ping", str(seconds), str(BYTES)], stdout=subprocess.PIPE, text=True))
        for one in made:
            print("  ", one.communicate(timeout=seconds + 120)[0].strip())
        print("  ", up.stdout.read().strip())


def main():
    """Run the part that is named, or all."""
    words = sys.argv[1:]
    parts = {
        "serve": lambda seconds, group, wanted, bare: serve(seconds, group, int(wanted), bare),
        "natnet": lambda seconds, port, data_port, group: natnet_reads(seconds, int(port), int(data_port), group),
        "plain": lambda seconds, port, bare: plain_reads(seconds, int(port), bare),
        "motioncapture": lambda seconds, port: motioncapture_reads(seconds, int(port)),
        "misbehave": lambda seconds, port: misbehave(seconds, int(port)),
        "ping": lambda seconds, size: ping(seconds, int(size)),
        "echo": echo,
    }
    if words and words[0] in parts:
        parts[words[0]](float(words[1]), *words[2:])
        return
    seconds = next((float(word) for word in words if word != "awake"), 60.0)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {seconds:g} s")
    busy = "import os\nos.nice(19)\nwhile True: pass"
    kept = [subprocess.Popen([sys.executable, "-c", busy]) for _ in range(os.cpu_count() or 1) if "awake" in words]
    try:
        all_runs(seconds)
    finally:
        for one in kept:
            one.kill()
            one.wait()


def all_runs(seconds):
    """Measure with one client, two, misbehaving ones, and in multicast."""
    print("unicast, one client")
    run(seconds, "", ("plain",), 1)
    print("unicast")
    run(seconds, "", ("natnet", "plain"), 2)
    print("unicast, each second second straight into the clients' sockets")
    run(seconds, "", ("natnet", "plain"), 2, "bare")
    print("unicast beside a client that never reads, a dead one and 10,000 mutated packets")
    run(seconds, "", ("natnet", "plain", "misbehave"), 4)
    print("multicast")
    run(seconds, GROUP, ("natnet", "motioncapture"), 2)


if __name__ == "__main__":
    main()
