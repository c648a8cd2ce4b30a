"""Learned sensors beside data sheets: what is stated by EMVA 1288, and which differences are told of."""

from dataclasses import replace

import numpy as np
import pytest

from mosca.diagnostics.sensor import Estimate, LearnedSensor
from reports.page import _sensor_row
from scenarios.run.record import sensor_record
from scenarios.score.sensor import sensor_findings, stated_sensor, stated_sensors
from twin.cameras.sensor.readout import expose
from twin.cameras.sensor.sensor import Sensor
from witness.emva import temporal

SHEET = Sensor(bits=12, full_well_e=10_000.0, read_noise_e=8.0, black_dn=4.0, background_e=300.0)
GAIN = (4095 - 64) / 10_000


def learned(gain=GAIN, noise=7.7, share=0.05, bits=12):
    """A camera whose figures are known to ``share``."""
    parts = [None if v is None else Estimate(v, v * (1 - share), v * (1 + share)) for v in (noise, gain)]
    left_out = {"faint": 3, "small": 0, "large": 0, "uneven": 0, "cut": 1}
    blur = Estimate(0.7, 0.69, 0.71)
    return LearnedSensor("cam", 50, 1000, 9000, *parts, blur, 184.0, bits, 1, 584.0, 900, 0.0, 1000, left_out)


def test_what_a_sheet_states_is_what_a_sensor_by_it_does():
    # witness: the temporal variance of pairs of even images; 64 DN black + 300 e-
    dark = np.zeros((400, 400))
    level, variance = temporal(expose(dark, SHEET, 1), expose(dark, SHEET, 2))
    stated = stated_sensor(SHEET, level)
    assert stated.gain_dn_per_e == pytest.approx(GAIN)
    assert stated.noise_dn == pytest.approx(np.sqrt(variance - 1 / 12), rel=0.01)
    # by hand: 64 DN^2 e- of dark noise and 300 of photons
    assert stated.noise_dn == pytest.approx(GAIN * np.sqrt(64 + 300), rel=0.01)
    assert (stated.saturation_dn, stated.bits) == (4095, 12)


def test_fixed_patterns_count_as_noise_from_pixel_to_pixel():
    patterned = replace(SHEET, dsnu_e=30.0)
    more = stated_sensor(patterned, 184.0).noise_dn ** 2 - stated_sensor(SHEET, 184.0).noise_dn ** 2
    assert more == pytest.approx((GAIN * 30.0) ** 2)


@pytest.mark.parametrize(
    ("one", "told"),
    [
        (learned(), None),
        (learned(gain=0.78 * GAIN), None),  # the misfit of limbs
        (learned(gain=GAIN / 1.6), None),
        (learned(gain=GAIN / 4), "a gain of 0.0957 to 0.106 DN/e-, 0.403 is stated"),
        (learned(gain=GAIN / 4, share=2.0), None),  # not known well enough
        (learned(gain=1.4 * GAIN), None),
        (learned(gain=4 * GAIN), "0.403 is stated"),
        (learned(noise=7.7 / 1.3), None),
        (learned(noise=7.7 * 2), "a noise of 14.6 to 16.2 DN, 7.67 is stated"),
        (learned(noise=7.7 / 2), "7.67 is stated"),
        (learned(gain=None, noise=None), None),
        (learned(bits=8), "images of 8 bits, 12 are stated"),
    ],
)
def test_what_lies_far_off_is_told_of(one, told):
    lines = sensor_findings((one,), stated_sensors((one,), {"cam": SHEET}))
    assert len(lines) == (told is not None)
    if told:
        assert lines[0].startswith("camera 'cam': ")
        assert told in lines[0]


def test_a_usual_misfit_of_bright_targets_is_not_told_of():
    # 2 % of a contrast of 400 DN is as much as 0.16 DN/e- of photon noise would make
    sheet = replace(SHEET, full_well_e=100_000.0)
    one = learned(gain=0.0403 + 0.15, noise=None)
    assert sensor_findings((one,), stated_sensors((one,), {"cam": sheet})) == []
    dim = replace(one, peak_dn=284.0)
    assert len(sensor_findings((dim,), stated_sensors((dim,), {"cam": sheet}))) == 1


def test_cameras_without_a_sheet_are_not_compared():
    assert stated_sensors((learned(),), {"other": SHEET}) == {}
    assert sensor_findings((learned(bits=8),), {}) == []
    assert stated_sensors((replace(learned(), background_dn=None),), {"cam": SHEET}) == {}


def test_record_and_page_have_learned_and_stated_side_by_side():
    one = learned(gain=0.3)
    record = sensor_record(one, stated_sensor(SHEET, 184.0))
    assert record["gain_dn_per_e"] == [0.3, 0.285, 0.315]
    assert record["stated"]["gain_dn_per_e"] == pytest.approx(GAIN)
    assert record["left_out"]["faint"] == 3
    row = _sensor_row("cam", record)
    assert row[2] == "0.3 (0.285 to 0.315), stated 0.403"
    assert row[-1] == "1000 found; left out: 3 faint, 1 cut"
    alone = _sensor_row("cam", sensor_record(replace(one, noise_dn=Estimate(0.5, 0.0, 0.5), gain_dn_per_e=None)))
    assert alone[1:3] == ("below 0.5", "not learned")
