"""Two PCs on this one: network namespaces, each on a cable (veth) of its own to the test's own."""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest

from hardware.transport import Trust

PORT = 7461
TRUST = Trust(bytes(range(32)))


def why_not():
    """Return why there can be no namespaces here, "" where there can."""
    if not sys.platform.startswith("linux"):
        return "network namespaces are Linux's"
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "the program 'ip' is not installed (Debian: apt install iproute2)"
    tried = subprocess.run(["ip", "netns", "add", _name("try")], capture_output=True, text=True)
    if tried.returncode:
        return f"network namespaces are not allowed here ({tried.stderr.strip()})"
    subprocess.run(["ip", "netns", "del", _name("try")], check=True)
    return ""


def needs_namespaces():
    """Skip with a reason where there are none; in CI that is a failure."""
    reason = why_not()
    if reason and os.environ.get("MOSCA_CI"):
        pytest.fail(f"{reason}, and this is CI, which has them")
    if reason:
        pytest.skip(reason)


class Pc:
    """One namespace: ``endpoint`` is where its programs reach the test's side."""

    def __init__(self, number):
        self.name, self.cable = _name(f"n{number}"), _name(f"v{number}")
        net = f"10.{200 + number}.{os.getpid() % 250}"
        self.here, self.there = f"{net}.1", f"{net}.2"
        self.endpoint = f"tcp/{self.here}:{PORT}"

    def build(self):
        other = _name(f"w{self.name[-1]}")
        ip("netns", "add", self.name)
        ip("link", "add", self.cable, "type", "veth", "peer", "name", other, "netns", self.name)
        ip("addr", "add", f"{self.here}/30", "dev", self.cable)
        ip("link", "set", self.cable, "up")
        for command in (
            ["addr", "add", f"{self.there}/30", "dev", other],
            ["link", "set", other, "up"],
            ["link", "set", "lo", "up"],
        ):
            ip("-n", self.name, *command)

    def cut(self):
        ip("link", "set", self.cable, "down")

    def mend(self):
        ip("link", "set", self.cable, "up")

    def start(self, script, *arguments, **kwargs):
        """Start a Python program in this PC."""
        command = ["ip", "netns", "exec", self.name, sys.executable, str(script), *map(str, arguments)]
        return subprocess.Popen(command, **kwargs)

    def remove(self):
        for command in (["link", "del", self.cable], ["netns", "del", self.name]):
            subprocess.run(["ip", *command], capture_output=True, check=False)


@contextmanager
def pcs(count=2):
    """Yield PCs; cables and namespaces are gone afterwards."""
    made = [Pc(number) for number in range(count)]
    try:
        for pc in made:
            pc.build()
        yield made
    finally:
        for pc in made:
            pc.remove()


def ip(*arguments):
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def _name(end):
    return f"mo{os.getpid() % 10**7}{end}"
