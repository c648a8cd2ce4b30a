"""Serves the cameras of a campaign and spoils them by its timetable: ``campaign_emulator.py [SEED,S] ADDRESS LOG``.

Each exposure is logged before its image is sent, unbuffered, so that the log outlives a killed process. Times of
faults count from the first exposure on. Ends with its stdin.
"""

import heapq
import json
import os
import signal
import sys
import threading
import time
from dataclasses import replace
from ipaddress import IPv4Address
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from campaigns import EXPOSURE_NS, SIZE, Campaign, drawn, picture

from hardware.emulate.acquisition import PendingImage
from hardware.emulate.faults import FaultDraws, Faults
from hardware.emulate.identity import Identity
from hardware.emulate.pulse_generators import PulseBox, TriggerLine
from hardware.emulate.serve import EmulatedDevice, interface, serial_at
from mosca.data.frames import Frame


class Timetable:
    """Which faults act at a time; its clock begins with the first exposure."""

    def __init__(self, campaign: Campaign, log: int) -> None:
        self.campaign, self._log = campaign, log
        self._rng = np.random.default_rng([campaign.seed, 3])
        self._guard = threading.Lock()
        self.begun = threading.Event()
        self.begin_ns = 0

    def write(self, **row: object) -> None:
        """Log a line."""
        os.write(self._log, (json.dumps(row) + "\n").encode())

    def exposed(self, camera: str, serial: int, start_ns: int, trigger: int | None) -> None:
        """Log an exposure; the first one begins the timetable."""
        self.write(camera=camera, serial=serial, start_ns=start_ns, trigger=trigger)
        with self._guard:
            if not self.begun.is_set():
                self.begin_ns = start_ns
                self.begun.set()

    def share(self, what: str, camera: str, at_ns: int) -> float:
        """Return the share of pulses or packets that a fault takes at a time; 0 where none acts."""
        if not self.begun.is_set():
            return 0.0
        at_s = (at_ns - self.begin_ns) * 1e-9
        acting = [e for e in self.campaign.events if e.what == what and e.at_s <= at_s < e.at_s + e.for_s]
        return max((e.share for e in acting if e.camera in ("", camera)), default=0.0)

    def strikes(self, what: str, camera: str, at_ns: int) -> bool:
        """Draw whether a fault takes this pulse."""
        share = self.share(what, camera, at_ns)
        with self._guard:
            return share > 0 and bool(self._rng.random() < share)

    def delay_ns(self) -> int:
        """Draw how late a pulse is: up to three periods."""
        with self._guard:
            return round(float(self._rng.uniform(0.02, 3.0)) * 1e9 / self.campaign.rate_hz)


class Draws(FaultDraws):
    """Loses packets by the timetable; then resending does not always help."""

    def __init__(self, camera: str, timetable: Timetable) -> None:
        super().__init__(Faults(), camera)
        self._camera, self._timetable = camera, timetable

    def lost(self, packets: int) -> frozenset[int]:
        return frozenset(k for k in range(packets) if self._strikes())

    lost_again = lost

    def refused(self) -> bool:
        return self._strikes()

    def _strikes(self) -> bool:
        return self._timetable.strikes("packets", self._camera, time.monotonic_ns())


class Device(EmulatedDevice):
    """A camera whose images carry their exposures' numbers."""

    def __init__(self, number: int, identity: Identity, faults: Faults, timetable: Timetable) -> None:
        self._number, self._timetable, self._serial = number, timetable, 0
        super().__init__(identity, self._shown, faults)
        self._stream._draws = Draws(identity.name, timetable)
        camera = self.camera
        linked, trigger = camera.linked, camera._acquisition.trigger

        def linked_now(now_ns: int) -> bool:
            return linked(now_ns) and not timetable.share("unplug", identity.name, now_ns)

        def triggered(source: str, time_ns: int) -> None:
            if timetable.strikes("withhold", identity.name, time_ns):
                return
            if timetable.strikes("late", identity.name, time_ns):
                time.sleep(timetable.delay_ns() * 1e-9)
            trigger(source, time.monotonic_ns())

        camera.linked = linked_now
        camera._acquisition.trigger = triggered

    def _shown(self, _: int) -> Frame:
        return Frame(self.identity.name, self._serial, 0, EXPOSURE_NS, picture(self._number, self._serial))

    def _take(self, shot: PendingImage) -> None:
        self._serial += 1
        campaign = self._timetable.campaign
        trigger = shot.exposure.number if campaign.trigger.startswith("line") else None
        self._timetable.exposed(self.identity.name, self._serial, shot.exposure.start_ns, trigger)
        super()._take(shot if campaign.stamps else replace(shot, device_ns=0))


