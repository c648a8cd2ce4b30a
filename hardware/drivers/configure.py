"""The order in which a GenICam camera is set, the same for every library: settings that change others come first.

Triggers off; the sensor's geometry (user sets, binning); window; pixel format; exposure and gain with their
automatics off; packet size; the features of the rig file; the trigger last. At the end all settings are read again,
since a later setting may have changed an earlier one.
"""

from collections.abc import Mapping

from hardware.driver import Capabilities, DeviceError
from hardware.drivers.features import Features, hold, number, put, text
from hardware.drivers.pixels import FORMATS
from hardware.settings import CameraHardware, Feature

# features with a key of their own in [camera.hardware]
OWN_KEYS = {
    "TriggerSelector": "trigger",
    "TriggerMode": "trigger",
    "TriggerSource": "trigger",
    "TriggerActivation": "trigger_activation",
    "ExposureTime": "exposure_us",
    "ExposureTimeAbs": "exposure_us",
    "Gain": "gain_db",
    "PixelFormat": "pixel_format",
    "OffsetX": "window",
    "OffsetY": "window",
    "Width": "window",
    "Height": "window",
    "GevSCPSPacketSize": "packet_bytes",
}
# entries of ChunkSelector that are a count of pulses on a line, and the chunks they switch on
COUNTER_CHUNKS = {"CounterValue": "ChunkCounterValue", "Triggerinputcounter": "ChunkTriggerinputcounter"}
# they change which windows are possible, so they go before the window
EARLY = ("UserSet", "Binning", "Decimation", "Sensor", "RegionSelector", "RegionMode")
# not set, but reported beside the settings
FACTS = (
    "DeviceVendorName",
    "DeviceVersion",
    "DeviceFirmwareVersion",
    "DeviceTemperature",
    "ExposureTime",
    "ExposureTimeAbs",
    "Gain",
    "PayloadSize",
    "GevSCPSPacketSize",
    "AcquisitionFrameRate",
    "AcquisitionFrameRateAbs",
    "PtpStatus",
)
RESULTING_RATES = ("AcquisitionResultingFrameRate", "ResultingFrameRate", "ResultingFrameRateAbs")
CLOCKS = ("Timestamp", "TimestampLatch", "GevTimestampTickFrequency", "GevTimestampControlLatch")


LATCHES = (
    ("TimestampLatch", "TimestampLatchValue", None),
    ("GevTimestampControlLatch", "GevTimestampValue", "GevTimestampTickFrequency"),
)
"""Command that latches the clock, feature that shows it, feature with its ticks a second (None: it shows ns)."""


class _Setter:
    def __init__(self, features: Features, camera: str) -> None:
        self.features, self.camera = features, camera
        self.taken: dict[str, Feature] = {}

    def put(self, name: str, value: Feature) -> None:
        taken = put(self.features, self.camera, name, value, OWN_KEYS.get(name, ""))
        if self.features.kind(name) != "command":
            # a repeated write moves to the end, after what was written in between
            self.taken.pop(name, None)
            self.taken[name] = taken

    def put_where_present(self, name: str, value: Feature) -> None:
        """Set a feature where the device has it and allows that; an enumeration only where it has the entry."""
        features = self.features
        kind = features.kind(name)
        if kind is None or not features.writable(name):
            return
        if kind == "enumeration" and isinstance(value, str) and value not in features.entries(name):
            return
        self.put(name, value)


