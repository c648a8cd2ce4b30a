"""Cameras of any vendor that ships a GenTL producer (a .cti file), through harvesters and genicam."""

import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from hardware.driver import Device, DeviceError, Grabbed
from hardware.drivers.blocks import BlockIds
from hardware.drivers.features import number
from hardware.drivers.gentl_features import GenTLFeatures, first_line
from hardware.drivers.opened import GenICamCamera, chosen, claim, described, not_found, release
from hardware.drivers.pixels import whole_image
from hardware.settings import CameraHardware

# most and fewest buffers, and most bytes in all of them
BUFFERS, LEAST_BUFFERS, BUFFER_BYTES = 32, 8, 1 << 27
# a fetch of no length at all would wait for ever in harvesters
LEAST_FETCH_S = 0.001


def load() -> ModuleType:
    """Import harvesters; ImportError where it is not installed."""
    with warnings.catch_warnings():
        # the wrapped GenICam classes have no __module__, which newer Pythons mind
        warnings.simplefilter("ignore", DeprecationWarning)
        from harvesters import core

    # its messages on the terminal also come as exceptions, or are counted; its logger has a level of its own
    logging.getLogger(core.__name__).setLevel(logging.CRITICAL)
    module: ModuleType = core
    return module


def devices(producer: str = "") -> Sequence[Device]:
    """Return the cameras that the GenTL producer at path ``producer`` sees; DeviceError where it cannot be used."""
    if not producer:
        raise DeviceError("driver 'gentl': which cameras there are says a producer; name the vendor's .cti file")
    with _loading:
        used = _producer(producer, "driver 'gentl'")
        used.update()
        return [_device(info) for info in used.infos]


def open_camera(name: str, settings: CameraHardware) -> "GentlCamera":
    """Open the camera that ``settings`` name by serial number, or by the producer's own name for it as address."""
    # an update of the device list, by a thread that opens another camera, would close the camera opened here
    with _loading:
        used = _producer(settings.producer, f"camera '{name}'")
        used.update()
        found = [_device(info) for info in used.infos]
        device = chosen(found, settings)
        if device is None:
            raise not_found(found, name, settings)
        claim(device, name)
        acquirer = None
        try:
            acquirer = _acquirer(used, used.infos[found.index(device)], f"camera '{name}': {described(device)}")
            return GentlCamera(name, device, used, acquirer)
        except BaseException:
            if acquirer is not None:
                acquirer.destroy()
            release(device)
            raise


def _acquirer(producer: "Producer", info: Any, where: str) -> Any:
    # harvesters handles Ctrl-C itself; that is for the program to decide
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT) if in_main else None
    try:
        return producer.harvester.create(info)
    except _errors() as error:
        raise DeviceError(f"{where} does not open ({first_line(error)}); does another program have it?") from None
    finally:
        if handler is not None:
            signal.signal(signal.SIGINT, handler)


def _device(info: Any) -> Device:
    return Device("gentl", str(info.model or ""), str(info.serial_number or ""), str(info.id_))


def _errors() -> tuple[type[Exception], ...]:
    from genicam import genapi, gentl

    return (gentl.GenericException, genapi.GenericException)


class Producer:
    """One loaded .cti: a process may initialise each only once; an update of its device list closes open devices."""

    def __init__(self, path: str) -> None:
        self.harvester: Any = load().Harvester()
        self.harvester.add_file(path, check_existence=True, check_validity=True)
        self.open = 0

    @property
    def infos(self) -> Sequence[Any]:
        """The devices found by the last update."""
        return list(self.harvester.device_info_list)

    def update(self) -> None:
        """Enumerate devices, unless one is open."""
        if not self.open:
            self.harvester.update()


_producers: dict[str, Producer] = {}
_loading = threading.RLock()


def _producer(path: str, where: str) -> Producer:
    path = os.path.abspath(path)
    if not os.path.isfile(path):
        raise DeviceError(f"{where}: no GenTL producer at {path}; producer must name the vendor's .cti file")
    with _loading:
        if path not in _producers:
            errors: tuple[type[Exception], ...] = (OSError, *_errors())
            try:
                _producers[path] = Producer(path)
            except errors as error:
                raise DeviceError(
                    f"{where}: GenTL producer {path} cannot be loaded ({first_line(error)}); "
                    "producer must name the vendor's .cti file"
                ) from None
        return _producers[path]


