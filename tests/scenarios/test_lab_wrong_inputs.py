"""Wrong inputs to the verbs of devices, through the command line: one line, exit code 2, nothing half written."""

import socket
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))

from capture_rig import Line, openers, write_rig
from loopback import free_address
from needs import needs_aravis, needs_module

from hardware.emulate.store import FrameStore
from reports import viewer_program
from scenarios.lab import capture as capture_module
from scenarios.lab import station_verbs

FIRST = 'driver = "gige"\nserial = "nobody-a1"'
TWIN = "[twin]\nrecording = 'take'\n"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("--out new", "Missing option '--rig'"),
        ("--rig rig.toml", "Missing option '--out'"),
        ("--rig none.toml --out new", "none.toml: no such file"),
        ("--rig full --out new", "full: is a folder; a TOML file is wanted"),
        ("--rig bytes.toml --out new", "bytes.toml: cannot be read"),
        ("--rig other.toml --out new", "unknown key 'title'"),
        ("--rig plain.toml --out new", "camera 'a1' has no [camera.hardware]; say which device it is"),
        ("--rig rig.toml --out full", "full: is there already; choose another folder"),
        ("--rig rig.toml --out file.txt", "file.txt: is there already"),
        ("--rig rig.toml --out file.txt/new", "file.txt is no folder; choose another place"),
        ("--rig rig.toml --out /proc/new", "/proc/new: cannot be written"),
        ("--rig rig.toml --out new --frames 0", "0 is not in the range"),
        ("--rig rig.toml --out new --frames many", "'many' is not a valid integer"),
        ("--rig rig.toml --out new --seconds 0", "0.0 is not in the range"),
        ("--rig rig.toml --out new --seconds nan", "nan is no finite number"),
        ("--rig rig.toml --out new --seconds inf", "inf is no finite number"),
        ("--rig rig.toml --out new --seconds 5s", "'5s' is not a valid float"),
        ("--rig rig.toml --out new --seconds 5 --frames 5", "exclude each other"),
        ("--rig rig.toml --out new --settings none.toml", "none.toml: no such file"),
        ("--rig rig.toml --out new --settings other.toml", "unknown key 'title'"),
        ("--rig rig.toml --out new --detections --settings background.toml", "a live run has no first pass"),
        ("--rig rig.toml --out new --program none.toml", "none.toml: no such file"),
        ("--rig rig.toml --out new --program other.toml", "unknown key 'title'"),
        ("--rig rig.toml --out new --program take", "take: is a folder"),
    ],
)
def test_capture(refused, given, told):
    assert told in refused("capture " + given)


