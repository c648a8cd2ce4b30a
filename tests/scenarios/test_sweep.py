"""``mosca sweep``: each value of a key is a run, and the page draws the runs' own figures."""

import pytest
from command_line import mosca, refusal
from tiny_scenario import write_tiny

from reports.record import read_record


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    # cameras that shake by 2 px break a limit that steady ones keep
    write_tiny(folder, limits="position_rms = 0.001", cameras="[errors]\nbody_px = 0.0")
    made = mosca(
        "sweep", "tiny.toml", "errors.body_px", "0", "0.03", "2", "--jobs", "1", "--set", "seed=3", cwd=folder
    )
    return folder, made


def test_each_value_is_a_run_with_a_page(done):
    folder, made = done
    assert made.returncode == 1, made.stderr
    runs = {value: folder / f"runs/sweep/tiny/errors.body_px={value}" for value in ("0", "0.03", "2")}
    records = {value: read_record(run / "record.json") for value, run in runs.items()}
    assert {record.seed for record in records.values()} == {3}
    rms = {value: record.metric("position_rms").value for value, record in records.items()}
    assert max(rms["0"], rms["0.03"]) < rms["2"]
    assert [record.passed for record in records.values()] == [True, True, False]
    # the table says the same, a row a value
    rows = {line.split()[0]: line for line in made.stdout.splitlines() if line.split()[:1] and line[0].isdigit()}
    assert {value: "BROKEN" in row for value, row in rows.items()} == {"0": False, "0.03": False, "2": True}
    for value, row in rows.items():
        assert abs(float(row.split()[1]) - 1e3 * rms[value]) < 0.006 * 1e3 * rms[value]
    page = (folder / "runs/sweep/sweep.html").read_text(encoding="utf-8")
    assert all(f'href="tiny/errors.body_px%3D{value}/report.html"' in page for value in runs)
    assert "Figures over errors.body_px" in page


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("sweep tiny.toml seed 1 1", "seed: the value 1 is given twice, or reads like another one; give each once"),
        ("sweep tiny.toml cameras.cuont 3 4", "unknown key 'cameras.cuont'; did you mean 'count'?"),
        ("sweep tiny.toml cameras.count 3 many", "key 'cameras.count': 'many' given; a whole number is wanted"),
        ("sweep tiny.toml cameras.count", "Missing argument 'VALUE...'"),
        ("sweep none.toml cameras.count 3", "none.toml: no such file"),
        ("sweep space_1m seed 1", "space_1m: 2 scenarios end so: calibration/space_1m, spaces/space_1m; give one of"),
    ],
)
def test_mistakes_are_told_before_anything_runs(tmp_path, given, told):
    write_tiny(tmp_path)
    assert told in refusal(*given.split(), cwd=tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == ["tiny.toml"]
