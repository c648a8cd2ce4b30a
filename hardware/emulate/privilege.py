"""Who may write: the control privilege of the standard, lost where its holder is not heard of in time."""

from hardware.emulate.standard import CONTROL_ACCESS, EXCLUSIVE_ACCESS, Refused, Status

Client = tuple[str, int]
MILLION = 1_000_000


class Privilege:
    """Held by at most one client, which is an address and a port; anyone may read unless access is exclusive."""

    def __init__(self) -> None:
        self.holder: Client | None = None
        self.level = 0
        self._heard_ns = 0

    def ask(self, client: Client, level: int, now_ns: int) -> bool:
        """Give ``client`` the access ``level`` (0: give it back); Refused where another holds it.

        Returns whether it was given back.
        """
        if self.holder not in (None, client):
            raise Refused(Status.ACCESS_DENIED)
        had = self.holder is not None
        self.level = level & (EXCLUSIVE_ACCESS | CONTROL_ACCESS)
        self.holder = client if self.level else None
        self._heard_ns = now_ns
        return had and not self.level

    def check_write(self, client: Client) -> None:
        """Refuse a write by a client that does not hold control."""
        if self.holder != client:
            raise Refused(Status.ACCESS_DENIED)

    def check_read(self, client: Client) -> None:
        """Refuse a reading where another client has exclusive access."""
        if self.level & EXCLUSIVE_ACCESS and self.holder != client:
            raise Refused(Status.ACCESS_DENIED)

    def heard(self, client: Client, now_ns: int) -> None:
        """Take note that ``client`` is alive: each command of the holder counts as a heartbeat."""
        if client == self.holder:
            self._heard_ns = now_ns

    def expired(self, now_ns: int, timeout_ms: int) -> bool:
        """Return whether the holder has been silent for longer than ``timeout_ms``."""
        return self.holder is not None and now_ns - self._heard_ns > timeout_ms * MILLION

    def drop(self) -> None:
        """Take the control away."""
        self.holder, self.level = None, 0
