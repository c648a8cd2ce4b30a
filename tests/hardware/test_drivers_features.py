"""The order of settings and the refusals, on a made-up device that misbehaves as real ones do."""

import os
from collections.abc import Callable, Sequence

import pytest
from driven import refused

from hardware.driver import DeviceError
from hardware.drivers import EXTRAS, devices, open_camera
from hardware.drivers.aravis_library import LIBRARY_VARIABLE
from hardware.drivers.configure import capabilities_of, configure, exposure_ns
from hardware.drivers.features import FeatureRefused, Kind
from hardware.settings import DRIVERS, CameraHardware, Feature


class Device:
    """A feature tree of values; ``on_write`` may change, refuse or ignore what is written."""

    def __init__(self, **values: Feature) -> None:
        self.values: dict[str, Feature] = {
            "TriggerMode": "On",
            "TriggerSelector": "AcquisitionStart",
            "TriggerSource": "Line1",
            "TriggerActivation": "RisingEdge",
            "PixelFormat": "Mono8",
            "OffsetX": 100,
            "OffsetY": 50,
            "Width": 500,
            "Height": 400,
            "ExposureTime": 5000.0,
            "ExposureAuto": "Continuous",
            "Gain": 0.0,
            "GainAuto": "Continuous",
            "AcquisitionFrameRateEnable": True,
            "AcquisitionMode": "SingleFrame",
            "AcquisitionResultingFrameRate": 123.0,
            **values,
        }
        self.choices = {
            "TriggerMode": ("Off", "On"),
            "TriggerSelector": ("AcquisitionStart", "FrameStart"),
            "TriggerSource": ("Line1", "Line2", "Software", "Action1"),
            "TriggerActivation": ("RisingEdge", "FallingEdge"),
            "PixelFormat": ("Mono8", "Mono12p", "Coord3D"),
            "ExposureAuto": ("Off", "Continuous"),
            "GainAuto": ("Off", "Continuous"),
            "AcquisitionMode": ("SingleFrame", "Continuous"),
        }
        self.modes = {"AcquisitionStart": "On", "FrameStart": "Off"}
        self.fixed = {"AcquisitionResultingFrameRate"}
        self.written: list[tuple[str, Feature]] = []
        self.on_write: Callable[[str, Feature], Feature] = lambda name, value: value
        self.size = 656, 491

    def names(self) -> Sequence[str]:
        return list(self.values)

    def kind(self, name: str) -> Kind | None:
        if name not in self.values:
            return None
        if name in self.choices:
            return "enumeration"
        kinds: dict[type, Kind] = {bool: "boolean", int: "integer", float: "float", str: "string"}
        return kinds[type(self.values[name])]

    def writable(self, name: str) -> bool:
        return name not in self.fixed

    def readable(self, name: str) -> bool:
        return not name.startswith("Action")

    def read(self, name: str) -> Feature:
        assert self.readable(name)
        if name == "TriggerMode":
            return self.modes[str(self.values["TriggerSelector"])]
        return self.values[name]

    def write(self, name: str, value: Feature) -> None:
        self.written.append((name, value))
        taken = self.on_write(name, value)
        self.values[name] = taken
        if name == "TriggerMode":
            self.modes[str(self.values["TriggerSelector"])] = str(taken)

    def execute(self, name: str) -> None:
        raise FeatureRefused("no commands")

    def limits(self, name: str) -> tuple[float, float, float]:
        # as in GenICam: there is only as much width as the offset leaves, and the other way round
        for size, offset, most in (("Width", "OffsetX", self.size[0]), ("Height", "OffsetY", self.size[1])):
            if name == size:
                return 4, most - int(self.values[offset]), 4
            if name == offset:
                return 0, most - int(self.values[size]), 2
        return {"ExposureTime": (10.0, 1e6, 0.0), "Gain": (0.0, 24.0, 0.0)}.get(name, (0.0, 1000.0, 0.0))

    def entries(self, name: str) -> tuple[str, ...]:
        return self.choices[name]


def settings(**more: object) -> CameraHardware:
    return CameraHardware.model_validate({"driver": "gige", "serial": "1", **more})


def test_a_window_fits_whatever_window_was_there() -> None:
    device = Device(OffsetX=600, OffsetY=400, Width=56, Height=88)
    taken = configure(device, settings(window=(160, 90, 496, 400)), "a")
    assert [taken[name] for name in ("OffsetX", "OffsetY", "Width", "Height")] == [160, 90, 496, 400]


def test_the_whole_sensor_without_a_window() -> None:
    device = Device(OffsetX=600, OffsetY=400, Width=56, Height=88)
    taken = configure(device, settings(), "a")
    # 491 lines are no whole number of steps of 4
    assert [taken[name] for name in ("OffsetX", "OffsetY", "Width", "Height")] == [0, 0, 656, 488]


def test_other_triggers_and_automatics_go_off_and_the_trigger_comes_last() -> None:
    device = Device()
    taken = configure(
        device, settings(exposure_us=800, gain_db=2, trigger="Line2", trigger_activation="FallingEdge"), "a"
    )
    assert device.modes == {"AcquisitionStart": "Off", "FrameStart": "On"}
    assert device.written[-3:] == [
        ("TriggerSource", "Line2"),
        ("TriggerActivation", "FallingEdge"),
        ("TriggerMode", "On"),
    ]
    assert device.values["ExposureAuto"] == device.values["GainAuto"] == "Off"
    assert device.values["AcquisitionFrameRateEnable"] is False
    assert device.values["AcquisitionMode"] == "Continuous"
    assert taken["ExposureTime"] == 800.0
    assert exposure_ns(device, settings()) == 800_000


