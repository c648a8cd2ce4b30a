"""Injected faults of an emulated camera, reproducible."""

from dataclasses import dataclass

import numpy as np

from mosca.errors import InputError

SHARES = ("packet_loss", "resend_refused", "withheld")
STREAMS = {"packet_loss": 1, "resend_refused": 2, "withheld": 3, "resent_loss": 4}
"""Random streams: each kind of fault draws from its own, so that one does not change another."""


@dataclass(frozen=True)
class Faults:
    """Faults of one camera; times are seconds after its acquisition first started."""

    packet_loss: float = 0.0
    """Share of stream packets, resent ones too, that are lost."""
    resend_refused: float = 0.0
    """Share of requests for packets that are answered with "unavailable"."""
    withheld: float = 0.0
    """Share of line pulses that do not reach the camera."""
    clock_offset_ns: int = 0
    """Device clock at boot [ns]."""
    drift_ppm: float = 0.0
    """Drift of the device clock."""
    jump_at_s: float | None = None
    """Time at which the device clock jumps by ``jump_ns``."""
    jump_ns: int = 0
    reboot_at_s: float | None = None
    """Time at which the camera loses its supply for ``reboot_gone_s``; settings, control, clock and block numbers
    start anew."""
    reboot_gone_s: float = 2.0
    silent_at_s: float | None = None
    """Time from which for ``silent_for_s`` nothing reaches or leaves the working camera, as with a pulled cable."""
    silent_for_s: float = 1.0
    seed: int = 0
    """Seed of the random draws."""

    def __post_init__(self) -> None:
        for name in SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"faults: {name} = {getattr(self, name)} given; a share from 0 to 1 is wanted")
        if not abs(self.drift_ppm) <= 10_000:
            raise InputError(f"faults: drift_ppm = {self.drift_ppm} given; -10000 to 10000 is wanted")
        for name in ("jump_at_s", "reboot_at_s", "silent_at_s", "reboot_gone_s", "silent_for_s"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < 1e9:
                raise InputError(f"faults: {name} = {value} given; seconds from 0 are wanted")


FAULTLESS = Faults()


class FaultDraws:
    """Random draws of one camera's faults: packets and requests in order, pulses by their number."""

    def __init__(self, faults: Faults, serial: str) -> None:
        self._faults = faults
        self._key = (faults.seed, int.from_bytes(serial.encode()))
        self._packets = self._generator("packet_loss")
        self._again = self._generator("resent_loss")
        self._requests = self._generator("resend_refused")

    def lost(self, packets: int) -> frozenset[int]:
        """Return which of the next ``packets`` packets are lost."""
        return self._lost(self._packets, packets)

    def lost_again(self, packets: int) -> frozenset[int]:
        """Return which of the next ``packets`` packets that are sent again are lost."""
        return self._lost(self._again, packets)

    def refused(self) -> bool:
        """Return whether the next request for packets is refused."""
        return bool(self._faults.resend_refused) and self._requests.random() < self._faults.resend_refused

    def withheld(self, pulse: int) -> bool:
        """Return whether line pulse ``pulse`` fails to reach the camera; repeated calls agree."""
        if self._faults.withheld == 0.0:
            return False
        return bool(self._generator("withheld", pulse).random() < self._faults.withheld)

    def _lost(self, generator: np.random.Generator, packets: int) -> frozenset[int]:
        if self._faults.packet_loss == 0.0:
            return frozenset()
        drawn = generator.random(packets) < self._faults.packet_loss
        return frozenset(np.flatnonzero(drawn).tolist())

    def _generator(self, trouble: str, *more: int) -> np.random.Generator:
        return np.random.default_rng([*self._key, STREAMS[trouble], *more])
