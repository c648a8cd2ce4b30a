"""One program for a robot and for the twin's: read from its file, and from what a capture recorded of it."""

import json
from pathlib import Path

import numpy as np
import pytest
from robot_listener import Listener

from hardware.onboard.commands import ProgramRun, read_program
from mosca.data.frames import CameraInfo
from mosca.errors import InputError
from mosca.recording import RecordingWriter
from scenarios.build.robot_commands import command_lines, write_commands
from scenarios.build.scene import build_scene
from scenarios.run.scenario import run_scenario
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "library" / "subjects" / "robot_program.toml"
CAMERAS = [CameraInfo("left", 2, 2, 8, 100.0)]


def test_the_scenario_s_program_drives_the_twin():
    spec = load_scenario(SCENARIO)
    scene = build_scene(spec, SCENARIO.parent)
    np.testing.assert_array_equal(scene.commands.time_ns, np.array([5, 15, 25, 35]) * 100_000_000)
    np.testing.assert_array_equal(scene.commands.values[:, 2:], [[60, 60], [-45, 45], [80, 50], [0, 0]])
    start = scene.sampler().at(0.0).marker_xyz
    ahead = (start[9] - start[5])[:2]
    assert np.degrees(np.arctan2(ahead[1], ahead[0])) == pytest.approx(30.0, abs=0.01)


def test_a_robot_hears_the_lines_that_drive_the_twin(tmp_path):
    """The program is sent to a listener on a socket, as to a robot; what was recorded of it drives the twin again."""
    with Listener() as robot:
        text = (SCENARIO.parent / "robot.program").read_text()
        text = text.replace("192.168.7.30:7000", f"127.0.0.1:{robot.port}")
        program = tmp_path / "robot.program"
        program.write_text("\n".join(line if "at_s" not in line else "at_s = 0.0" for line in text.splitlines()))
        with RecordingWriter(tmp_path / "take", CAMERAS) as writer:
            times = iter(range(1_000_000, 10**9, 1_000_000))
            told = []
            run = ProgramRun(read_program(program), lambda _host: next(times), lambda *one: told.append(one))
            run.start()
            heard = [robot.line() for _ in range(4)]
            run.close()
            for channel, time_ns, data in told:
                writer.write_channel(channel, time_ns, data)
    assert [text for _, text in command_lines(program, "robot")] == heard
    recorded = command_lines(tmp_path / "take", "robot")
    assert [text for _, text in recorded] == heard
    sent = [data["time_ns"] for channel, _, data in told if channel == "commands"]
    assert [t for t, _ in recorded] == sent


def test_what_drove_the_twin_is_written_as_a_capture_writes_it(tmp_path):
    scene = build_scene(load_scenario(SCENARIO), SCENARIO.parent)
    with RecordingWriter(tmp_path / "take", CAMERAS) as writer:
        write_commands(writer, scene.commands)
    lines = command_lines(tmp_path / "take", "robot")
    assert [t for t, _ in lines] == scene.commands.time_ns.tolist()
    assert [json.loads(text) for _, text in lines][2] == {"left": 80.0, "right": 50.0}


def test_files_without_commands_say_what_they_have(tmp_path):
    program = SCENARIO.parent / "robot.program"
    with pytest.raises(InputError, match=r"robot\.program: no command for target 'drone'; it has targets robot"):
        command_lines(program, "drone")
    with RecordingWriter(tmp_path / "take", CAMERAS):
        pass
    with pytest.raises(InputError, match=r"take: no command for target 'robot'; it has targets \(none\)"):
        command_lines(tmp_path / "take", "robot")
    with pytest.raises(InputError, match="nowhere"):
        command_lines(tmp_path / "nowhere", "robot")


def test_noise_and_a_program_exclude_each_other(tmp_path):
    text = SCENARIO.read_text().replace(
        'commands = "robot.program"', 'commands = "robot.program"\naverage_pwm = 20.0'
    )
    (tmp_path / "both.toml").write_text(text)
    with pytest.raises(InputError, match="average_pwm is of the noise"):
        load_scenario(tmp_path / "both.toml")


def test_a_twin_s_recording_holds_what_drove_it_and_drives_it_again(tmp_path):
    program = tmp_path / "short.program"
    given = [(0.0, 60, 60), (0.01, -45, 45), (0.02, 80, 50)]
    program.write_text(
        '[[target]]\nname = "rover"\naddress = "10.0.0.1:1"\n'
        + "".join(
            f'[[program]]\ntarget = "rover"\nat_s = {at}\ncommand = {{ left = {left}, right = {right} }}\n'
            for at, left, right in given
        )
    )
    quick = (
        'scene.target="rover"',
        "capture.duration_s=0.04",
        "cameras.size_px=[160, 120]",
        "cameras.pixel_pitch_mm=0.04",
        "limits={ghosts_per_frame=100.0}",
        "pipeline.bodies=false",
        "premises.marker_px=0.5",
    )
    spec = load_scenario(SCENARIO, (*quick, f"scene.commands={program}"))
    run_scenario(spec, "robot", tmp_path, RunOptions(record_to=tmp_path / "take"))
    recorded = command_lines(tmp_path / "take", "rover")
    assert recorded == [
        (round(at * 1e9), json.dumps({"left": float(left), "right": float(right)})) for at, left, right in given
    ]
    again = build_scene(load_scenario(SCENARIO, (*quick, "scene.commands=take")), tmp_path)
    first = build_scene(spec, tmp_path)
    np.testing.assert_array_equal(again.commands.values, first.commands.values)
    np.testing.assert_array_equal(again.sampler().at(0.03).marker_xyz, first.sampler().at(0.03).marker_xyz)