def configure(features: Features, settings: CameraHardware, camera: str) -> Mapping[str, object]:
    """Set a camera and return the settings as read back (and some facts); DeviceError as ``put``."""
    _own_keys_are_free(settings, camera)
    if settings.pixel_format not in FORMATS:
        offered = features.entries("PixelFormat") if features.kind("PixelFormat") == "enumeration" else ()
        raise DeviceError(
            f"camera '{camera}': pixel_format '{settings.pixel_format}' cannot be read here; of this device's "
            f"formats these can: {', '.join(name for name in offered if name in FORMATS) or 'none'}"
        )
    setter = _Setter(features, camera)
    setter.put_where_present("TLParamsLocked", 0)
    _triggers_off(setter)
    setter.put_where_present("AcquisitionMode", "Continuous")
    early = {name: value for name, value in settings.features.items() if name.startswith(EARLY)}
    for name, value in early.items():
        setter.put(name, value)
    _window(setter, settings)
    setter.put("PixelFormat", settings.pixel_format)
    _light(setter, settings)
    if settings.packet_bytes is not None:
        setter.put("GevSCPSPacketSize", settings.packet_bytes)
    if settings.trigger != "Off":
        setter.put_where_present("AcquisitionFrameRateEnable", False)
    for name, value in settings.features.items():
        if name not in early:
            setter.put(name, value)
    _trigger(setter, settings)
    if settings.trigger_counter:
        _count_triggers(setter, settings)
    return _read_again(setter)


def exposure_ns(features: Features, settings: CameraHardware) -> int:
    """Return the exposure [ns] read from the device; without such a feature the requested one, or 0."""
    exposure_us = number(features, "ExposureTime", "ExposureTimeAbs")
    if exposure_us is None:
        exposure_us = settings.exposure_us or 0.0
    return round(exposure_us * 1000.0)


def capabilities_of(features: Features, device_clock: bool | None = None) -> Capabilities:
    """Return a device's capabilities from its GenICam feature tree; ``device_clock`` overrides that of the tree."""
    sources = features.entries("TriggerSource") if features.kind("TriggerSource") == "enumeration" else ()
    clock = any(features.kind(name) is not None for name in CLOCKS)
    return Capabilities(
        device_clock=clock if device_clock is None else device_clock,
        stamp_event="exposure_start",
        hardware_trigger=any(source.startswith("Line") for source in sources),
        software_trigger="Software" in sources and features.kind("TriggerSoftware") == "command",
        scheduled_action=any(source.startswith("Action") for source in sources)
        and features.kind("ActionDeviceKey") is not None,
        ptp=any(features.kind(name) is not None for name in ("PtpEnable", "GevIEEE1588")),
        window=all(features.kind(name) == "integer" for name in ("OffsetX", "OffsetY", "Width", "Height")),
        trigger_counter=counter_chunk(features) is not None,
        max_triggered_hz=number(features, *RESULTING_RATES),
    )


def latch_of(features: Features) -> tuple[str, str, int] | None:
    """Return command, value and ticks a second of the device's clock, None where it cannot be read."""
    for command, value, frequency in LATCHES:
        if features.kind(command) != "command" or features.kind(value) is None:
            continue
        ticks = 10**9 if frequency is None else int(number(features, frequency) or 0)
        if ticks > 0:
            return command, value, ticks
    return None


def counter_chunk(features: Features) -> str | None:
    """Return the entry of ChunkSelector that is a count of pulses on a line, None where the device has none."""
    if features.kind("ChunkModeActive") is None or features.kind("ChunkSelector") != "enumeration":
        return None
    return next((name for name in COUNTER_CHUNKS if name in features.entries("ChunkSelector")), None)


def _count_triggers(setter: _Setter, settings: CameraHardware) -> None:
    features = setter.features
    setter.put_where_present("ChunkModeActive", True)  # some devices list their chunks only then
    name = counter_chunk(features)
    if name is None:
        there = features.entries("ChunkSelector") if features.kind("ChunkSelector") == "enumeration" else ()
        raise DeviceError(
            f"camera '{setter.camera}': trigger_counter = true asked for, but the device has no chunk of "
            f"{' or '.join(COUNTER_CHUNKS)}; it has {', '.join(there) or 'none'}. Leave it out"
        )
    setter.put("ChunkSelector", name)
    setter.put("ChunkEnable", True)
    if features.kind("CounterEventSource") is not None:
        setter.put_where_present("CounterSelector", "Counter0")
        setter.put("CounterEventSource", settings.trigger)
        setter.put_where_present("CounterEventActivation", settings.trigger_activation)
        if features.kind("CounterReset") == "command":
            features.execute("CounterReset")


