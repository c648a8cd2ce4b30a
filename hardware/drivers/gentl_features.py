"""The feature tree of a camera behind a GenTL producer: genicam's node map."""

from collections.abc import Sequence
from typing import Any

from hardware.drivers.features import FeatureRefused, Kind
from hardware.settings import Feature

# GenICam's numbers of interfaces and of access modes
KINDS: dict[int, Kind] = {2: "integer", 3: "boolean", 4: "command", 5: "float", 6: "string", 9: "enumeration"}
NOT_IMPLEMENTED, NOT_AVAILABLE, WRITE_ONLY, READ_ONLY, READ_WRITE = range(5)


def first_line(error: BaseException) -> str:
    """Return an error's text without its location in GenICam's source."""
    return " ".join(str(error).split(" : ")[0].split())


class GenTLFeatures:
    """The feature tree of an acquirer's remote device."""

    def __init__(self, nodes: Any, errors: tuple[type[Exception], ...]) -> None:
        """``nodes``: genicam's node map; ``errors``: what it raises."""
        self._nodes, self._errors = nodes, errors

    def names(self) -> Sequence[str]:
        """Return the names of all features."""
        return sorted(node.node.name for node in self._nodes.nodes if node.node.is_feature())

    def kind(self, name: str) -> Kind | None:
        """Return what sort of feature it is, None where there is none of that name just now."""
        if not self._nodes.has_node(name):
            return None
        node = self._nodes.get_node(name)
        if node.get_access_mode() in (NOT_IMPLEMENTED, NOT_AVAILABLE):
            return None
        return KINDS.get(int(node.node.principal_interface_type))

    def writable(self, name: str) -> bool:
        """Whether it can be written just now."""
        return self._nodes.get_node(name).get_access_mode() in (WRITE_ONLY, READ_WRITE)

    def readable(self, name: str) -> bool:
        """Whether it can be read just now."""
        return self._nodes.get_node(name).get_access_mode() in (READ_ONLY, READ_WRITE)

    def read(self, name: str) -> Feature:
        """Return the device's value."""
        kind = self.kind(name)
        value = self._asked(lambda: self._nodes.get_node(name).value)
        if kind == "boolean":
            return bool(value)
        return float(value) if kind == "float" else int(value) if kind == "integer" else str(value)

    def write(self, name: str, value: Feature) -> None:
        """Write a value that suits the feature's kind."""
        self._asked(lambda: self._nodes.get_node(name).set_value(value))

    def execute(self, name: str) -> None:
        """Execute a command."""
        self._asked(lambda: self._nodes.get_node(name).execute())

    def limits(self, name: str) -> tuple[float, float, float]:
        """Return the least and largest value and the step (0 where there is none) of a number."""
        node = self._nodes.get_node(name)
        stepped = self.kind(name) == "integer" or node.has_inc()
        limits: tuple[float, float, float] = self._asked(lambda: (node.min, node.max, node.inc if stepped else 0.0))
        return limits

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the entries of an enumeration that are available just now."""
        return tuple(
            self._asked(
                lambda: [
                    entry.symbolic
                    for entry in self._nodes.get_node(name).entries
                    if entry.get_access_mode() not in (NOT_IMPLEMENTED, NOT_AVAILABLE)
                ]
            )
        )

    def _asked(self, question: Any) -> Any:
        try:
            return question()
        except self._errors as error:
            raise FeatureRefused(first_line(error)) from None