@pytest.mark.parametrize(
    ("find", "put", "more", "told"),
    [
        ('"gige"', '"usb9"', "", "'usb9' given; 'gige', 'pylon', 'gentl' or 'webcam' is wanted"),
        (FIRST, 'serial = "1"', "", "'driver' is missing"),
        (FIRST, 'driver = "gige"', "", "serial or address is needed"),
        (FIRST, FIRST + '\nexposure_us = "800 us"', "", "'800 us' given"),
        (FIRST, FIRST + "\nexposure_ms = 0.8", "", "'exposure_ms'; did you mean 'exposure_us'?"),
        (FIRST, FIRST + "\nexposure_us = nan", "", "nan given"),
        (FIRST, FIRST + '\ntrigger = "line1"', "", "'line1' given; Off, Software, Line0 to Line9 and Action1"),
        (FIRST, FIRST + "\nwindow = [0, -1, 3, 4]", "", "offsets from 0"),
        (FIRST, FIRST + "\nwindow = [0, 1, 3]", "", "window"),
        (FIRST, FIRST + "\npacket_bytes = 100", "", "100 given"),
        (FIRST, FIRST + "\nfeatures = { X = [1] }", "", "[1] given"),
        ("nobody-a1", "nobody-a2", "", "'a1' and 'a2' name the same device"),
        ('name = "a1"', 'name = "a2"', "", "'a2' stands twice"),
        ('"gige"', '"gentl"', "", "camera 'a1' [camera.hardware]: driver 'gentl' needs producer"),
        ("rate_hz = 50.0", "rate_hz = 0", "", "0 given"),
        ("rate_hz = 50.0", "rate_hz = 'fast'", "", "'fast' given"),
        ("rate_hz = 50.0", "rate_fps = 50", "", "'rate_fps'; did you mean 'rate_hz'?"),
        ("", "", '[hardware.trigger]\nsource = "magic"\n', "'magic' given"),
        ("", "", '[hardware.trigger]\nsource = "serial"\n', "source 'serial' needs port"),
        ("", "", '[hardware.trigger]\nsource = "master"\n', "source 'master' needs camera"),
        ("", "", '[hardware.trigger]\nsource = "master"\ncamera = "z"\n', "camera 'z' is none of a1, a2, b1, b2"),
    ],
)
@pytest.mark.parametrize(
    "verb",
    [
        "capture --out new --rig changed.toml",
        "rig check --devices changed.toml",
        "station detect --name A --connect tcp/127.0.0.1:7 --rig changed.toml",
        "live hardware:changed.toml",
    ],
)
def test_rig_files(refused, changed, verb, find, put, more, told):
    changed(find, put, more)
    line = refused(verb)
    assert told in line
    assert "changed.toml" in line


@pytest.mark.parametrize(
    ("find", "put", "told"),
    [
        (FIRST, FIRST, "driver 'gige' sees no device with serial 'nobody-a1'"),
        (FIRST, FIRST.replace("gige", "pylon"), "driver 'pylon' sees no device with serial 'nobody-a1'"),
        (FIRST, FIRST.replace("gige", "gentl") + '\nproducer = "none.cti"', "no GenTL producer at"),
        (FIRST, FIRST.replace("gige", "gentl") + '\nproducer = "file.txt"', "file.txt"),
        (FIRST, FIRST.replace("gige", "webcam"), "a webcam has no serial"),
        (FIRST, 'driver = "webcam"\naddress = "99"', "sees no device with address '99'"),
        (FIRST, 'driver = "webcam"\naddress = "none.avi"', "no video file at none.avi"),
        (FIRST, 'driver = "webcam"\naddress = "file.txt"', "is it a video that OpenCV can read?"),
    ],
)
def test_devices_that_are_not_there(refused, changed, find, put, told):
    if "gige" in put:
        needs_aravis()
    for driver, module in (("pylon", "pypylon"), ("gentl", "harvesters")):
        if f'"{driver}"' in put:
            needs_module(module, driver)
    changed(find, put)
    assert told in refused("capture --out new --rig changed.toml")


@pytest.mark.parametrize(
    ("put", "absent", "told"),
    [
        (FIRST.replace("gige", "pylon"), "pypylon", "pip install 'mosca-testbench[pylon]'"),
        (FIRST.replace("gige", "gentl") + '\nproducer = "x.cti"', "harvesters", "mosca-testbench[gentl]'"),
    ],
)
def test_software_that_is_not_installed(refused, changed, monkeypatch, put, absent, told):
    for name in [name for name in sys.modules if name.split(".")[0] == absent]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, absent, None)
    changed(FIRST, put)
    line = refused("capture --out new --rig changed.toml")
    assert "cannot be used" in line
    assert told in line


def test_stations_without_their_engine(refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)
    monkeypatch.delitem(sys.modules, "hardware.transport.zenoh_engine", raising=False)
    line = refused("station rig --connect tcp/127.0.0.1:7 --out new.toml")
    assert "pip install 'mosca-testbench[stations]'" in line


