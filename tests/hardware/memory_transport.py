"""An engine without a network: all ends in one process, and a cable that can be cut."""

import fnmatch
import threading


class Exchange:
    """What the ends share."""

    def __init__(self):
        self.ends, self.guard = [], threading.RLock()

    def open(self):
        end = MemoryTransport(self)
        with self.guard:
            self.ends.append(end)
        return end


class MemoryTransport:
    """A Transport; ``cut`` loses what is sent, ``die`` ends without a word, as a killed process does."""

    def __init__(self, exchange):
        self._exchange, self.cut, self.closed = exchange, False, False
        self._subscribers, self._answers = [], {}

    def publish(self, key, payload):
        if self.cut or self.closed:
            return not self.closed
        for end in list(self._exchange.ends):
            for pattern, take in end._subscribers:
                if not end.cut and fnmatch.fnmatchcase(key, pattern):
                    take(key, payload)
        return True

    def subscribe(self, pattern, take):
        self._subscribers.append((pattern, take))

    def declare_queryable(self, key, reply):
        self._answers[key] = reply

    def query(self, key, payload, timeout_s):
        if self.cut or self.closed:
            return None
        for end in list(self._exchange.ends):
            if not end.cut and key in end._answers:
                return end._answers[key](payload)
        return None

    def close(self):
        if self.closed:
            return
        self.closed = True
        with self._exchange.guard:
            self._exchange.ends.remove(self)

    die = close
