"""The package ``motioncapture`` as its own example uses it: PORT FRAMES; prints each body's pose, and the time."""

import sys
import time

import motioncapture

port, count = sys.argv[1:3]
where = {"hostname": "127.0.0.1", "interface_ip": "127.0.0.1", "port_command": port}
client = motioncapture.connect("optitrack", where)
for _ in range(int(count)):
    client.waitForNextFrame()
    came = time.monotonic_ns()
    bodies = client.rigidBodies
    for name, one in bodies.items():
        x, y, z = one.position
        print(name, repr(float(x)), repr(float(y)), repr(float(z)), repr(one.rotation.w), came)
