"""mosca identify: a robot of known dynamics from files to a model; wrong inputs and keys in one line."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import mosca, refusal
from identification_takes import driven_path, first_order, noise_inputs
from scipy.spatial.transform import Rotation

from mosca.data.tracks import Tracks, write_npz
from mosca.errors import InputError
from scenarios.spec.catalog import LIBRARY
from scenarios.spec.scenario import load_scenario

TARGETS = {
    "T1": (-0.15, 0.1),
    "T3": (0.0, 0.1),
    "T6": (-0.15, 0.0),
    "T8": (0.0, 0.0),
    "T10": (0.15, 0.0),
    "T13": (0.0, -0.1),
}
V, W = first_order(15.0, (0.0024, 0.0024)), first_order(20.0, (-0.0065, 0.0065))
DURATION_S = 16.0


def written(folder: Path, name: str, seed: int) -> None:
    """Write tracks of six targets at 50 Hz and the commands of their drive."""
    inputs = noise_inputs(seed, DURATION_S)
    path = driven_path(V.distance(inputs, DURATION_S), W.distance(inputs, DURATION_S), 0.02, (1e-9, 1e-9), seed)
    n, m = len(path.frame), len(TARGETS)
    world = Rotation.from_rotvec(path.values[:, 2:] * [0.0, 0.0, 1.0])
    centre = np.column_stack([path.values[:, :2], np.full(n, 0.15)])
    xyz = np.stack([world.apply([x, y, 0.0]) + centre for x, y in TARGETS.values()], axis=1)
    xyz += np.random.default_rng(seed).normal(0, 1e-4, xyz.shape)
    tracks = Tracks(
        np.repeat(path.frame, m), np.repeat(path.time_ns, m), np.tile(np.arange(m), n),
        np.tile(np.array(list(TARGETS)), n), xyz.reshape(-1, 3), np.tile(1e-8 * np.eye(3), (n * m, 1, 1)),
        np.full(n * m, 4), np.full(n * m, 0.05), np.full(n * m, "measured"),
    )  # fmt: skip
    write_npz(tracks, folder / f"{name}.npz")
    rows = [f"{t!r},{a!r},{b!r}" for t, (a, b) in zip(inputs.time_s.tolist(), inputs.values.tolist(), strict=True)]
    (folder / f"{name}.csv").write_text("\n".join(["time_s,left,right", *rows]) + "\n")


@pytest.fixture(scope="module")
def takes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("identify")
    for name, seed in (("one", 1), ("two", 2)):
        written(folder, name, seed)
    return folder


def test_a_known_robot_is_identified(takes):
    words = ["--validate", "two.npz", "two.csv", "--out", "m.json", "--plot", "fit.svg", "--orders", "1"]
    done = mosca("identify", "one.npz", "one.csv", *words, cwd=takes)
    assert done.returncode == 0, done.stderr
    assert "801 poses of 'deck' at 50 Hz, 80 commands" in done.stdout
    model = json.loads((takes / "m.json").read_text())
    for one, known, pole in zip(model["outputs"], (V, W), (-15, -20), strict=True):
        value, low, high = one["poles_real_rad_s"][0]
        assert abs(value - pole) < high - low
        assert one["poles_discrete"][0][0] == pytest.approx(np.exp(0.02 * value))
        for side, gain in zip(("left", "right"), known.gains(), strict=True):
            value, low, high = one["gains"][side]
            assert abs(value - gain) < high - low < 0.1 * abs(gain)
            numerator = one["numerators"][side]
            assert numerator[-1] / one["denominator"][-1] == pytest.approx(value)
        assert one["fit_unseen_percent"] > 90
    svg = (takes / "fit.svg").read_text()
    assert "two.npz" in svg
    assert "commands" in svg


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["one.npz", "none.csv"], "none.csv: no such file"),
        (["none.npz", "one.csv"], "none.npz: no such file"),
        (["one.csv", "one.csv"], "one.csv: its first line is not that of a"),
        (["one.npz", "one.npz"], "one.npz"),
        (["one.npz", "one.csv", "--out", "m.txt"], "m.txt: suffix '.txt' given; .json is wanted here"),
        (["one.npz", "one.csv", "--plot", "fit.png"], "fit.png: suffix '.png' given; .svg is wanted here"),
        (["one.npz", "one.csv", "--axes", "T8"], "--axes T8: CENTRE,BACK-FRONT,RIGHT-LEFT is wanted"),
        (["one.npz", "one.csv", "--axes", "T9,T6-T10,T13-T3"], "one.npz: no target 'T9' for the axes"),
        (["one.npz", "one.csv", "--inputs", "thrust"], "lacks the column 'thrust'"),
        (["one.npz", "one.csv", "--inputs", "time_s"], "1 to 16 different columns are wanted, none of them a clock"),
        (["one.npz", "one.csv", "--body", "none.toml"], "none.toml"),
        (["one.npz", "one.csv", "--orders", "0"], "0 is not in the range"),
        (["one.npz", "one.csv", "--delay", "0"], "0.0 is not in the range"),
        (["one.npz", "late.csv"], "0 commands fall into the 16 s of the tracks"),
        (["one.npz", "same.csv"], "do not vary independently of each other"),
    ],
)
def test_wrong_inputs_are_told_of_in_one_line(takes, words, told):
    (takes / "late.csv").write_text("time_s,left,right\n900,1,2\n901,2,1\n")
    rows = [f"{0.2 * k},{k % 7},{k % 7}" for k in range(80)]
    (takes / "same.csv").write_text("\n".join(["time_s,left,right", *rows]) + "\n")
    before = sorted(p.name for p in takes.iterdir())
    assert told in refusal("identify", *words, cwd=takes)
    assert sorted(p.name for p in takes.iterdir()) == before


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["identification.most_order=0"], "greater than or equal to 1"),
        (["pipeline.bodies=false"], "[identification] needs the robot's poses; set pipeline.bodies = true"),
        (["scene.commands=robot.program"], "[identification] needs scene.kind = 'robot' driven by noise"),
        (["scene={kind='drone'}"], "[identification] needs scene.kind = 'robot' driven by noise"),
    ],
)
def test_wrong_keys_are_told_of_in_one_line(overrides, told):
    with pytest.raises(InputError) as refused:
        load_scenario(LIBRARY / "machines" / "skid_steer.toml", tuple(overrides))
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)


def test_limits_and_faults_of_a_model_need_one():
    robot = LIBRARY / "subjects" / "robot.toml"
    with pytest.raises(InputError, match=r"limits\.v_x_rms needs a model; add"):
        load_scenario(robot, ("limits.v_x_rms=1",))
    with pytest.raises(InputError, match=r"'late_commands' needs a model of the commands"):
        load_scenario(robot, ("fault={kind='late_commands', delay_s=0.1}",))
