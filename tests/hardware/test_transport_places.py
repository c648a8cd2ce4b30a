"""Which pulse is which: shifts found from simulated arrivals."""

import numpy as np
import pytest

from hardware.transport.pulse_alignment import StationPulses

RATE = 100.0
T = 1e9 / RATE


class Line:
    """Arrivals of simulated pulses: latency, exponential lateness, stalls."""

    def __init__(self, rate=RATE, seed=0, ppm=0.0):
        self.rng, self.period = np.random.default_rng(seed), 1e9 / rate * (1 + ppm * 1e-6)

    def at(self, pulse, latency_s=0.003):
        late = self.rng.exponential(0.5e-3) + (0.2 if self.rng.random() < 0.01 else 0.0)
        return round(5e9 + pulse * self.period + (latency_s + late) * 1e9)


def run(places, line, stations, pulses):
    """``stations``: name -> (epoch, first pulse that it saw, latency)."""
    for pulse in pulses:
        for name, (epoch, first, latency) in stations.items():
            if pulse >= first:
                places.take(name, epoch, pulse - first, line.at(pulse, latency))


@pytest.mark.parametrize(("first", "shift"), [(0, 0), (1, 1), (7, 7)])
def test_who_starts_a_pulse_late_is_found_out(first, shift):
    places = StationPulses(("A", "B"), RATE, 5.0)
    run(places, Line(), {"A": (1, 0, 0.003), "B": (2, first, 0.0045)}, range(200))
    assert (places.shift("A"), places.shift("B")) == (0, shift)
    told = [text for station, text in places.notes if station == "B"]
    assert told == ([f"counts from another pulse: its pulse 0 is pulse {shift} of the session"] if shift else [])


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("rate", [20.0, 100.0, 500.0])
def test_it_is_right_again_and_again(seed, rate):
    rng = np.random.default_rng(seed)
    places, line = StationPulses(("A", "B", "C"), rate, 5.0), Line(rate, seed)
    firsts = [0, *rng.integers(0, 5, 2)]
    spread = 0.2 / rate
    run(
        places,
        line,
        {n: (k, f, 0.003 + spread * rng.random()) for k, (n, f) in enumerate(zip("ABC", firsts, strict=True))},
        range(300),
    )
    assert [places.shift(n) for n in "ABC"] == firsts


def test_who_comes_back_finds_its_place_though_clocks_drift():
    places, line = StationPulses(("A", "B"), RATE, 5.0), Line(ppm=80)
    run(places, line, {"A": (1, 0, 0.003), "B": (2, 0, 0.004)}, range(1000))
    run(places, line, {"A": (1, 0, 0.003)}, range(1000, 30_000))
    run(places, line, {"A": (1, 0, 0.003), "B": (3, 30_000, 0.004)}, range(30_000, 30_200))
    assert places.shift("B") == 30_000
    assert places.notes == [("B", "counts from another pulse: its pulse 0 is pulse 30000 of the session")]


def test_the_session_begins_without_a_station_that_does_not_come():
    places = StationPulses(("A", "B"), RATE, 0.5)
    run(places, Line(), {"A": (1, 0, 0.003)}, range(45))
    assert not places.started
    run(places, Line(), {"A": (1, 0, 0.003)}, range(45, 100))
    assert places.started
    run(places, Line(), {"A": (1, 0, 0.003), "B": (1, 100, 0.003)}, range(100, 200))
    assert places.shift("B") == 100


def test_a_station_between_pulses_is_left_out_and_said():
    places = StationPulses(("A", "B"), RATE, 5.0)
    run(places, Line(), {"A": (1, 0, 0.003), "B": (2, 0, 0.007)}, range(300))
    assert places.shift("A") == 0
    assert places.shift("B") is None
    ((station, text),) = places.notes
    assert station == "B"
    assert "0.4" in text
    assert "same trigger cable" in text


def test_a_count_that_runs_ahead_is_found_and_placed_anew():
    places, line = StationPulses(("A", "B"), RATE, 5.0), Line()
    run(places, line, {"A": (1, 0, 0.003), "B": (2, 0, 0.003)}, range(200))
    for pulse in range(200, 400):
        places.take("A", 1, pulse, line.at(pulse))
        places.take("B", 2, pulse + 1, line.at(pulse))
    assert places.shift("B") == -1
    assert any("counts wrongly" in text for station, text in places.notes if station == "B")


def test_a_station_that_falls_behind_is_said_and_not_moved():
    places, line = StationPulses(("A", "B"), RATE, 5.0), Line()
    run(places, line, {"A": (1, 0, 0.003), "B": (2, 0, 0.003)}, range(200))
    run(places, line, {"A": (1, 0, 0.003), "B": (2, 0, 0.020)}, range(200, 600))
    assert places.shift("B") == 0
    assert [s for s, text in places.notes if "after their pulses" in text] == ["B"]
