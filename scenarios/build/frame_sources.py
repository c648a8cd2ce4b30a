"""Sources of a run's frames besides the twin: recordings, devices, and sources that pass frames on."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mosca.data.frames import Frame, FrameSource, WrappedSource
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.recording import RecordingWriter, open_recording
from mosca.recording.open import check_recording
from mosca.synchronisation import AssemblySettings

PATIENCE_BYTES = 1 << 28
"""Most bytes of frames that wait in open frame sets."""


def opened(source: str, rig: Rig, rate_hz: float, pulses: int) -> FrameSource:
    """Return the source that ``--source recording:DIR`` or ``hardware:RIG.toml`` names; InputError for others.

    ``rate_hz``, ``pulses``: those of the scenario; devices must run at this rate and are read for this many pulses.
    """
    kind, place = _named(source)
    if kind == "recording":
        return open_recording(Path(place), rig)
    from hardware.settings import read_hardware
    from hardware.source import HardwareSource

    devices = read_hardware(Path(place))
    missing = [name for name in rig.names if name not in devices.cameras]
    if missing:
        raise InputError(
            f"{place}: no camera '{missing[0]}', which the scenario's rig has; it names {', '.join(devices.cameras)}"
        )
    if abs(devices.shared.rate_hz / rate_hz - 1) > 1e-3:
        raise InputError(
            f"{place}: [hardware] rate_hz = {devices.shared.rate_hz:g}, the scenario's capture.frame_rate_hz is "
            f"{rate_hz:g}; give both the same"
        )
    return HardwareSource(devices, pulses)


def check_source(source: str) -> None:
    """Raise InputError where ``--source`` names nothing that exists; called before any work."""
    if source == "twin":
        return
    kind, place = _named(source)
    if kind == "recording":
        check_recording(Path(place))
    if kind == "hardware":
        from hardware.settings import read_hardware

        read_hardware(Path(place))


def _named(source: str) -> tuple[str, str]:
    """Return the kind of a source other than the twin, and its path; InputError for another kind."""
    kind, _, place = source.partition(":")
    if kind not in ("recording", "hardware") or not place:
        raise InputError(f"--source {source}: allowed are twin, recording:DIR and hardware:RIG.toml")
    return kind, place


def account(source: FrameSource) -> Mapping[str, Any]:
    """Return the source's own account of the frames that it received, for the record; empty where it keeps none."""
    report = getattr(source, "account", None)
    return report() if callable(report) else {}


def device_notes(source: FrameSource) -> dict[str, str]:
    """Return notes on the devices of ``source``, for the record; empty where it has none."""
    from hardware.source import HardwareSource

    if not isinstance(source, HardwareSource):
        return {}
    found = source.statistics
    notes = {f"devices {k + 1}": note for k, note in enumerate(found.notes)}
    if found.skipped_pulses:
        notes["skipped pulses"] = f"{found.skipped_pulses} pulses were skipped"
    if unproven := {name: one.unproven for name, one in found.cameras.items() if one.unproven}:
        told = ", ".join(f"{n} of camera '{name}'" for name, n in unproven.items())
        notes["unproven"] = f"frames whose pulses are not certain: {told}"
    if untimed := {name: one.untimed for name, one in found.cameras.items() if one.untimed}:
        told = ", ".join(f"{n} of camera '{name}'" for name, n in untimed.items())
        notes["untimed"] = f"frames whose times are not certain: {told}"
    return notes


def patient(settings: AssemblySettings, source: FrameSource) -> AssemblySettings:
    """Return settings that wait for late frames of devices up to a second, within memory, since a run is not live."""
    wanted = max(info.frame_rate_hz for info in source.cameras)
    size = sum(info.image_bytes for info in source.cameras)
    return replace(settings, open_pulses=max(settings.open_pulses, min(round(wanted), PATIENCE_BYTES // size)))


class Recorded(WrappedSource):
    """A source whose frames are recorded as they are read."""

    def __init__(self, source: FrameSource, writer: RecordingWriter) -> None:
        super().__init__(source)
        self._writer = writer

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._source:
            self._writer.write(frame)
            yield frame


class SelectedCameras(WrappedSource):
    """A source without the frames of cameras that are not in the rig, such as those on the subject."""

    def __init__(self, source: FrameSource, names: tuple[str, ...]) -> None:
        super().__init__(source)
        self._names = frozenset(names)
        self.cameras = tuple(info for info in source.cameras if info.name in self._names)

    def __iter__(self) -> Iterator[Frame]:
        return (frame for frame in self._source if frame.camera in self._names)
