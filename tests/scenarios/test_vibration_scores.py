"""Found modes held against true ones, by hand; a wrong clock and exchanged shapes must show."""

from dataclasses import replace

import numpy as np
import pytest
from vibration_records import NOISE_M, PLACES, RATE_HZ, record_of

from mosca.machines.vibration.analysis import Vibration, VibrationSettings
from mosca.machines.vibration.modal import Mode, damping_bound
from mosca.machines.vibration.spectra import NoiseFloor, Spectra
from mosca.machines.vibration.subspace import Poles
from scenarios.score.vibration import vibration_scores
from twin.scenes.plate import ThinPlate

TRUE = ThinPlate((0.6, 0.4), 0.0009, 210e9, 0.3, 7850.0).modes(PLACES, 3, np.full(3, 0.002))
AT = np.column_stack([PLACES, np.full(len(PLACES), 0.5)])
LENGTH = 20000  # samples: 100 s


def found(*modes, ratio=1.05):
    record = record_of(np.zeros((LENGTH, len(PLACES))))
    record = replace(record, place=AT)
    floor = NoiseFloor(ratio * 2 * NOISE_M**2 / RATE_HZ, 2 * NOISE_M**2 / RATE_HZ)
    empty = np.empty(0)
    poles = Poles(empty, empty, empty, np.empty((0, 1)), empty)
    spectra = Spectra(np.ones(1), np.ones((1, 1, 1)), 5.0)
    return Vibration(record, tuple(modes), spectra, poles, floor, (), VibrationSettings())


def mode(k, *, hz=1.0, damping=1.0, shape=None, line=False):
    own = TRUE.shapes[:, k] if shape is None else shape
    return Mode(hz * TRUE.frequency_hz[k], 0.01, damping * 0.002, 1e-4, own, 1.0, 1e-4, 3.0, 1.0, line)


def test_the_worst_mode_counts():
    scores, rows = vibration_scores(found(mode(0, hz=1.0002, damping=1.2), mode(1, hz=0.9996), mode(2)), TRUE, AT)
    assert scores["modes_found"].value == 1
    assert scores["mode_frequency_error"].value == pytest.approx(4e-4)
    # 20 % of 2 bounds: 1 / sqrt(2 pi 19.976 0.002 100) = 0.19960, twice that above 15 %
    assert damping_bound(TRUE.frequency_hz[0], 0.002, 100.0) == pytest.approx(0.1996, rel=1e-3)
    assert scores["mode_damping_error"].value == pytest.approx(0.2 / 0.3992, rel=1e-3)
    assert scores["mode_mac"].value == pytest.approx(1.0)
    assert scores["noise_floor_ratio"].value == pytest.approx(1.05)
    assert rows["mode 1"]["damping_error"] == pytest.approx(0.2)


def test_exchanged_shapes_show_in_the_mac():
    swapped = (mode(0, shape=TRUE.shapes[:, 1]), mode(1, shape=TRUE.shapes[:, 0]), mode(2))
    scores, _ = vibration_scores(found(*swapped), TRUE, AT)
    assert scores["mode_mac"].value < 0.1
    assert scores["mode_frequency_error"].value == pytest.approx(0.0, abs=1e-12)


def test_a_clock_that_is_wrong_moves_all_frequencies():
    scores, _ = vibration_scores(found(*(mode(k, hz=1.005) for k in range(3))), TRUE, AT)
    assert scores["mode_frequency_error"].value == pytest.approx(0.005)
    assert scores["mode_mac"].value == pytest.approx(1.0)


def test_what_is_missing_and_a_steady_line_are_not_found():
    scores, rows = vibration_scores(found(mode(0), mode(1, line=True)), TRUE, AT)
    assert scores["modes_found"].value == pytest.approx(1 / 3)
    assert "mac" not in rows["mode 2"]
    assert list(vibration_scores(found(), TRUE, AT)[0]) == ["modes_found"]


def test_targets_in_another_order_are_the_same_targets():
    order = np.random.default_rng(0).permutation(len(PLACES))
    shuffled = replace(TRUE, shapes=TRUE.shapes[order], slopes=TRUE.slopes[order])
    scores, _ = vibration_scores(found(mode(0), mode(1), mode(2)), shuffled, AT[order])
    assert scores["mode_mac"].value == pytest.approx(1.0)
