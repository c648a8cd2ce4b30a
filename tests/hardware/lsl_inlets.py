"""Inlets of the Lab Streaming Layer in tests: found on loopback alone, and in a session of this process's own."""

import os

from natnet_clients import PATIENT_S, until
from needs import needs_module

CONFIG = """
[ports]
IPv6 = disable
[multicast]
ResolveScope = machine
ListenAddress = 127.0.0.1
AddressesOverride = {{127.0.0.1}}
[lab]
KnownPeers = {{127.0.0.1}}
SessionID = {session}
[log]
level = -2
"""


def config():
    """Return a configuration of liblsl that sends nothing out of this machine."""
    return CONFIG.format(session=f"test{os.getpid()}")


def lsl():
    """Return pylsl, whose library has not been used with another configuration; skip without it."""
    found = needs_module("pylsl", "lsl")
    if not hasattr(lsl, "ready"):
        found.set_config_content(config())
        lsl.ready = True
    return found


def inlet(name, buffered_s=360):
    """Return an inlet of the stream ``name`` that is connected."""
    (found,) = lsl().resolve_byprop("name", name, 1, PATIENT_S)
    made = lsl().StreamInlet(found, max_buflen=buffered_s, recover=True)
    made.open_stream(PATIENT_S)
    return made


def heard(server, count):
    """Wait until so many of a server's outlets have an inlet."""
    until(lambda: sum(one.have_consumers() for one in server._outlets) == count)


def samples(made, count):
    """Return (values, stamps) of the next ``count`` samples."""
    pulled = [made.pull_sample(PATIENT_S) for _ in range(count)]
    assert all(values is not None for values, _ in pulled)
    return [values for values, _ in pulled], [stamp for _, stamp in pulled]


def channels(made):
    """Return each channel's description as a dictionary."""
    found, one = [], made.info(PATIENT_S).desc().child("channels").child("channel")
    while not one.empty():
        keys = ("label", "type", "unit", "marker", "object")
        found.append({key: one.child_value(key) for key in keys if one.child_value(key)})
        one = one.next_sibling()
    return found
