"""Flights in closed loop on drawn poses: what must crash and what must not, the map's figures, wrong keys."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from mosca.errors import InputError
from mosca.machines.closed_loop.delay_margin import PositionLoop
from mosca.machines.closed_loop.filtered_loop import FilteredLoop
from mosca.machines.closed_loop.late_pose_filter import MotionNoise
from scenarios.build.scene import build_scene
from scenarios.cli.flight import flight as flight_verbs
from scenarios.commands.flight_map import FlightOutcome, cell_of, described, wilson95
from scenarios.flight.loop import live_flight
from scenarios.flight.pilot import ArrivedPose, AttitudeLag, Pilot
from scenarios.flight.predicted import fly_predicted
from scenarios.score.flight import flight_scores
from scenarios.spec.scenario import load_scenario
from twin.scenes.flight import GRAVITY

HOVER = Path(__file__).parents[2] / "scenarios" / "library" / "flight" / "hover.toml"


class EvenNoise:
    """Poses alike good everywhere."""

    def __init__(self, sigma_m):
        self._covariance = np.eye(3) * sigma_m**2
        self.calibration_m2 = np.zeros((3, 3))

    def at(self, position):
        return self._covariance


def flown(*overrides, seconds=4.0, sigma_m=1e-4, with_delay=False):
    spec = load_scenario(HOVER, (f"capture.duration_s={seconds}", *overrides))
    return fly_predicted(spec, HOVER.parent, EvenNoise(sigma_m), with_delay)


def test_it_hovers_and_the_predicted_covariance_is_right():
    found = flown(with_delay=True)
    scores = flight_scores(found.path, None)
    assert scores["crashes"].value == 0
    assert scores["flight_rms"].value < 0.005
    # errors of 0.1 mm each axis: the prediction over 18 ms adds little, filtering takes some off
    assert 0.5e-4 < scores["prediction_rms"].value < 3e-4
    assert 1.0 < scores["prediction_nees"].value < 6.0
    assert found.delay is None
    assert "delay:" in found.delay_note  # hovering does not tell it


def test_steps_tell_the_delay_to_2_ms_and_a_wrong_belief_shows():
    keys = ("scene.path='steps'", "flight.inputs='imu'", "flight.command_s=0", "flight.unexplained_s=30")
    wrong = flown(*keys, "fault.kind='wrong_delay'", "fault.offset_s=0.02", seconds=8.0, with_delay=True)
    scores = flight_scores(wrong.path, wrong.delay)
    assert scores["pose_delay_error"].value < 0.002
    assert 0.018 < scores["pose_delay_mismatch"].value < 0.022


def test_steps_tell_the_delay_from_commands_alone():
    """Two flights tell it to 0.5 ms each: the mean is within 1.2 ms in 99 of 100 cases.

    Commands that come 1 ms after a control step act with the next one: taken to act at once they feign 4 ms less.
    """
    keys = ("scene.path='steps'", "flight.command_s=0.001")
    found = [flown(*keys, f"seed={k}", seconds=9.0, with_delay=True).delay.delay_s for k in (1, 2)]
    assert np.mean(found) == pytest.approx(0.0145, abs=0.0012)


class Shaken:
    """Commands drawn at random, and what the drone's acceleration was and should have been (n, 3)."""

    def __init__(self):
        self._lag, self._random = AttitudeLag(), np.random.default_rng(2)
        self._push = self._awaited = np.zeros(3)
        self.was, self.awaited = [], []

    def steer(self, time_s, aboard, wanted):
        self.was.append(aboard.acceleration)
        self.awaited.append(self._awaited)
        # each command holds for 100 ms
        if len(self.was) % 20 == 1:
            self._push = self._random.normal(0.0, 0.05, 3)
        self._awaited = self._lag.step(self._push, aboard.centre_m)
        return self._push + GRAVITY, float(wanted.at(time_s)[3])


def test_the_attitude_loop_answers_as_the_physics_do():
    """Accelerations of a period against MuJoCo's: small tilts; thrust across a tilt is of second order."""
    spec = load_scenario(HOVER, ("scene.gust_n=0", "working_space.size_m=[60.0, 60.0, 60.0]"))
    pilot = Shaken()
    live_flight(build_scene(spec, HOVER.parent, pilot)).advance(1.5)
    was, awaited = np.array(pilot.was)[20:], np.array(pilot.awaited)[20:]
    assert np.sqrt(np.mean(was**2)) > 0.03
    # left are 0.0003; a loop without steps would leave 0.003, a drone that turns about its origin 0.01
    assert np.sqrt(np.mean((was - awaited) ** 2)) < 0.001


