"""Frames made from numbered buffers."""

from collections.abc import Mapping

from hardware.driver import DeviceReport
from hardware.pulse_numbers.camera_state import NumberedBuffer
from hardware.settings import HardwareTable
from mosca.data.frames import Frame, StampEvent


class FrameMaker:
    """Frames in pulse time: pulse k is at k periods, plus the deviation of the camera's stamp.

    ``events``: the event that the stamps of each camera mark. ``reports``: the size of its frames. ``shared``: the
    rate, and which frames are accepted without doubt.
    """

    def __init__(
        self, shared: HardwareTable, events: Mapping[str, StampEvent], reports: Mapping[str, DeviceReport]
    ) -> None:
        self._period_ns, self._time_error_ns = 1e9 / shared.rate_hz, shared.time_error_ms * 1e6
        self._accept_unproven = shared.accept_unproven
        self._events, self._reports = events, reports
        self._last_index: dict[str, int] = {}
        self._index_base = dict.fromkeys(events, 0)

    def frame(self, one: NumberedBuffer) -> Frame:
        """Return the frame of a buffer; corrupt where it holds no complete image."""
        buffer = one.buffer
        return Frame(
            one.camera,
            self._index(one),
            round(one.pulse * self._period_ns + one.residual_ns),
            buffer.exposure_ns,
            buffer.image,
            "corrupt" if buffer.image is None else "ok",
            self._events[one.camera],
            note=buffer.note if buffer.image is None else self._doubt(one),
            rows=self._reports[one.camera].height,
        )

    def _doubt(self, one: NumberedBuffer) -> str:
        """Return a text of what is uncertain about the pulse or the time of a frame, "" where both are known."""
        if one.found == "arrival" and not self._accept_unproven:
            return "its pulse is known by its arrival alone"
        if one.error_ns > self._time_error_ns:
            return f"its time is known to {one.error_ns / 1e6:.1f} ms"
        return ""

    def _index(self, one: NumberedBuffer) -> int:
        """Return the camera's block id, made to increase where the camera restarted."""
        name = one.camera
        last = self._last_index.get(name, -1)
        if one.buffer.unidentified:
            self._last_index[name] = last + 1
            return last + 1
        block = one.pulse if one.buffer.block_id is None else one.buffer.block_id
        if block + self._index_base[name] <= last:
            self._index_base[name] = last + 1 - block
        self._last_index[name] = block + self._index_base[name]
        return self._last_index[name]