def _counting(camera: "GentlCamera") -> Any:
    class Counting(load().Callback):  # type: ignore[misc]
        """Counts the buffers that harvesters found incomplete."""

        def emit(self, context: object | None = None) -> None:
            camera.incomplete += 1

    return Counting()


class GentlCamera(GenICamCamera):
    """One camera behind a GenTL producer.

    GenTL does not define which event a stamp marks; the start of exposure is assumed. harvesters gives incomplete
    buffers back to the producer before their number can be read, so that they come without a ``block_id``.
    """

    def __init__(self, name: str, device: Device, producer: Producer, acquirer: Any) -> None:
        self._producer, self._acquirer = producer, acquirer
        self._errors = _errors()
        self._blocks = BlockIds()
        self.incomplete = self._reported = self._whole = 0
        self._fetched: Grabbed | None = None
        super().__init__(name, device, GenTLFeatures(acquirer.remote_device.node_map, self._errors))
        acquirer.add_callback(acquirer.Events.INCOMPLETE_BUFFER, _counting(self))
        producer.open += 1

    def _start(self) -> None:
        self._blocks = BlockIds()
        self.incomplete = self._reported = self._whole = 0
        self._fetched = None
        payload = number(self.features, "PayloadSize") or 1.0
        wanted = max(LEAST_BUFFERS, min(BUFFERS, int(BUFFER_BYTES / payload)))
        self._acquirer.num_buffers = max(wanted, self._acquirer.min_num_buffers)
        try:
            self._acquirer.start()
        except self._errors as error:
            raise self._error(f"does not start ({first_line(error)})") from None

    def _fetch(self, timeout_s: float) -> Grabbed | None:
        if self._fetched is None:
            self._fetched = self._next(timeout_s)
        # buffers that harvesters skipped came before the one that it returned
        if self.incomplete > self._reported:
            self._reported += 1
            return Grabbed(None, None, time.monotonic_ns(), self._exposure_ns, None, "INCOMPLETE")
        fetched, self._fetched = self._fetched, None
        return fetched

    def _next(self, timeout_s: float) -> Grabbed | None:
        try:
            buffer = self._acquirer.try_fetch(timeout=max(LEAST_FETCH_S, timeout_s))
        except self._errors as error:
            raise self._gone(first_line(error)) from None
        host_ns = time.monotonic_ns()
        if buffer is None:
            return None
        try:
            self._whole += 1
            return self._grabbed(buffer, host_ns)
        finally:
            buffer.queue()

    def _grabbed(self, buffer: Any, host_ns: int) -> Grabbed:
        raw = buffer.module
        parts = [part for part in (buffer.payload.components if buffer.payload else []) if part is not None]
        image, note = None, f"NO_IMAGE payload type {raw.payload_type}"
        if parts:
            part = parts[0]
            image, note = whole_image(
                np.frombuffer(raw.raw_buffer, np.uint8)[part.data_offset :],
                part.data_format_value,
                part.width,
                part.height,
                part.x_padding,
            )
        stamp = self._stamp(raw)
        return Grabbed(
            block_id=self._blocks.unwrapped(int(raw.frame_id)),
            device_ns=stamp,
            host_ns=host_ns,
            exposure_ns=self._exposure_ns,
            image=image,
            note=note,
        )

    def _stamp(self, raw: Any) -> int | None:
        if not self.capabilities.device_clock:
            return None
        try:
            return int(raw.timestamp_ns)
        except self._errors:
            # older producers count ticks of a stated frequency
            return int(raw.timestamp) * 10**9 // int(raw.parent.parent.timestamp_frequency)

    def _stop(self) -> None:
        try:
            self._acquirer.stop()
        except self._errors as error:
            raise self._error(f"does not stop ({first_line(error)})") from None

    def _counts(self) -> Mapping[str, int]:
        return {"whole_buffers": self._whole, "incomplete_buffers": self.incomplete}

    def _free(self) -> None:
        try:
            self._acquirer.destroy()
        finally:
            self._producer.open -= 1
