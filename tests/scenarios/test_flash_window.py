"""A blinking lamp before a moving camera: its edges, and the offset of two clocks that are known."""

import numpy as np
import pytest

from mosca.data.frames import Frame
from mosca.diagnostics.light_marker.window import LampWindow, clock_offset, most_edges
from mosca.errors import InputError

ON_S = ((0.2, 0.47), (0.71, 0.86), (1.13, 1.55), (1.78, 1.99), (2.31, 2.4), (2.63, 2.9))
"""When the lamp is lit: irregular."""


def lit_share(start_s: float, length_s: float) -> float:
    return sum(max(0.0, min(start_s + length_s, b) - max(start_s, a)) for a, b in ON_S) / length_s


def window(
    name: str, rate_hz: float, exposure_s: float, ahead_s: float, *, row_s: float = 0.0, seed: int = 1
) -> LampWindow:
    """What a camera at changing distances sees, whose clock is ``ahead_s``; rows one after the other."""
    rng = np.random.default_rng(seed)
    found = LampWindow(name, 8)
    for k in range(int(3.0 * rate_hz)):
        start = 0.003 + k / rate_hz
        away, x, y = 2.0 + 0.5 * np.sin(k / 9), 60.0 + 12 * np.sin(k / 7), 40.0 + 15 * np.cos(k / 8)
        radius = 16.0 / away
        rows, columns = np.mgrid[:90, :120]
        disc = np.clip(radius + 0.5 - np.hypot(columns - x, rows - y), 0, 1)
        share = lit_share(start + row_s * y, exposure_s)
        image = np.clip(np.round(12 + 140 * share * disc + rng.normal(0, 1, disc.shape)), 0, 255).astype(np.uint8)
        frame = Frame(
            name, k, round((start + ahead_s) * 1e9), round(exposure_s * 1e9), image, row_time_ns=round(row_s * 1e9)
        )
        found.take(frame, np.array([x, y]), radius, away)
    return found


@pytest.mark.parametrize("row_s", [0.0, 200e-6])
def test_an_offset_of_clocks_is_found_within_its_own_error(row_s: float) -> None:
    errors = []
    for seed, ahead in enumerate((0.25, -7.125, 1234.5)):
        rig = window("cam1", 60.0, 0.001, 0.0, seed=seed)
        own = window("front", 30.0, 0.004, ahead, row_s=row_s, seed=10 + seed)
        found = clock_offset("front", rig.brightness(), own.brightness())
        errors.append((found.offset_s - ahead) / found.offset_sigma_s)
        assert abs(found.offset_s - ahead) < 0.008
        assert found.edges >= 9
    # each within three of its own standard deviations, and not ten times better than stated either
    assert np.abs(errors).max() < 3


def test_a_lamp_that_is_hardly_seen_and_one_that_does_not_blink_are_told() -> None:
    empty = LampWindow("front", 8)
    with pytest.raises(InputError, match="camera 'front': the lamp's place is seen in 0 frames, 10 at least"):
        empty.brightness()
    outside = LampWindow("front", 8)
    for k in range(20):
        frame = Frame("front", k, k * 10**7, 10**6, np.zeros((90, 120), np.uint8))
        outside.take(frame, np.array([2.0, 40.0]), 5.0, 2.0)  # its window leaves the image
        outside.take(frame, np.array([np.nan, 40.0]), 5.0, 2.0)
        outside.take(frame, np.full(2, np.nan), np.nan, 2.0)  # it is behind the camera
    with pytest.raises(InputError, match="seen in 0 frames"):
        outside.brightness()
    dark = LampWindow("cam1", 8)
    for k in range(20):
        dark.take(
            Frame("cam1", k, k * 10**7, 10**6, np.full((90, 120), 12, np.uint8)), np.array([60.0, 40]), 5.0, 2.0
        )
    with pytest.raises(InputError, match="no flash seen"):
        most_edges([dark, empty])
    assert most_edges([empty, window("cam2", 60.0, 0.001, 0.0)]).light.size > 100