@pytest.fixture
def webcams(lab_folder):
    """A rig file of one camera that plays a video."""
    video = lab_folder / "film.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (64, 48))
    for _ in range(3):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    path = lab_folder / "webcam.toml"

    def write(trigger, size="[64, 48]"):
        path.write_text(
            f'[[camera]]\nname = "w"\nsize = {size}\n[camera.hardware]\ndriver = "webcam"\naddress = "{video}"\n'
            f'trigger = "Off"\n[hardware.trigger]\n{trigger}\n'
        )

    yield write
    path.unlink(missing_ok=True)
    video.unlink()


def test_triggers_and_frames_that_are_not_as_the_rig_file_says(refused, webcams, monkeypatch):
    def told(trigger, **more):
        webcams(trigger, **more)
        return refused("capture --out new --rig webcam.toml --frames 2")

    assert "frames of 64 x 48 px, the rig file says 32 x 48" in told("", size="[32, 48]")
    assert "camera 'w': has no software trigger" in told('source = "software"')
    needs_module("serial", "serial")
    assert "/dev/nowhere" in told('source = "serial"\nport = "/dev/nowhere"')
    monkeypatch.setitem(sys.modules, "serial", None)
    monkeypatch.delitem(sys.modules, "hardware.triggers.serial_box", raising=False)
    assert "pip install 'mosca-testbench[serial]'" in told('source = "serial"\nport = "/dev/nowhere"')


@pytest.mark.parametrize(
    ("program", "told"),
    [
        ("[[target]]\nname = 'r'\naddress = '127.0.0.1:1'\n", "target 'r' at 127.0.0.1:1: no connection"),
        ("[[target]]\nname = 'r'\naddress = 'nonsense'\n", "target 'r'"),
        ("[[target]]\nname = 'r'\nkind = 'serial'\naddress = '/dev/nowhere'\n", "/dev/nowhere"),
        ("[[event]]\nname = 'e'\naddress = '10.99.99.99:7001'\n", "event 'e'"),
        ("[[event]]\nname = 'e'\naddress = '127.0.0.1:99999'\n", "event 'e'"),
        ("[[target]]\nname = 'r'\n", "'target[0].address' is missing"),
        ("[[program]]\nat_s = 1\ntarget = 'r'\ncommand = 'go'\n", "program 1: target 'r' is none of (none)"),
        ("[[program]]\nat_ms = 1\ntarget = 'r'\ncommand = 'go'\n", "'program[0].at_ms'"),
    ],
)
def test_programs(refused, lab_folder, monkeypatch, program, told):
    size = (64, 48)
    opener, trigger = openers(Line(), None, size)
    work = partial(capture_module.capture, opener=opener, trigger_opener=trigger)
    monkeypatch.setattr(capture_module, "capture", work)
    rig, path = write_rig(lab_folder / "fakes.toml", "ab", size), lab_folder / "program.toml"
    path.write_text(program)
    try:
        assert told in refused("capture --out new --frames 2 --rig", rig, "--program", path)
    finally:
        rig.unlink()
        path.unlink()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("", "Missing argument 'WHAT'"),
        ("nothing_here", "nothing_here: no such scenario or file"),
        ("full", "full: no recording in it"),
        ("bad.mcap", "bad.mcap: is not an MCAP file"),
        ("bytes.toml", "bytes.toml: cannot be read"),
        ("rig.toml", "rig.toml: [twin] wants scenario = or recording ="),
        ("take --address nonsense", "'nonsense': an IPv4 address is wanted"),
        ("take --address ||", "'': an IPv4 address is wanted"),
        ("take --address 10.99.99.99/24", "camera 'a1': address 10.99.99.99 is not to be had on this machine"),
        ("take --rate 0", "0.0 is not in the range"),
        ("take --rate nan", "nan is no finite number"),
        ("take --seconds nan", "nan is no finite number"),
        ("take --loss 2", "2.0 is not in the range"),
        ("take --loss nan", "nan is no finite number"),
        ("take --withhold -1", "-1.0 is not in the range"),
        ("take --drift inf", "inf is no finite number"),
        ("take --drift 1e9", "drift_ppm"),
        ("take --ahead 0", "0 is not in the range"),
        ("take --seed -1", "-1 is not in the range"),
        ("take --trigger line1", "'line1' is not one of"),
        ("take --reboot a1", "CAMERA@SECONDS is wanted"),
        ("take --reboot z@3", "there are the cameras a1, a2, b1, b2"),
        ("take --rig-out nowhere/r.toml", "there is no folder nowhere"),
        ("take --rig-out full.toml", "full.toml: is a folder"),
        ("take --rig-out /proc/r.toml", "/proc/r.toml: cannot be written"),
    ],
)
def test_serving(refused, given, told):
    assert told in refused("twin serve " + given)


