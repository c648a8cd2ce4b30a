"""Stands for a stream's server: keeps what it is sent."""

import time

from hardware.streams.stream_server import StreamServer


class Heard(StreamServer):
    """``heard``: number, message and time [ns] of each frame that was delivered."""

    def __init__(self):
        super().__init__()
        self.heard = []

    @property
    def frames_heard(self):
        """The frames alone."""
        return [outgoing.frame for _, outgoing, _ in self.heard]

    def deliver(self, outgoing):
        self.heard.append((outgoing.frame.number, outgoing, time.monotonic_ns()))

    def where(self):
        return ""

    def connected(self):
        return 0

    def start(self):
        pass

    def shut(self, why=""):
        pass

    def lines(self):
        return []
