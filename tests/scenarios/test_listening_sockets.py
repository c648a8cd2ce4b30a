"""Nothing receives on all interfaces unless it is told to."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from namespaces import needs_namespaces
from needs import needs_aravis, needs_module

PROGRAM = Path(__file__).parent / "listening_sockets.py"


def open_addresses(*arguments):
    """Return the addresses (protocol, hexadecimal) that the program had open in a network of its own."""
    needs_namespaces()
    needs_aravis()
    needs_module("zenoh", "stations")
    if shutil.which("unshare") is None:
        pytest.skip("the program 'unshare' is not installed (Debian: apt install util-linux)")
    command = ["unshare", "--net", sys.executable, str(PROGRAM), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [tuple(one) for one in json.loads(done.stdout)]


def on_all_interfaces(addresses):
    return [one for one in addresses if set(one[1]) == {"0"}]


def test_every_part_listens_on_the_interface_that_it_is_told():
    addresses = open_addresses()
    # 127.0.0.1 (stations, the library's sockets), the camera's 127.0.6.1, the streams' 127.0.6.2
    assert {("tcp", "0100007F"), ("udp", "0100007F"), ("udp", "0106007F"), ("udp", "0206007F")} <= set(addresses)
    assert on_all_interfaces(addresses) == []


def test_the_check_finds_what_listens_on_all():
    assert on_all_interfaces(open_addresses("plant")) == [("tcp", "00000000")]