def _own_keys_are_free(settings: CameraHardware, camera: str) -> None:
    for name in settings.features:
        if name in OWN_KEYS:
            raise DeviceError(
                f"camera '{camera}': features names {name}, which has a key of its own; "
                f"set {OWN_KEYS[name]} in [camera.hardware] instead"
            )


def _triggers_off(setter: _Setter) -> None:
    # a camera may have been left waiting for the start of an acquisition or of a burst
    features = setter.features
    if features.kind("TriggerMode") is None:
        return
    if features.kind("TriggerSelector") == "enumeration":
        for selector in features.entries("TriggerSelector"):
            setter.put("TriggerSelector", selector)
            setter.put_where_present("TriggerMode", "Off")
    else:
        setter.put_where_present("TriggerMode", "Off")


def _window(setter: _Setter, settings: CameraHardware) -> None:
    features = setter.features
    # offsets to 0 first: an old offset would forbid a larger width
    setter.put_where_present("OffsetX", 0)
    setter.put_where_present("OffsetY", 0)
    window = settings.window or (0, 0, _largest(features, "Width"), _largest(features, "Height"))
    left, top, width, height = window
    setter.put("Width", width)
    setter.put("Height", height)
    for name, offset in (("OffsetX", left), ("OffsetY", top)):
        if offset or features.kind(name) is not None:
            setter.put(name, offset)


def _largest(features: Features, side: str) -> int:
    low, high, step = features.limits(side)
    # the sensor may be larger than its lit part, and its size need not be a whole number of steps
    high = min(high, number(features, f"{side}Max") or high)
    return int(high - (high - low) % step) if step else int(high)


def _light(setter: _Setter, settings: CameraHardware) -> None:
    setter.put_where_present("ExposureAuto", "Off")
    setter.put_where_present("GainAuto", "Off")
    setter.put_where_present("ExposureMode", "Timed")
    if settings.exposure_us is not None:
        older = setter.features.kind("ExposureTime") is None and setter.features.kind("ExposureTimeAbs")
        setter.put("ExposureTimeAbs" if older else "ExposureTime", float(settings.exposure_us))
    if settings.gain_db is not None:
        setter.put("Gain", float(settings.gain_db))


def _trigger(setter: _Setter, settings: CameraHardware) -> None:
    features = setter.features
    if features.kind("TriggerSelector") == "enumeration":
        setter.put("TriggerSelector", "FrameStart")
    if settings.trigger == "Off":
        return
    if features.kind("TriggerMode") is None:
        raise DeviceError(
            f"camera '{setter.camera}': trigger = '{settings.trigger}' asked for, but the device cannot be "
            "triggered; trigger = 'Off' lets it run free"
        )
    setter.put("TriggerSource", settings.trigger)
    if settings.trigger.startswith("Line"):
        setter.put("TriggerActivation", settings.trigger_activation)
    setter.put("TriggerMode", "On")


def _read_again(setter: _Setter) -> Mapping[str, object]:
    features = setter.features
    settings: dict[str, object] = {}
    for name, taken in setter.taken.items():
        now = features.read(name) if features.readable(name) else taken
        hold(features, f"camera '{setter.camera}': {name}", name, taken, now)
        settings[name] = now
    for name in FACTS:
        if name not in settings and features.kind(name) is not None and features.readable(name):
            settings[name] = features.read(name)
    return settings


def model_and_serial(features: Features) -> tuple[str, str]:
    """Return the device's model and serial number as its feature tree has them, "" where it has none."""
    return text(features, "DeviceModelName"), (text(features, "DeviceSerialNumber") or text(features, "DeviceID"))
