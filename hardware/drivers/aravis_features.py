"""The feature tree of a camera that Aravis opened."""

import ctypes
import math
import re
from collections.abc import Sequence
from typing import Any

from hardware.drivers.aravis_library import READ_ONLY, READ_WRITE, WRITE_ONLY, Aravis, AravisError, decoded
from hardware.drivers.features import FeatureRefused, Kind
from hardware.settings import Feature


class AravisFeatures:
    """The feature tree of an ArvDevice."""

    def __init__(self, aravis: Aravis, device: int) -> None:
        self._aravis, self._device = aravis, device
        self._kinds: dict[str, Kind | None] = {}

    def names(self) -> Sequence[str]:
        """Return every name of the camera's own description."""
        size = ctypes.c_size_t(0)
        start = self._aravis("device_get_genicam_xml", self._device, ctypes.byref(size))
        document = ctypes.string_at(start, size.value).decode(errors="replace") if start else ""
        return sorted(set(re.findall(r"<pFeature>\s*(\w+)\s*</pFeature>", document)))

    def kind(self, name: str) -> Kind | None:
        """Return what sort of feature it is, None where there is none of that name just now."""
        if name not in self._kinds:
            self._kinds[name] = self._kind_of(name)
        if self._kinds[name] is None or not self._there(name):
            return None
        return self._kinds[name]

    def _kind_of(self, name: str) -> Kind | None:
        node = self._aravis("device_get_feature", self._device, name.encode())
        # an enumeration is also an integer and a text to the library: the narrow types come first
        kinds: tuple[Kind, ...] = ("enumeration", "boolean", "command", "float", "integer", "string")
        return next((kind for kind in kinds if node and self._aravis.is_a(node, f"gc_{kind}")), None)

    def _there(self, name: str) -> bool:
        try:
            return bool(self._aravis("device_is_feature_available", self._device, name.encode()))
        except AravisError:
            return False

    def writable(self, name: str) -> bool:
        """Whether it can be written just now."""
        return self._mode(name) in (WRITE_ONLY, READ_WRITE)

    def readable(self, name: str) -> bool:
        """Whether it can be read just now."""
        return self._mode(name) in (READ_ONLY, READ_WRITE)

    def _mode(self, name: str) -> int | None:
        node = self._aravis("device_get_feature", self._device, name.encode())
        return self._aravis("gc_feature_node_get_actual_access_mode", node) if node else None

    def read(self, name: str) -> Feature:
        """Return the device's value."""
        kind = self._kinds.get(name) or self.kind(name)
        reader = "string" if kind == "enumeration" else kind
        value = self._call(f"device_get_{reader}_feature_value", name)
        if kind in ("enumeration", "string"):
            return decoded(value)
        return bool(value) if kind == "boolean" else float(value) if kind == "float" else int(value)

    def write(self, name: str, value: Feature) -> None:
        """Write a value that suits the feature's kind."""
        kind = self._kinds.get(name) or self.kind(name)
        writer = "string" if kind == "enumeration" else kind
        plain = value.encode() if isinstance(value, str) else value
        self._call(f"device_set_{writer}_feature_value", name, plain)

    def execute(self, name: str) -> None:
        """Execute a command."""
        self._call("device_execute_command", name)

    def limits(self, name: str) -> tuple[float, float, float]:
        """Return the least and largest value and the step (0 where there is none) of a number."""
        if self.kind(name) == "float":
            kind = "float"
            low: Any = ctypes.c_double(-math.inf)
            high: Any = ctypes.c_double(math.inf)
        else:
            kind = "integer"
            low, high = ctypes.c_int64(-(2**63)), ctypes.c_int64(2**63 - 1)
        self._described(f"device_get_{kind}_feature_bounds", name, ctypes.byref(low), ctypes.byref(high))
        step = float(self._described(f"device_get_{kind}_feature_increment", name) or 0)
        # the library returns the least double for "no step"
        return low.value, high.value, step if step > 1e-300 else 0.0

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the entries of an enumeration that are available just now."""
        try:
            return self._aravis.strings(
                "device_dup_available_enumeration_feature_values_as_strings", self._device, name.encode()
            )
        except AravisError as error:
            raise FeatureRefused(str(error)) from None

    def _described(self, call: str, name: str, *arguments: Any) -> Any:
        try:
            return self._call(call, name, *arguments)
        except FeatureRefused as error:
            # bounds and increments are optional in the GenICam XML: without them every value is allowed
            if "node not found" not in str(error):
                raise
            return None

    def _call(self, call: str, name: str, *arguments: Any) -> Any:
        try:
            return self._aravis(call, self._device, name.encode(), *arguments)
        except AravisError as error:
            raise FeatureRefused(str(error)) from None
