"""How much is being compiled, for people who wait."""

from typing import Any

from numba.core.event import Event, Listener, install_listener


class CompiledCount(Listener):
    """Counts functions that Numba compiles, in this process, from where it is made on; loading kept code is none."""

    def __init__(self) -> None:
        self.functions = 0
        self._installed = install_listener("numba:compile", self)
        self._installed.__enter__()

    def on_start(self, event: Event) -> Any:
        """Count a function that is about to be compiled."""
        self.functions += 1

    def on_end(self, event: Event) -> Any:
        """Do nothing: what counts is that something is compiled."""

    def close(self) -> None:
        """Stop counting."""
        self._installed.__exit__(None, None, None)
