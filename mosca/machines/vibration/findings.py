"""Warnings about a record of vibration: aliasing, exposure, short records, gaps, noise not as stated."""

import numpy as np

from mosca.data.arrays import Array
from mosca.machines.vibration.displacements import Displacements
from mosca.machines.vibration.modal import Mode, damping_bound
from mosca.machines.vibration.spectra import NoiseFloor, Spectra

HIGHEST_SHARE = 0.4
"""Share of the frame rate up to which frequencies are stated without a warning of aliasing."""
_ABOVE_FLOOR = 2.0
"""A spectrum has not ended at the Nyquist frequency if it is this many times its low level near there."""
_LOW = 0.25
"""Quantile of a spectrum that is taken as its low level."""
_TOLD_FILLED = 0.01
"""Share of missing samples from which on a warning says that spectra are based on filled samples."""
_MOST_NAMED = 12
"""Most names in one line."""


def findings_of(
    record: Displacements, modes: tuple[Mode, ...], averaged: Spectra, floor: NoiseFloor, exposure_s: float
) -> tuple[str, ...]:
    """Return the warnings, one sentence each."""
    lines = [*_aliasing(record.rate_hz, modes, averaged), *_exposure(record.rate_hz, exposure_s)]
    if record.left_out:
        lines.append(f"left out, measured in too few frames: {_some(record.left_out)}")
    gaps = 1 - float(record.measured.mean())
    if gaps > 0:
        told = "" if gaps < _TOLD_FILLED else ": spectra rest on what other targets say of them"
        lines.append(f"{100 * gaps:.3g} % of the samples are missing and were not counted as measured{told}")
    for mode in modes:
        if not mode.is_line and damping_bound(mode.frequency_hz, mode.damping, record.length_s) > 0.25:
            lines.append(
                f"{mode.frequency_hz:.4g} Hz: {record.length_s:.3g} s are too short to tell its damping to 25 %"
            )
    if np.isfinite(floor.ratio) and not 0.8 < floor.ratio < 1.25:
        lines.append(
            f"the noise floor is {floor.ratio:.3g} times what the tracks state: a vibration that no mode explains, "
            "shaking cameras, smoothed tracks, or covariances that are wrong"
        )
    return tuple(lines)


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(names[:_MOST_NAMED]) + more


def _aliasing(rate_hz: float, modes: tuple[Mode, ...], averaged: Spectra) -> list[str]:
    """Return signs of content beyond half the frame rate, which no analysis can distinguish from content below it.

    Random forces with a flat spectrum cause displacements that fall with the fourth power of the frequency above each
    mode. So a spectrum that has not fallen to the noise by half the frame rate continues beyond it.
    """
    lines = []
    nyquist = rate_hz / 2
    for mode in modes:
        if mode.frequency_hz > HIGHEST_SHARE * rate_hz:
            lines.append(
                f"aliasing: {mode.frequency_hz:.4g} Hz is above {HIGHEST_SHARE:g} of the frame rate; it may be one "
                f"at {rate_hz - mode.frequency_hz:.4g} Hz: record at another frame rate and see whether it stays"
            )
    near: Array = averaged.frequency_hz > 0.9 * nyquist
    largest = averaged.singular_values[:, 0]
    # relative to the largest singular value where it is low: noise common to all targets (camera shake) is in both
    level = float(np.median(largest[near]) / np.quantile(largest[1:], _LOW))
    if level > _ABOVE_FLOOR:
        lines.append(
            f"aliasing: next to half the frame rate the spectrum is {level:.3g} times its lowest quarter and has not "
            "ended; what lies beyond is folded down: record faster"
        )
    return lines


def _exposure(rate_hz: float, exposure_s: float) -> list[str]:
    if not exposure_s:
        return []
    top, beyond = (float(np.sinc(share * rate_hz * exposure_s)) for share in (HIGHEST_SHARE, 1 - HIGHEST_SHARE))
    return [
        f"exposure of {1e3 * exposure_s:.3g} ms: amplitudes at {HIGHEST_SHARE * rate_hz:.4g} Hz are {100 * top:.3g} "
        f"% before the correction; it lets {100 * abs(beyond):.3g} % pass of what would be folded down there"
    ]
