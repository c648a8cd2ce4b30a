"""A robot that only hears: a TCP server on loopback that answers each line with "ok"."""

import queue
import socket
import threading


class Listener:
    """Listens from construction until it is closed; ``line`` waits for the next line."""

    def __init__(self):
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._lines = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def line(self):
        return self._lines.get(timeout=60)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self._server.close()
        self._thread.join(timeout=10)

    def _serve(self):
        try:
            connection, _ = self._server.accept()
        except OSError:
            return
        with connection, connection.makefile("rw", encoding="utf-8") as lines:
            for line in lines:
                self._lines.put(line.rstrip("\n"))
                lines.write("ok\n")
                lines.flush()
