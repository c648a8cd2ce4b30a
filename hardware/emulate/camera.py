"""One emulated camera without its sockets: its settings with their limits and effects, and its power supply."""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from ipaddress import IPv4Address
from threading import Condition

from hardware.emulate.acquisition import (
    SECOND,
    Acquisition,
    ClockJump,
    EmulatedClock,
    PendingImage,
    PtpStatus,
    payload_bytes,
)
from hardware.emulate.faults import FaultDraws, Faults
from hardware.emulate.features import BOOTSTRAP, PTP_STATES, XML_START, Feature, features, own_registers
from hardware.emulate.genicam import describe
from hardware.emulate.gige_vision import (
    DO_NOT_FRAGMENT,
    FIRE_TEST_PACKET,
    FORMAT_OF_DEPTH,
    ActionCommand,
    Refused,
    Status,
)
from hardware.emulate.identity import Identity, boot_values
from hardware.emulate.registers import Privilege, Register, RegisterFile, Value
from hardware.emulate.stream import Destination, Stream

RESET_AFTER_NS = 20_000_000
"""Delay of a reset, so that DeviceReset is acknowledged before the camera disappears."""
SMALLEST_PACKET, LARGEST_PACKET = 576, 16000


class EmulatedCamera:
    """A camera of ``identity``; the lock of ``changed`` guards all of it, and waits for images use it.

    ``stream``: sends test packets; its memory is lost with the supply. ``first_block``: number of the first block of
    an acquisition. ``counts``: triggers by outcome; on the line
    pulses = withheld + unarmed + ignored + overrun + exposures.
    """

    def __init__(
        self, identity: Identity, stream: Stream, faults: Faults, draws: FaultDraws, first_block: int = 1
    ) -> None:
        self.identity, self.faults = identity, faults
        self.changed = Condition()
        self.counts: Counter[str] = Counter()
        self.privilege = Privilege()
        self._stream, self._draws = stream, draws
        self._began_ns: int | None = None
        self._reset_ns: int | None = None
        self._returns_ns = 0
        self._rebooted = False
        self.clock = EmulatedClock(0)
        self._ptp: tuple[PtpStatus, int] = ("Disabled", 0)
        tree = features(tuple(dict.fromkeys((FORMAT_OF_DEPTH[identity.bit_depth], "Mono8"))))
        self._features = {feature.register or feature.name: feature for feature in tree}
        registers = {register.name: register for register in (*BOOTSTRAP, *own_registers(tree))}
        if not identity.switchover:
            del registers["SwitchoverKey"]
        xml = describe(tree, registers, identity.vendor, identity.model)
        self._xml_bytes = len(xml)
        self.registers = RegisterFile(registers.values(), self._live(), self._write, (XML_START, xml))
        self._values = self.registers.values
        self._acquisition = Acquisition(
            self._values,
            lambda mono_ns: self.clock.at(mono_ns),
            SECOND / identity.fastest_hz,
            identity.height,
            first_block,
            self.counts,
        )
        self._boot(time.monotonic_ns())

    # events; all but next_image may come from any thread

    def pulse(self, number: int, time_ns: int) -> None:
        """Take line pulse ``number``, which rises at the monotonic time ``time_ns``."""
        with self.changed:
            self.counts["pulses"] += 1
            self._supply(time_ns)
            if time_ns < self._returns_ns:
                self.counts["unarmed"] += 1
            elif self._draws.withheld(number):
                self.counts["withheld"] += 1
            else:
                self._acquisition.pulse(number, time_ns)
                self.changed.notify_all()

    def act(self, action: ActionCommand) -> Status:
        """Take an action command: it triggers at once, or at its time in the device's clock.

        A command with other keys is not for this camera, and is acknowledged all the same. A camera without PTP uses
        its own clock, and reports that it has no common time.
        """
        with self.changed:
            values, now = self._values, time.monotonic_ns()
            keys = (values["ActionDeviceKey"], values["ActionGroupKey"])
            masked = int(values["ActionGroupMask"]) & action.group_mask
            if keys != (action.device_key, action.group_key) or not masked:
                return Status.SUCCESS
            self.changed.notify_all()
            if action.at_ns is None:
                self._acquisition.trigger("Action1", now)
                return Status.SUCCESS
            due = self.clock.when(action.at_ns)
            if not self._acquisition.schedule(max(due, now)):
                return Status.OVERFLOW
            if due < now:
                return Status.ACTION_LATE
            return Status.SUCCESS if self.clock.ptp_status(now) == "Slave" else Status.NO_REF_TIME

    def reboot(self) -> None:
        """Lose the supply now and come back after ``faults.reboot_gone_s``."""
        with self.changed:
            self._lose_supply(time.monotonic_ns())

    def release(self) -> None:
        """Carry out the effects of the end of control: the stream closes and acquisition stops."""
        with self.changed:
            self.privilege.drop()
            self._values["StreamPort"] = 0
            self._acquisition.stop()
            self.changed.notify_all()

    def next_image(self) -> PendingImage | float | None:
        """Return the next image to send, else the seconds until one may be due, else None; hold ``changed``."""
        return self._acquisition.next_image(time.monotonic_ns())

    # present state

    @property
    def armed(self) -> bool:
        """Whether the camera acquires."""
        return self._acquisition.active

    @property
    def session(self) -> int:
        """How often acquisition has stopped."""
        return self._acquisition.session

    @property
    def packet_bytes(self) -> int:
        """Size of stream packets, as set in SCPS."""
        return int(self._values["StreamPacketSize"]) & 0xFFFF

    @property
    def switchover_key(self) -> int | None:
        """Key with which another client may take over the control; None without that capability."""
        return int(self._values["SwitchoverKey"]) & 0xFFFF if self.identity.switchover else None

    def destination(self) -> Destination | None:
        """Return where the stream goes, None while the channel is closed."""
        port = int(self._values["StreamPort"])
        if not port:
            return None
        return ".".join(map(str, int(self._values["StreamDestination"]).to_bytes(4, "big"))), port

    def linked(self, now_ns: int) -> bool:
        """Return whether anything reaches the camera or leaves it; carry out due changes of its supply."""
        with self.changed:
            self._supply(now_ns)
            if now_ns < self._returns_ns:
                return False
            silent_at = self.faults.silent_at_s
            if silent_at is None or self._began_ns is None:
                return True
            since_s = (now_ns - self._began_ns) / SECOND
            return not silent_at <= since_s < silent_at + self.faults.silent_for_s

    def _live(self) -> dict[str, Callable[[], Value]]:
        """Return the functions of the values that are computed at each reading, by name."""

        def now(name: str) -> int:
            return int(self.registers.values[name])

        width, height, privilege = self.identity.width, self.identity.height, self.privilege
        return {
            "WidthLimit": lambda: width - now("OffsetX"),
            "HeightLimit": lambda: height - now("OffsetY"),
            "OffsetXLimit": lambda: width - now("Width"),
            "OffsetYLimit": lambda: height - now("Height"),
            "PayloadSize": lambda: payload_bytes(self._values),
            "AcquisitionFrameRateLimit": lambda: SECOND / self._acquisition.shortest_period_ns(),
            "PtpStatus": lambda: PTP_STATES[self._ptp[0]],
            "PtpOffsetFromMaster": lambda: self._ptp[1],
            "ControlPrivilege": lambda: privilege.level,
            "PrimaryPort": lambda: privilege.holder[1] if privilege.holder else 0,
            "PrimaryIP": lambda: int(IPv4Address(privilege.holder[0])) if privilege.holder else 0,
        }

    # effects of writes

    def _write(self, register: Register, value: Value) -> None:
        name = register.name
        feature = self._features.get(name)
        if feature is not None and feature.register in ("", "HeartbeatTimeout"):
            if feature.locked and self.armed:
                raise Refused(Status.ACCESS_DENIED)
            self._check(feature, value)
        effect = self._effects().get(name)
        with self.changed:
            if effect is not None:
                effect(int(value))
            else:
                self._values[name] = round(value, 2) if isinstance(value, float) else value
            self.changed.notify_all()

    def _check(self, feature: Feature, value: Value) -> None:
        """Refuse a value that the feature cannot take; one that is not a number is within no limits."""
        if isinstance(value, str):
            return
        if feature.kind == "enumeration":
            fits = value in feature.entries.values()
        elif feature.kind == "boolean":
            fits = value in (0, 1)
        else:
            most = float(self.registers.value(feature.most)) if feature.most else feature.maximum
            above = feature.minimum is None or value >= feature.minimum
            fits = above and (most is None or value <= most)
        if not fits:
            raise Refused(Status.INVALID_PARAMETER)

    def _effects(self) -> dict[str, Callable[[int], None]]:
        return {
            "AcquisitionStart": self._start,
            "AcquisitionStop": lambda _: self._acquisition.stop(),
            "TriggerSoftware": lambda _: self._acquisition.trigger("Software", time.monotonic_ns()),
            "DeviceReset": self._reset_soon,
            "CounterReset": lambda _: self._values.update(CounterValue=0),
            "TimestampControl": self._control_timestamp,
            "PtpEnable": self._enable_ptp,
            "PtpDataSetLatch": self._latch_ptp,
            "StreamPort": lambda port: self._values.update(StreamPort=port & 0xFFFF),
            "StreamPacketSize": self._set_packet_size,
        }

    def _start(self, _: int) -> None:
        if self.armed:
            return
        now = time.monotonic_ns()
        if self._began_ns is None:
            self._began_ns = now
            if self.faults.jump_at_s is not None:
                jump = ClockJump(now + round(self.faults.jump_at_s * SECOND), self.faults.jump_ns)
                self.clock = replace(self.clock, jumps=(jump,))
        self._acquisition.start(now)

    def _reset_soon(self, _: int) -> None:
        self._reset_ns = time.monotonic_ns() + RESET_AFTER_NS

    def _control_timestamp(self, bits: int) -> None:
        now = time.monotonic_ns()
        if bits & 1 and self.clock.ptp_ns is None:
            self.clock = EmulatedClock(now, 0, self.faults.drift_ppm)
        if bits & 2:
            self._values["TimestampLatched"] = self.clock.at(now)

    def _enable_ptp(self, on: int) -> None:
        now = time.monotonic_ns()
        self._values["PtpEnable"] = on
        if on and self.clock.ptp_ns is None:
            self.clock = replace(self.clock, ptp_ns=now)
        elif not on and self.clock.ptp_ns is not None:
            self.clock = EmulatedClock(now, self.clock.at(now), self.faults.drift_ppm)
        self._latch_ptp(1)

    def _latch_ptp(self, _: int) -> None:
        now = time.monotonic_ns()
        self._ptp = self.clock.ptp_status(now), self.clock.offset_from_master(now)

    def _set_packet_size(self, value: int) -> None:
        asked = value & 0xFFFC
        size = min(max(asked, SMALLEST_PACKET), LARGEST_PACKET)
        self._values["StreamPacketSize"] = value & DO_NOT_FRAGMENT | size
        self._stream.fragment(may=not value & DO_NOT_FRAGMENT)
        to = self.destination()
        # an unavailable packet size gives no test packet, and the client reads back the actual size
        if value & FIRE_TEST_PACKET and to is not None and asked == size:
            self._stream.fire_test_packet(size, to)

    # supply

    def _supply(self, now_ns: int) -> None:
        """Lose the supply where that is due."""
        at_s = self.faults.reboot_at_s
        if at_s is not None and self._began_ns is not None and not self._rebooted:
            at_ns = self._began_ns + round(at_s * SECOND)
            if now_ns >= at_ns:
                self._rebooted = True
                self._lose_supply(at_ns)
        if self._reset_ns is not None and now_ns >= self._reset_ns:
            self._lose_supply(self._reset_ns)

    def _lose_supply(self, at_ns: int) -> None:
        self.counts["reboots"] += 1
        self._reset_ns = None
        self._returns_ns = at_ns + round(self.faults.reboot_gone_s * SECOND)
        self.privilege.drop()
        self._acquisition.stop()
        self._stream.forget()
        self._boot(self._returns_ns)
        self.changed.notify_all()

    def _boot(self, at_ns: int) -> None:
        """Begin with the settings that the camera has when its supply comes."""
        self.clock = EmulatedClock(at_ns, self.faults.clock_offset_ns, self.faults.drift_ppm)
        self._ptp = ("Disabled", 0)
        self.registers.clear()
        self._values.update(boot_values(self.identity, self._xml_bytes, self._stream.source_port))
