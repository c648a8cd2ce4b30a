"""Outlets of the Lab Streaming Layer, one for each kind of content, and their stamps in its clock.

liblsl sends from threads of its own: each inlet has a queue of ``buffered_s`` whose oldest samples make room for new
ones, so that no inlet is waited for. It shows whether an outlet has inlets, but not which, nor what they lost; each
sample has the frame's number for that.

Stamps are the middle of the exposure in LSL's clock, ``lsl_local_clock``, which is C++'s steady clock, as is Python's
monotonic clock. Their difference is measured when the outlets start; inlets find the difference between computers
(``time_correction``), and LabRecorder writes it into the file.
"""

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from hardware.streams.lsl.channels import LslContent, LslMarkers, contents
from hardware.streams.stream_server import Outgoing, StreamServer
from hardware.streams.values import StreamModel, StreamNames
from mosca.errors import InputError

PLACES = 32
READINGS = 200
"""Number of readings of both clocks; the closest pair is used."""


@dataclass(frozen=True)
class LslSettings:
    """How outlets are called and described."""

    name: str = "mosca"
    """Streams are NAME_markers, NAME_bodies, NAME_segments and NAME_angles."""
    rate_hz: float = 100.0
    up: str = "z"
    places: int | None = None
    """Places for markers without a label; None: ``PLACES`` in a stream without labels, else 0."""
    buffered_s: int = 60
    source: str = field(default_factory=socket.gethostname)
    """Part of the streams' source ids, by which inlets find them again after a restart."""
    version: str = ""
    """Version of the program, for the metadata."""


def pylsl() -> Any:
    """Return the package pylsl; InputError in one line where it is not there."""
    try:
        import pylsl as found
    except (ImportError, RuntimeError, OSError) as error:  # it raises RuntimeError without liblsl
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"--stream lsl: {reason}; pip install 'mosca-testbench[lsl]'") from None
    return found


class LslServer(StreamServer):
    """Outlets of ``model``'s and ``names``' markers, bodies, segments and angles.

    Raises InputError where pylsl is missing or there is nothing to stream.
    """

    def __init__(self, model: StreamModel, names: StreamNames, settings: LslSettings | None = None) -> None:
        super().__init__()
        self.settings = settings or LslSettings()
        places = self.settings.places
        self.contents = contents(model, names, (0 if names.numbers else PLACES) if places is None else places)
        if not self.contents:
            raise InputError("--stream lsl: no labels, bodies or angles; give --bodies, or --unlabelled N places")
        self._lsl = pylsl()
        self._heard = [0] * len(self.contents)
        self._outlets: list[Any] = []
        self.start()

    def where(self) -> str:
        """Return the streams' names, units and axes as a line."""
        names = ", ".join(map(self._name, self.contents))
        return f"LSL {names}: metres, {self.settings.up} up; outlets are open on all interfaces"

    def connected(self) -> int:
        """Return 1 where an outlet has an inlet; LSL does not show how many there are."""
        return int(any(outlet.have_consumers() for outlet in tuple(self._outlets)))

    def deliver(self, outgoing: Outgoing) -> None:
        """Hand a frame's samples to liblsl."""
        if self.lost or not self._outlets:
            return
        self.frames += 1
        stamp = (outgoing.mid_ns + self._lsl_minus_host_ns) * 1e-9
        for k, (content, outlet) in enumerate(zip(self.contents, self._outlets, strict=True)):
            self._heard[k] += outlet.have_consumers()
            outlet.push_chunk(content.sample(outgoing.frame)[None], stamp)

    def start(self) -> None:
        """Open the outlets."""
        self._lsl_minus_host_ns = clock_difference_ns(self._lsl.local_clock)
        self._outlets = [
            self._lsl.StreamOutlet(self._info(content), 0, self.settings.buffered_s) for content in self.contents
        ]

    def shut(self, why: str = "server restarted") -> None:
        """Close the outlets; may be called twice."""
        self._outlets = []

    def lines(self) -> list[str]:
        """Return how many frames each stream sent while somebody listened; LSL shows no more."""
        lines = [
            f"{self._name(content)}: {heard} of {self.frames} frames while an inlet was there"
            for content, heard in zip(self.contents, self._heard, strict=True)
        ]
        for content in self.contents:
            if isinstance(content, LslMarkers) and content.left_out:
                lines.append(f"{content.left_out} markers without a label found no place; give --unlabelled more")
        return lines

    def _name(self, content: LslContent) -> str:
        return f"{self.settings.name}_{content.kind}"

    def _info(self, content: LslContent) -> Any:
        """Return a stream's description."""
        where, lsl = self.settings, self._lsl
        name = self._name(content)
        info = lsl.StreamInfo(
            name, "MoCap", len(content.channels), where.rate_hz, lsl.cf_double64, f"{where.source}_{name}"
        )
        channels = info.desc().append_child("channels")
        for one in content.channels:
            told = channels.append_child("channel")
            values = {"label": one.label, "marker": one.marker, "object": one.object}
            for key, text in {**values, "type": one.kind, "unit": one.unit}.items():
                if text:
                    told.append_child_value(key, text)
        maker = info.desc().append_child("acquisition")
        maker.append_child_value("manufacturer", "mosca")
        maker.append_child_value("model", where.version or "mosca")
        setup = info.desc().append_child("setup")
        setup.append_child_value("name", where.name)
        setup.append_child_value("up", where.up.upper())
        info.desc().append_child("synchronization").append_child_value("can_drop_samples", "true")
        return info


def clock_difference_ns(lsl_clock_s: Callable[[], float]) -> int:
    """Return LSL's clock minus this process's monotonic clock [ns], from the reading between the closest two."""
    best = None
    for _ in range(READINGS):
        before, there, after = time.monotonic_ns(), lsl_clock_s(), time.monotonic_ns()
        if best is None or after - before < best[0]:
            best = after - before, round(there * 1e9) - (before + after) // 2
    assert best is not None
    return best[1]
