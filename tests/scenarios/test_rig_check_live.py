"""The rig check with frames: devices that differ, light, focus, pulses without frames."""

import math

import numpy as np
import pytest
from capture_rig import Line, openers, write_rig

from hardware.driver import DeviceReport
from scenarios.lab.rig_check import check_rig_live, differing, edge_width_px, focus, light

SIZE = (160, 120)


def step(sigma_px, slant=0.13, size=SIZE, high=200.0):
    """A slanted edge, blurred by a Gaussian, in closed form."""
    y, x = np.mgrid[: size[1], : size[0]]
    away = (x - size[0] / 2 - slant * (y - size[1] / 2)) / (sigma_px * math.sqrt(1 + slant**2))
    phi = np.vectorize(lambda t: 0.5 * (1 + math.erf(t / math.sqrt(2))))(np.clip(away, -6, 6))
    return np.rint(10 + high * phi).astype(np.uint8)


@pytest.mark.parametrize("sigma_px", [0.5, 0.8, 1.2, 2.0])
def test_the_width_of_an_edge_is_its_blur(sigma_px):
    assert edge_width_px(step(sigma_px)) == pytest.approx(sigma_px, rel=0.12)


def test_focus_and_light_in_words():
    assert "focus the lens" in focus([step(2.5)])
    assert "focus the lens" not in focus([step(0.7)])
    noise = np.random.default_rng(1).normal(10, 2, (120, 160)).astype(np.uint8)
    assert "no clear edges" in focus([noise])
    assert "dark" in light([noise], 8)
    assert "shorten the exposure" in light([np.full((120, 160), 255, np.uint8)], 8)
    assert light([step(1.0)], 8) == "brightest pixels at 82 % of white"  # (10 + 200) of 255
    assert light([], 8) == ""


def test_settings_that_differ_are_named():
    def report(model, **settings):
        return DeviceReport(model, "1", 10, 10, 8, 0, settings)

    told = differing({"a": report("M", Gain=0.0), "b": report("M", Gain=3.0), "c": report("N", Gain=5.0)})
    assert told == ["Gain differs: a 0.0, b 3.0"]


@pytest.mark.parametrize("missed", [(), (20, 21, 22)])
def test_a_rig_is_checked_from_its_frames(tmp_path, missed):
    path = write_rig(tmp_path / "rig.toml", "ab", SIZE)
    images = {"a": [step(0.7)], "b": [step(3.0)]}
    line = Line(misses={"b": set(missed)})
    lines, whole = check_rig_live(path, 0.5, tmp_path, *openers(line, images, SIZE))
    assert whole == (not missed)
    text = "\n".join(lines)
    assert "camera 'a': fake a, 160 x 120 px, 8 bit, exposure 500 us\n  50 of 50 pulses at 100 Hz" in text
    assert f"{50 - len(missed)} of 50 pulses" in text
    assert text.count("focus the lens") == 1
    assert "MB/s before packing" in lines[-1]  # 2 x 160 x 120 x 100
    assert "4 MB/s" in lines[-1]
