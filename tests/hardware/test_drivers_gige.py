"""The Aravis driver on Aravis' own fake camera."""

from contextlib import closing

import numpy as np
import pytest
from driven import FAKE_ADDRESS, HEIGHT, WIDTH, fake_gige_camera, grab_for, refused, wait_long_for_packets

from hardware.driver import Grabbed
from hardware.drivers import open_camera
from hardware.settings import CameraHardware


def test_frames_ids_and_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    wait_long_for_packets(monkeypatch)
    with fake_gige_camera("FAKE2") as settings:
        wanted = settings(trigger="Software", exposure_us=10_000.0)
        camera = open_camera("a", wanted)
        report = camera.configure(wanted)
        assert (report.model, report.serial) == ("Fake", "FAKE2")
        assert report.exposure_ns == 10_000_000
        assert camera.capabilities.device_clock
        assert not camera.capabilities.ptp
        rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
        camera.arm()
        ids, stamps = [], []
        # this camera's ids begin at 65400 and go on after 65535 with 1
        for _ in range(150):
            fired = camera.software_trigger()
            grabbed = camera.grab(60.0)
            assert grabbed is not None
            assert grabbed.note == ""
            assert grabbed.image is not None
            assert grabbed.host_ns >= fired
            assert grabbed.block_id is not None
            assert grabbed.device_ns is not None
            ids.append(grabbed.block_id)
            stamps.append(grabbed.device_ns)
            # its picture is a ramp, moved on by each frame; how bright goes with exposure and gain
            offset = int(grabbed.image[0, 0])
            assert np.array_equal(grabbed.image, (rows + columns + offset) % 255)
        assert ids == list(range(ids[0], ids[0] + 150))
        assert ids[0] < 65535 < ids[-1]
        assert (np.diff(stamps) > 0).all()
        counts = camera.statistics()
        # an answer that comes late has the order given again, and this camera obeys twice
        assert counts["n_completed_buffers"] >= 150
        assert counts["n_missing_packets"] == 0
        camera.close()


def test_lost_packets_are_told_and_no_frame_is_left_out() -> None:
    # this camera never sends a packet again: what is lost stays lost
    with fake_gige_camera("FAKE3", lost_permille=10.0) as settings:
        # each frame is triggered after one has arrived: no pause of this program or of the camera can lose one
        wanted = settings(trigger="Software", packet_bytes=576)
        with closing(open_camera("a", wanted)) as camera:
            camera.configure(wanted)
            camera.arm()
            came: dict[int, Grabbed] = {}
            nameless: list[Grabbed] = []
            while len(came) < 40:
                camera.software_trigger()
                grabbed = camera.grab(5.0)
                if grabbed is None:  # it was busy with a frame whose packets came after it was given up
                    continue
                if grabbed.block_id is None:
                    nameless.append(grabbed)
                else:
                    came.setdefault(grabbed.block_id, grabbed)
            counts = camera.statistics()
        # whose first packet is lost has neither number nor stamp, and not those of what was in its memory before
        assert all(one.unidentified for one in nameless)
        broken = [one for one in came.values() if one.image is None]
        assert {one.note for one in broken} <= {"MISSING_PACKETS", "TIMEOUT"}
        assert all(one.note == "" for one in came.values() if one.image is not None)
        # 35 packets a frame, one in a hundred lost: 0.99^35 = 70 % whole
        assert 1 < len(broken) < 35
        # none is left out
        assert max(came) - min(came) + 1 - len(came) <= len(nameless)
        assert counts["n_missing_packets"] > 0
        assert counts["n_resend_requests"] > 0


def test_by_address_and_not_found() -> None:
    with fake_gige_camera("FAKE4") as settings:
        by_address = CameraHardware(driver="gige", address=FAKE_ADDRESS, trigger="Off")
        camera = open_camera("a", by_address)
        report = camera.configure(settings(trigger="Off"))
        assert (report.model, report.serial) == ("Fake", "FAKE4")
        camera.close()
        # serial and address must be the same camera's
        with refused("two cameras", "camera 'a'", "OTHER", "FAKE4"):
            open_camera("a", CameraHardware(driver="gige", address=FAKE_ADDRESS, serial="OTHER"))
        with refused("sees no device", "camera 'a'", "OTHER", "FAKE4"):
            open_camera("a", CameraHardware(driver="gige", serial="OTHER"))
        by_serial = CameraHardware(driver="gige", serial="FAKE4", trigger="Off")
        open_camera("a", by_serial).close()
        settings.end()  # while no other test's camera can have its address
        with refused("sees no device", "camera 'a'", FAKE_ADDRESS):
            open_camera("a", by_address)
        # it was there at this program's last check
        with refused("sees no device", "camera 'a'", "FAKE4"):
            open_camera("a", by_serial)


@pytest.mark.slow
def test_a_pulled_plug_is_told() -> None:
    with fake_gige_camera("FAKE5") as settings:
        camera = open_camera("a", settings(trigger="Off"))
        camera.configure(settings(trigger="Off"))
        camera.arm()
        assert camera.grab(60.0) is not None
        settings.end()  # type: ignore[attr-defined]
        # the library tries for 5 s before it gives a heartbeat up
        with refused("stopped answering", "camera 'a'", "FAKE5"):
            grab_for(camera, 120.0)
        camera.close()
