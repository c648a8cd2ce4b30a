"""Pulses of a triggered camera whose frames have no time stamps: counted, and checked by when they arrive.

A counter alone does not show a pulse that the camera missed; an arrival alone may be late by periods. Together they
bound a frame's pulse: from below by the count since the last frame, from above because no frame can arrive before its
pulse. Where both bounds agree, the pulse is known. A frame that is late for its count waits for the next ones. If one
of them is on time, the frame was merely late. If all are late by whole periods, the camera missed as many pulses, as
far as arrivals show, and a note states that. The time of exposure is as uncertain as the arrival is late.

At the start the first frame is counted as that of the first pulse, since cameras are armed before the pulses begin.
Where its arrival contradicts that, the pulse is not known; a note names the camera and what to do.
"""

import math
from collections.abc import Callable, Iterator

from hardware.driver import Grabbed
from hardware.pulse_numbers.camera_state import CameraState, Found, NumberedBuffer, earliest_arrival_ns
from hardware.pulse_numbers.clock_model import EARLY_SHARE, HostPulseTimes
from hardware.pulse_numbers.settings import NumberingSettings

OFF_PULSE = 0.6
"""Share of a period: a frame that arrives farther from a pulse's time than this does not belong to that pulse."""
CLEAR = 0.35
"""Share of a period: first frames that arrive farther from a pulse than this could as well belong to the next one."""
REMEDY = "use trigger = 'Software', a lower rate_hz, or a camera with time stamps"