class Wire:
    """Takes pulses of a generator to the cameras, some late, some not at all; in order of time."""

    def __init__(self, devices: list[Device], timetable: Timetable) -> None:
        self._devices, self._timetable = devices, timetable
        self._late: list[tuple[int, int]] = []

    def pulse(self, number: int, time_ns: int) -> None:
        """Take a pulse at its time."""
        if number == 0:
            self._timetable.write(begin_ns=time_ns)
        heapq.heappush(self._late, (time_ns, number))
        if self._timetable.strikes("late", "", time_ns):
            self._late.remove((time_ns, number))
            heapq.heapify(self._late)
            heapq.heappush(self._late, (time_ns + self._timetable.delay_ns(), number))
        while self._late and self._late[0][0] <= time_ns:
            self._rise(*reversed(heapq.heappop(self._late)))

    def _rise(self, number: int, time_ns: int) -> None:
        whole = self._timetable.strikes("withhold", "", time_ns)
        for device in self._devices:
            name = device.identity.name
            if not whole and not self._timetable.strikes("withhold", name, time_ns):
                device.camera.pulse(number, time_ns)


def spoil(timetable: Timetable, devices: dict[str, Device]) -> None:
    """Do what happens once: killed cameras, restarts, the end of the rig."""
    timetable.begun.wait()
    for event in timetable.campaign.events:
        wait = event.at_s - (time.monotonic_ns() - timetable.begin_ns) * 1e-9
        if event.what in ("reboot", "kill camera", "kill rig"):
            time.sleep(max(wait, 0))
            timetable.write(event=str(event), at_ns=time.monotonic_ns())
        if event.what == "reboot":
            devices[event.camera].camera.reboot()
        elif event.what == "kill camera":
            devices[event.camera].close()
        elif event.what == "kill rig":
            os.kill(os.getpid(), signal.SIGKILL)


def main() -> None:
    seed, seconds = json.loads(sys.argv[1])
    campaign, first = drawn(seed, seconds), interface(sys.argv[2])
    timetable = Timetable(campaign, os.open(sys.argv[3], os.O_WRONLY | os.O_CREAT | os.O_APPEND))
    rng = np.random.default_rng([seed, 4])
    devices: list[Device] = []
    for k, name in enumerate(campaign.cameras):
        place = interface(f"{IPv4Address(int(first.ip) + k)}/{first.network.prefixlen}")
        identity = Identity(name, serial_at(place), place, *SIZE, 8, campaign.rate_hz, EXPOSURE_NS / 1e3, 400.0)
        gone = next((e.for_s for e in campaign.events if (e.what, e.camera) == ("reboot", name)), 1.0)
        offset, drift = int(rng.integers(0, 10**15)), float(rng.uniform(-50, 50))
        faults = Faults(clock_offset_ns=offset, drift_ppm=drift, reboot_gone_s=gone)
        devices.append(Device(k + 1, identity, faults, timetable))
    named = {device.identity.name: device for device in devices}
    wire, port = Wire(devices, timetable), ""
    if campaign.wire == "serial":
        box = PulseBox(wire.pulse)
        port = box.port
    elif campaign.wire == "external":
        TriggerLine([wire]).start(campaign.rate_hz)
    threading.Thread(target=spoil, args=(timetable, named), daemon=True).start()
    addresses = {name: str(device.identity.address.ip) for name, device in named.items()}
    print(json.dumps({"addresses": addresses, "port": port}), flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
