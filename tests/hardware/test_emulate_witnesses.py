"""Two more witnesses: pyGigEVision grabs, and the GenICam reference implementation reads the feature tree."""

import struct
import time

import numpy as np
import pytest
from array_source import ArraySource, picture
from loopback import Hand, free_address
from needs import needs_module

from hardware.emulate.serve import served

SHAPE = (240, 320)
"""An image of it fits into any socket's buffer: the receiver has no packet resend."""


def address_of(device, name: str) -> int:
    return device.camera.registers.named(name).address


def test_pygigevision_grabs_bit_for_bit():
    gige = needs_module("pyGigEVision", package="pyGigEVision")
    with served(ArraySource(2, 100, SHAPE), first_address=free_address()) as up:
        device, second = up.devices
        client, xml = gige.bootstrap(str(device.identity.address.ip))
        receiver = None
        try:
            assert b"AcquisitionStart" in (xml if isinstance(xml, bytes) else xml.encode())
            receiver = gige.GVSPReceiver(
                local_ip="127.0.0.1", packet_size=8000 - 28, gvcp_client=client, max_queue=120
            )
            client.write_reg(gige.standard.REG_SC_DEST_ADDR, 0x7F000001)
            client.write_reg(gige.standard.REG_SC_HOST_PORT, receiver.port)
            client.write_reg(gige.standard.REG_SC_PACKET_SIZE, 8000)
            client.write_reg(address_of(device, "TriggerSource"), 1)
            client.write_reg(address_of(device, "TriggerMode"), 1)
            receiver.start()
            client.write_reg(address_of(device, "AcquisitionStart"), 1)
            found, first_ns = [], time.monotonic_ns()
            for number in range(100):  # each after the previous one was received: the socket's buffer stays empty
                up.pulse(number, first_ns + number * 10_000_000)
                if (one := receiver.get_frame_with_info(timeout=60.0)) is not None:
                    found.append(one)
            assert [info["block_id"] for _, info in found] == list(range(1, 101))
            assert all(np.array_equal(image, picture(0, n, SHAPE)) for n, (image, _) in enumerate(found))
            steps = np.diff([info["timestamp"] for _, info in found])
            assert set(steps.tolist()) == {10_000_000}
            assert second.counts().get("frames", 0) == 0
        finally:
            if receiver is not None:
                receiver.stop()
                receiver.close()
            client.disconnect()


def test_the_reference_implementation_reads_and_sets_the_feature_tree():
    genapi = needs_module("genicam.genapi", "gentl")
    with served(ArraySource(1, 2), first_address=free_address()) as up:
        device = up.devices[0]
        hand = Hand(str(device.identity.address.ip))

        class Port(genapi.AbstractPort):
            """Registers of the device, over the network."""

            def read(self, address, length):
                status, payload = hand.ask(0x84, struct.pack(">IHH", address, 0, length))
                assert status == 0, hex(status)
                return payload[4:]

            def write(self, address, value):
                status, _ = hand.ask(0x86, struct.pack(">I", address) + bytes(value))
                assert status == 0, hex(status)

            def get_access_mode(self):
                return genapi.EAccessMode.RW

        url = hand.ask(0x84, struct.pack(">IHH", 0x200, 0, 512))[1][4:].split(b"\0")[0].decode()
        name, start, length = url.removeprefix("Local:").split(";")
        assert name.endswith(".xml")
        xml, at = b"", int(start, 16)
        while len(xml) < int(length, 16):
            xml += hand.ask(0x84, struct.pack(">IHH", at + len(xml), 0, 512 if int(length, 16) - len(xml) > 512 else
                                              -(-(int(length, 16) - len(xml)) // 4) * 4))[1][4:]  # fmt: skip
        hand.write(0xA00, 2)
        tree = genapi.NodeMap()
        tree.load_xml_from_string(xml[: int(length, 16)].decode())
        port = Port()
        tree.connect(port, "Device")
        assert tree.DeviceSerialNumber.value == device.identity.serial
        assert (tree.Width.value, tree.Width.max, tree.PixelFormat.value) == (64, 64, "Mono8")
        tree.Width.value = 32
        assert (tree.OffsetX.max, tree.PayloadSize.value) == (32, 32 * 48)
        tree.ExposureTime.value = 250.0
        assert tree.ExposureTime.value == 250.0
        tree.TriggerSource.value = "Line1"
        assert device.camera.registers.value("TriggerSource") == 1
        assert set(tree.PtpStatus.symbolics) == {"Disabled", "Listening", "Uncalibrated", "Slave"}
        tree.TimestampLatch.execute()
        assert tree.TimestampLatchValue.value > 0
        with pytest.raises(genapi.OutOfRangeException):
            tree.Width.value = 65
        tree.TLParamsLocked.value = 1
        with pytest.raises(genapi.AccessException):
            tree.Width.value = 16
        hand.close()