class CountedPulses:
    """Numbers the buffers of cameras without time stamps.

    ``pulse_times``: when each pulse's frames arrive. ``usual_delay_ns``: delay of the other cameras' frames, by their
    stamps [ns].
    """

    def __init__(
        self,
        pulse_times: HostPulseTimes,
        settings: NumberingSettings,
        usual_delay_ns: Callable[[CameraState], float],
        notes: list[str],
        *,
        follows: bool,
    ) -> None:
        """``follows``: whether arrivals adjust the pulse times."""
        self._times, self._settings, self._usual_delay_ns = pulse_times, settings, usual_delay_ns
        self._notes, self._follows = notes, follows

    def begin(self, camera: CameraState, earliest_ns: float) -> Iterator[NumberedBuffer]:
        """Number the pending buffers; with the shortest delay the first would have arrived at ``earliest_ns``."""
        if camera.played:
            pulse = 0
        else:
            pulse = self._times.pulse_of(earliest_ns)
            off = (earliest_ns - self._times.at(pulse)) / self._settings.period_ns
            camera.latency_ns = earliest_ns - self._times.at(pulse)
            camera.proven = pulse == 0 and abs(off) <= CLEAR
            if not camera.proven:
                self._notes.append(
                    f"{camera.name}: has no time stamps, and its frames came {pulse + off:.2f} periods after those "
                    f"of pulse 0: numbered from pulse {pulse}, but whether it missed pulses or is slower than the "
                    f"other cameras is not known; {REMEDY}"
                )
        yield from self._begin_at(camera, pulse)

    def settle(self, camera: CameraState, final: bool) -> Iterator[NumberedBuffer]:
        """Number the pending buffers whose pulses are known by now; all of them when ``final``."""
        while camera.pending:
            counted = [] if not camera.started else _counted(camera)
            enough = final or len(camera.pending) >= self._settings.votes
            if not counted and not enough:
                return
            if not counted:
                yield from self._find_again(camera)
            elif camera.played:
                yield from self._number(camera, counted)
            else:
                excess = [self._excess(camera, *pair) for pair in zip(counted, camera.pending, strict=False)]
                on_time = [k for k, one in enumerate(excess) if one < OFF_PULSE]
                if on_time:
                    if min(excess) < -OFF_PULSE:
                        ahead = math.floor(min(excess) + 1 - OFF_PULSE)
                        self._recount(camera, counted[0], ahead)
                        counted = [pulse + ahead for pulse in counted]
                    yield from self._number(camera, counted[: on_time[-1] + 1])
                elif enough:
                    missed = math.floor(min(excess) + 1 - OFF_PULSE)
                    self._recount(camera, counted[0], missed)
                    yield from self._number(camera, [pulse + missed for pulse in counted])
                else:
                    return

    def _begin_at(self, camera: CameraState, pulse: int) -> Iterator[NumberedBuffer]:
        camera.started = True
        camera.last_pulse, camera.last_counts = pulse - 1, None
        yield from self.settle(camera, final=False)

    def _find_again(self, camera: CameraState) -> Iterator[NumberedBuffer]:
        """Number the pending buffers of a camera that came late, or restarted, by their arrivals alone."""
        earliest = earliest_arrival_ns(camera.pending, self._settings.period_ns) - camera.latency_ns
        at = (earliest - self._usual_delay_ns(camera) - self._times.at(0)) / self._settings.period_ns
        pulse = max(round(at), camera.last_pulse + 1)
        camera.relocks += camera.started
        camera.proven = camera.proven and camera.started and abs(at - pulse) <= CLEAR
        doubt = "" if camera.proven else f", which is not certain; {REMEDY}"
        self._notes.append(
            f"{camera.name}: has no time stamps, and began {'anew' if camera.started else 'late'}; by its arrivals "
            f"({at:.2f} periods after pulse 0) it went on with pulse {pulse}{doubt}"
        )
        yield from self._begin_at(camera, pulse)

    def _recount(self, camera: CameraState, counted: int, missed: int) -> None:
        """Register that the arrivals contradict the count; add a note the first time."""
        camera.relocks += 1
        camera.proven = False
        if camera.recounted:
            return
        camera.recounted = True
        what = f"missed {missed} pulses" if missed > 0 else f"was counted {-missed} pulses too far"
        self._notes.append(
            f"{camera.name}: has no time stamps; by its arrivals it {what} before pulse {counted + missed}, "
            f"and perhaps again later, which is not certain; {REMEDY}"
        )

    def _excess(self, camera: CameraState, pulse: int, buffer: Grabbed) -> float:
        """Return how many periods later than the others a buffer arrived for a pulse; below 0 it is too early."""
        delay_ns = buffer.host_ns - buffer.exposure_ns - camera.latency_ns - self._times.at(pulse)
        alike_ns = min(max(self._usual_delay_ns(camera), 0.0), max(delay_ns, 0.0))
        return (delay_ns - alike_ns) / self._settings.period_ns

    def _number(self, camera: CameraState, pulses: list[int]) -> Iterator[NumberedBuffer]:
        """Number the first pending buffers."""
        numbered, camera.pending = camera.pending[: len(pulses)], camera.pending[len(pulses) :]
        for pulse, buffer in zip(pulses, numbered, strict=True):
            camera.last_pulse, camera.last_block = pulse, buffer.block_id
            camera.last_counts = _counts_after(camera.last_counts, pulse, buffer)
            camera.counter.take(pulse, buffer)
            late_ns = 0.0
            if not camera.played:
                # a late arrival may be that of a late exposure
                late_ns = max(self._excess(camera, pulse, buffer), 0.0) * self._settings.period_ns
                self._learn(pulse, buffer.host_ns - buffer.exposure_ns - camera.latency_ns)
            found: Found = "played" if camera.played else "count" if camera.proven else "arrival"
            yield NumberedBuffer(camera.name, pulse, 0.0, buffer, found, late_ns)

    def _learn(self, pulse: int, arrival_ns: float) -> None:
        # an early frame was counted too far, and does not show the pulse times
        if self._follows and arrival_ns - self._times.at(pulse) > -EARLY_SHARE * self._settings.period_ns:
            self._times.take(pulse, arrival_ns)


def _counted(camera: CameraState) -> list[int]:
    """Return the pulses of the pending buffers by their counts since the last one, up to one that began anew."""
    pulses: list[int] = []
    last, pulse = camera.last_counts, camera.last_pulse
    for buffer in camera.pending:
        if last is None or (buffer.block_id is None and buffer.triggers is None):
            pulse += 1
        else:
            step = _step(last[1], buffer)
            if step is None:
                break
            pulse = last[0] + step
        last = _counts_after(last, pulse, buffer)
        pulses.append(pulse)
    return pulses


def _counts_after(last: tuple[int, Grabbed] | None, pulse: int, buffer: Grabbed) -> tuple[int, Grabbed]:
    """Return the pulse and buffer from which the next one is counted: the last one that has a count, if any has."""
    if last is None or buffer.block_id is not None or last[1].block_id is None:
        return pulse, buffer
    return last


def _step(last: Grabbed, buffer: Grabbed) -> int | None:
    """Return the number of pulses from one buffer to the next by the camera's counts; None where it began anew."""
    for one, other in ((last.triggers, buffer.triggers), (last.block_id, buffer.block_id)):
        if one is not None and other is not None:
            return other - one if other > one else None
    return 1