def test_what_poses_share_is_in_the_stated_prediction():
    """Filters take errors that last for motion: their covariance is added as it is."""
    spec = load_scenario(HOVER)
    stated = []
    for lasting_m in (0.0, 2e-4):
        pilot = Pilot(spec.flight, 0.0, 1)
        flight = live_flight(build_scene(spec, HOVER.parent, pilot))
        for k in range(10):
            pose = ArrivedPose(0.01 * k, 0.01 * k, np.zeros(3), 1e-8 * np.eye(3), lasting_m**2 * np.eye(3))
            pilot.receive(pose)
        flight.advance(0.12)
        stated.append(pilot.steps[-1].covariance)
    np.testing.assert_allclose(stated[1] - stated[0], 4e-8 * np.eye(3), atol=1e-12)


@pytest.mark.parametrize(("pipeline_s", "crashes"), [("0.0135", 0), ("0.0735", 1)])
def test_without_prediction_the_delay_margin_decides(pipeline_s, crashes):
    """Delays of 20 and 80 ms on either side of the margin of the linear loop with the filter in it."""
    loop = FilteredLoop(PositionLoop(), MotionNoise(), 1e-4, 0.005, 0.01)
    assert 0.020 < loop.margin_s() < 0.080
    found = flown(f"flight.pipeline_s={pipeline_s}", "flight.compensate=false", seconds=6.0)
    assert bool(found.path.crash) == bool(crashes)


def test_prediction_holds_what_crashes_without_it():
    assert not flown("flight.pipeline_s=0.0735", seconds=6.0).path.crash


def test_no_poses_for_good_end_in_a_crash():
    found = flown("flight.outage_s=[0.6, 60.0]", "scene.gust_n=0.2", seconds=12.0)
    assert found.path.crash
    assert found.path.crashed_s > 0.6


def test_wilson_by_hand():
    """Newcombe 1998, table I: 15 of 148 and 0 of 20."""
    assert wilson95(15, 148) == pytest.approx((0.0624, 0.1605), abs=1e-4)
    assert wilson95(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_a_cell_by_hand():
    spec = load_scenario(HOVER, ("flight.dropout=0.5",))
    outcomes = [FlightOutcome(False, 0.003), FlightOutcome(False, 0.004), FlightOutcome(True, np.nan)]
    cell = cell_of(spec, outcomes)
    assert (cell.runs, cell.crashes) == (3, 1)
    assert cell.rms_m == pytest.approx(np.sqrt((0.003**2 + 0.004**2) / 2))
    # 0.5 + 4 + 2 + 8 latency, 1.5 periods of 10 ms, 4 command, 2.5 half a control period
    assert cell.age_s == pytest.approx(0.036)
    assert any("1 of 3" in line for line in described(spec, [cell], 1e-4))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("flight.dropout=1.0", "dropout"),
        ("flight.outage_s=[3.0, 2.0]", "earlier instant first"),
        ("flight.handover_s=4.5", "less than 1 s"),
        ("pipeline.bodies=false", "pipeline.bodies = true"),
        ("scene={kind='robot'}", "only a 'drone' flies"),
        ("flight.inputs='gps'", "inputs"),
    ],
)
def test_wrong_keys_are_told(override, words):
    with pytest.raises(InputError, match=words):
        load_scenario(HOVER, (override,))


def test_what_needs_a_flight_is_told():
    drone = HOVER.parents[1] / "subjects" / "drone.toml"
    with pytest.raises(InputError, match=r"limits\.crashes needs a flight in closed loop; add \[flight\]"):
        load_scenario(drone, ("limits.crashes=0",))
    with pytest.raises(InputError, match=r"'wrong_delay' is of a flight"):
        load_scenario(drone, ("fault.kind='wrong_delay'", "fault.offset_s=0.02"))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["map", str(HOVER), "--latency", "20:x:5"], "numbers as 20,40,60 or 20:60:20"),
        (["map", str(HOVER), "--latency", "20:60:0"], "numbers as 20,40,60 or 20:60:20"),
        (["map", str(HOVER), "--dropout", "0,1"], "numbers from 0 to below 1"),
        (["map", str(HOVER), "--latency", "nan"], "1 to 100 numbers"),
        (["map", str(HOVER), "--runs", "1"], "--runs"),
    ],
)
def test_wrong_options_are_told(words, told):
    result = CliRunner().invoke(flight_verbs, words)
    assert result.exit_code == 2
    assert told in result.output


def test_a_map_of_something_else_is_told():
    drone = HOVER.parents[1] / "subjects" / "drone.toml"
    result = CliRunner().invoke(flight_verbs, ["map", str(drone)])
    assert isinstance(result.exception, InputError)
    assert "no [flight]" in str(result.exception)
    result = CliRunner().invoke(flight_verbs, ["map", str(HOVER), "--latency", "3,20"])
    assert isinstance(result.exception, InputError)
    assert "--latency 3" in str(result.exception)