@pytest.mark.parametrize(
    ("find", "put", "more", "told"),
    [
        ("", "", "[twin]\n", "[twin] wants scenario = or recording ="),
        ("", "", TWIN + "scenario = 'any_source'\n", "one of them"),
        ("", "", "[twin]\nrecord = 'take'\n", "unknown key 'record'; did you mean 'recording'?"),
        ("", "", "[twin]\nrecording = 'nope'\n", "nope: no such folder"),
        ("", "", "[twin]\nscenario = 'nothing_here'\n", "nothing_here: no such scenario or file"),
        ("", "", TWIN + "fps = 0\n", "0 given"),
        ("320", "322", TWIN, "size = [322, 240] given; what [twin] names has 320x240"),
        ('name = "a1"', 'name = "z"', TWIN, "camera 'z': what [twin] names has a1, a2, b1, b2"),
        ('"nobody-a1"', '"x"\naddress = "1.2.3"', TWIN, "'1.2.3': an IPv4 address is wanted"),
        ("nobody-a1", "x" * 16, TWIN, "15 bytes at most go into a camera's register"),
    ],
)
def test_serving_a_rig_file(refused, changed, find, put, more, told):
    changed(find, put, more)
    assert told in refused("twin serve changed.toml --seconds 0.1 --address", free_address())


def test_serving_where_somebody_serves_already(refused):
    address = free_address()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((address, 3956))
        told = refused("twin serve take --seconds 0.1 --address", address)
    assert f"camera 'a1': address {address} already serves a camera (port 3956 is taken)" in told


def test_what_stations_and_viewers_need_is_told_before_cameras_are_opened(refused, monkeypatch):
    """Cameras are opened by both verbs through ``read_hardware``'s table: none is."""
    opened = []
    for module, name in ((station_verbs, "RigOfStation"), (capture_module, "HardwareSource")):
        monkeypatch.setattr(module, name, lambda *given, **more: opened.append(given))
    line = refused("station detect --rig rig.toml --name A --connect tcp/10.0.0.1:7447")
    assert "endpoint 'tcp/10.0.0.1:7447': is open to the network, and no key is given" in line
    monkeypatch.setattr(viewer_program.shutil, "which", lambda name: None)
    monkeypatch.setattr(viewer_program.sys, "executable", "/none/python")
    assert "--view: the Rerun viewer is not installed" in refused(
        "capture --rig rig.toml --out new --frames 1 --view"
    )
    assert opened == []


def test_a_taken_address_of_the_stations_is_told_before_they_are_waited_for(refused):
    needs_module("zenoh", "stations")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        line = refused(f"station reconstruct --rig rig.toml --stations A --listen tcp/127.0.0.1:{port} --out new.csv")
    assert f"tcp/127.0.0.1:{port}: cannot be used (another program listens there; choose another port" in line


def test_a_taken_address_is_told_before_a_frame_is_rendered(refused, monkeypatch):
    read = []
    monkeypatch.setattr(FrameStore, "fill", lambda self, progress=None: read.append(self))
    address = free_address()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((address, 3956))
        assert "port 3956 is taken" in refused("twin serve take --seconds 0.1 --address", address)
    assert read == []
