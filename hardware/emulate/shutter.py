"""When a trigger makes an exposure: a camera that still exposes, or reads out, ignores triggers and says nothing."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Exposure:
    """An exposure that was begun at ``start_ns``; at ``out_ns`` it has ended and is read out.

    ``number``: of the trigger, which is the number of the source's frame. Times are this machine's monotonic clock's
    [ns].
    """

    number: int
    start_ns: int
    out_ns: int


class Shutter:
    """Opens on triggers that come when it is ready."""

    def __init__(self) -> None:
        self._ready_ns = 0

    def open(self, number: int, time_ns: int, exposure_ns: int, readout_ns: int) -> Exposure | None:
        """Return the exposure that trigger ``number`` at ``time_ns`` begins, None where the camera is busy.

        The sensor reads one image out while it exposes the next, but does not begin two exposures at once nor read
        out faster than ``readout_ns`` an image.
        """
        if time_ns < self._ready_ns:
            return None
        self._ready_ns = time_ns + max(exposure_ns, readout_ns)
        return Exposure(number, time_ns, time_ns + exposure_ns + readout_ns)

    def reset(self) -> None:
        """Be ready at once: acquisition starts anew."""
        self._ready_ns = 0