def test_free_running_leaves_the_rate_to_the_features() -> None:
    device = Device(AcquisitionFrameRate=30.0)
    taken = configure(device, settings(trigger="Off", features={"AcquisitionFrameRate": 99.9}), "a")
    assert taken["AcquisitionFrameRate"] == 99.9
    assert device.values["AcquisitionFrameRateEnable"] is True
    assert set(device.modes.values()) == {"Off"}


def test_features_that_change_the_geometry_come_before_the_window() -> None:
    device = Device(BinningHorizontal=1, TriggerDelay=0.0)
    configure(device, settings(features={"TriggerDelay": 5.0, "BinningHorizontal": 2}), "a")
    order = [name for name, _ in device.written]
    assert order.index("BinningHorizontal") < order.index("Width") < order.index("TriggerDelay")


def test_a_device_that_takes_another_value_in_silence_is_told() -> None:
    device = Device()
    device.on_write = lambda name, value: 1000.0 if name == "ExposureTime" else value
    with refused("camera 'left'", "ExposureTime (exposure_us)", "1010", "1000", "10 to 1000000"):
        configure(device, settings(exposure_us=1010), "left")
    # half a percent is the device's rounding
    configure(device, settings(exposure_us=1004), "left")


def test_a_later_setting_that_moves_an_earlier_one_is_told() -> None:
    device = Device(AcquisitionFrameRate=30.0)

    def write(name: str, value: Feature) -> Feature:
        if name == "AcquisitionFrameRate":
            device.values["ExposureTime"] = 500.0
        return value

    device.on_write = write
    with refused("ExposureTime = 800 asked for", "took 500"):
        configure(device, settings(exposure_us=800, features={"AcquisitionFrameRate": 200.0}), "left")


def test_a_device_that_refuses_is_told_with_its_reason() -> None:
    device = Device()

    def write(name: str, value: Feature) -> Feature:
        if name == "Gain":
            raise FeatureRefused("register is locked")
        return value

    device.on_write = write
    with refused("Gain (gain_db) = 3", "register is locked", "0 to 24"):
        configure(device, settings(gain_db=3), "left")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"window": (0, 0, 499, 400)}, ("Width (window) = 499", "in steps of 4")),
        ({"window": (400, 0, 400, 400)}, ("OffsetX (window) = 400", "0 to 256")),
        ({"pixel_format": "Coord3D"}, ("Coord3D", "Mono8, Mono12p")),
        ({"pixel_format": "Mono16"}, ("PixelFormat (pixel_format) = 'Mono16'", "Mono12p")),
        ({"trigger": "Line7"}, ("TriggerSource (trigger) = 'Line7'", "Line1, Line2, Software, Action1")),
        ({"packet_bytes": 1500}, ("GevSCPSPacketSize", "packet_bytes")),
        ({"features": {"AcquisitionFrameRateEnable": "maybe"}}, ("'maybe'", "true, false")),
        ({"features": {"Gain": 3}}, ("features names Gain", "gain_db")),
        ({"features": {"AcquisitionResultingFrameRate": 9.0}}, ("lets nobody write",)),
    ],
)
def test_refusals(more: dict[str, object], words: tuple[str, ...]) -> None:
    device = Device()
    with refused("camera 'left'", *words):
        configure(device, settings(**more), "left")


def test_what_can_only_be_written_is_written() -> None:
    device = Device(ActionDeviceKey=0)
    taken = configure(device, settings(features={"ActionDeviceKey": 17}), "a")
    assert device.values["ActionDeviceKey"] == taken["ActionDeviceKey"] == 17


def test_older_names_of_the_exposure() -> None:
    device = Device(ExposureTimeAbs=1.0)
    del device.values["ExposureTime"]
    taken = configure(device, settings(exposure_us=800), "a")
    assert taken["ExposureTimeAbs"] == 800.0
    assert exposure_ns(device, settings()) == 800_000


def test_a_device_without_triggers_runs_free_or_is_refused() -> None:
    device = Device()
    for name in [name for name in device.values if name.startswith("Trigger")]:
        del device.values[name]
    configure(device, settings(trigger="Off"), "a")
    with pytest.raises(DeviceError, match="cannot be triggered"):
        configure(device, settings(trigger="Line1"), "a")


def test_capabilities_are_the_trees() -> None:
    can = capabilities_of(Device(TriggerSoftware=0, PtpEnable=False, GevTimestampTickFrequency=1))
    assert (can.hardware_trigger, can.ptp, can.device_clock, can.window) == (True,) * 4
    # an action needs its key, a software trigger its command
    assert (can.scheduled_action, can.software_trigger, can.trigger_counter) == (False,) * 3
    assert can.max_triggered_hz == 123.0


@pytest.mark.parametrize("driver", DRIVERS)
def test_an_sdk_that_is_not_there_is_one_helpful_line(driver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("pypylon", "pypylon.pylon", "harvesters", "harvesters.core", "cv2"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    monkeypatch.setenv(LIBRARY_VARIABLE, os.path.join(os.sep, "nowhere", "libaravis.so"))
    wanted = CameraHardware(driver=driver, address="1", trigger="Off", producer="any.cti")
    with refused("cannot be used", "camera 'left'", driver, EXTRAS[driver]):
        open_camera("left", wanted)
    with refused("cannot be used", driver, EXTRAS[driver]):
        devices(driver)
