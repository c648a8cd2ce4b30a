"""The benchmark: planted entrants, data sets against OpenCV, seeds, the page, wrong input in one line."""

import csv
import dataclasses
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmark_entrants import PYTHON, planted
from click.testing import CliRunner

from mosca.data.rig import Camera, OpenCVLens, Rig
from mosca.data.truth import Truth
from mosca.errors import InputError
from reports.benchmark.page import write_leaderboard
from scenarios.build.camera_ring import looking_at
from scenarios.cli.main import cli
from scenarios.studies.benchmark import seeds
from scenarios.studies.benchmark.benchmark import Benchmarked, BenchmarkJob, OnSet, run_benchmark
from scenarios.studies.benchmark.entrant import Entrant, EnvironmentFailed, python_of, read_entrants, settings_for
from scenarios.studies.benchmark.execute import execute
from scenarios.studies.benchmark.folder import MadeSet, read_about, read_set_truth, write_set
from scenarios.studies.benchmark.make import SetFile, make_set, set_files
from scenarios.studies.benchmark.result import document_of, mean_interval, overall, write_result
from scenarios.studies.benchmark.scoring import FoundPoints, match_detections, read_found, score_found
from scenarios.types import Score

FRAMES, MARKERS = 12, 5
LENS = OpenCVLens(700.0, 701.0, 326.0, 246.0, k1=-0.1, k2=0.03, p1=4e-4, p2=-3e-4, k3=0.01)


def small_truth() -> tuple[Rig, Truth]:
    """Return three cameras and five markers, 0.2 m apart and more, that move by 1 mm a frame."""
    rng = np.random.default_rng(1)
    places = [np.array([2.0, 0.3, 0.5]), np.array([-0.5, 2.0, 0.8]), np.array([-1.6, -1.2, 0.4])]
    rig = Rig(
        tuple(
            Camera(f"c{k}", 656, 491, LENS, looking_at(place, np.zeros(3), f"c{k}")) for k, place in enumerate(places)
        )
    )
    start = 0.2 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]) + rng.normal(0, 0.01, (5, 3))
    xyz = start + 0.001 * np.arange(FRAMES)[:, None, None]
    images = np.empty((FRAMES, MARKERS, 3, 2))
    for c, camera in enumerate(rig.cameras):
        inverse = camera.world_from_camera.inverse()
        matrix = np.array([[LENS.fx_px, 0, LENS.cx_px], [0, LENS.fy_px, LENS.cy_px], [0, 0, 1]])
        coefficients = np.array([LENS.k1, LENS.k2, LENS.p1, LENS.p2, LENS.k3])
        rotation = cv2.Rodrigues(np.array(inverse.rotation))[0]
        seen = cv2.projectPoints(xyz.reshape(-1, 3), rotation, np.array(inverse.translation), matrix, coefficients)[0]
        images[:, :, c] = seen.reshape(FRAMES, MARKERS, 2)
    times = 5_000_000 + 10_000_000 * np.arange(FRAMES)
    shape = (FRAMES, MARKERS, 3)
    names = tuple(f"m{k}" for k in range(MARKERS))
    return rig, Truth(
        times, names, xyz, np.ones(shape), rig.names, images, np.full(shape, 6.0), np.tile(times[:, None], 3)
    )


def table_of(path: Path) -> list[dict[str, str]]:
    with open(path) as file:
        return list(csv.DictReader(file))


def made(folder: Path) -> Path:
    """Write a small set without images and return the folder of sets."""
    rig, truth = small_truth()
    volume = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    write_set(MadeSet("small", "a small set", "a test", 3, rig, truth, 100.0, 1e-3, volume, 0.015), folder)
    return folder


def on_set(folder: Path, limit_s: float = 30.0, twice: bool = False) -> OnSet:
    job = BenchmarkJob(made(folder / "data"), folder / "work", folder / "cache", limit_s, 1, twice)
    pythons = dict.fromkeys(("shifted", "nothing", "slow", "crash", "silent", "nonsense", "not_a_number"), PYTHON)
    return OnSet(
        "small", job, {**pythons, "once": PYTHON, "exact": PYTHON}, {"gone": "cannot be installed: no wheel"}
    )


@pytest.fixture(scope="module")
def where(tmp_path_factory) -> OnSet:
    return on_set(tmp_path_factory.mktemp("benchmark"))


def test_the_truth_shifted_by_1_mm_scores_1_mm(where, tmp_path):
    (row,) = where.rows_of(planted("shifted", tmp_path))
    assert row.error == ""
    assert row.scores["position_rms"].value == pytest.approx(1e-3, rel=1e-9)
    assert row.scores["ospa"].value == pytest.approx(1e-3, rel=1e-9)
    assert row.scores["position_max"].value == pytest.approx(1e-3, rel=1e-9)
    assert row.scores["completeness"].value == 1.0
    assert row.scores["ghosts_per_frame"].value == 0.0


def test_nothing_scores_completeness_0_and_the_cut_off(where, tmp_path):
    (row,) = where.rows_of(planted("nothing", tmp_path))
    assert row.error == ""
    assert row.scores["completeness"].value == 0.0
    assert row.scores["ospa"].value == pytest.approx(0.01)
    assert "position_rms" not in row.scores


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("crash", "exit code 1: ValueError: the lens fell off"),
        ("silent", "no such file"),
        ("nonsense", "row 2: frame 99; the set has 0 to 11"),
        ("not_a_number", "row 2"),
    ],
)
def test_what_goes_wrong_is_told_in_one_line_and_scored_as_nothing_found(where, tmp_path, name, told):
    (row,) = where.rows_of(planted(name, tmp_path))
    assert told in row.error
    assert "\n" not in row.error
    assert row.scores["completeness"].value == 0.0
    assert row.scores["ospa"].value == pytest.approx(0.01)


def test_a_slow_one_is_cut_off_at_the_limit(tmp_path):
    (row,) = on_set(tmp_path, limit_s=0.5).rows_of(planted("slow", tmp_path))
    assert row.error == "cut off at the limit of 0.5 s"
    assert row.scores["completeness"].value == 0.0


def _lives(status):
    try:
        return "State:\tZ" not in status.read_text()
    except OSError:
        return False


def test_children_of_one_that_is_cut_off_end_too(tmp_path):
    code = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "open('pid', 'w').write(str(child.pid))\ntime.sleep(60)\n"
    )
    done = execute([str(PYTHON), "-c", code], {}, tmp_path, 3.0)
    assert "cut off" in done.error
    status = Path(f"/proc/{(tmp_path / 'pid').read_text()}/status")
    until = time.monotonic() + 60  # a killed process ends when it is given the processor
    while _lives(status) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _lives(status)


def test_what_runs_is_ended_when_the_run_is_stopped(tmp_path):
    stopped = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        code = "open('begun', 'w').close()\nimport time\ntime.sleep(600)\n"
        running = pool.submit(execute, [str(PYTHON), "-S", "-c", code], {}, tmp_path, 300.0, stopped)
        until = time.monotonic() + 60
        while not (tmp_path / "begun").exists() and time.monotonic() < until:
            time.sleep(0.02)
        stopped.set()
        done = running.result(timeout=60)
    assert done.error == "stopped"
    assert execute([str(PYTHON), "-S", "-c", "import time; time.sleep(600)"], {}, tmp_path, 300.0, stopped).error


@pytest.mark.parametrize("workers", [1, 4])
def test_entrants_side_by_side_give_the_rows_of_one_after_the_other(tmp_path, monkeypatch, workers):
    one = on_set(tmp_path)
    # the borrower stands first: it is run after the one whose image points it gets
    exact = planted("exact", tmp_path, "matched")
    borrower = exact.model_copy(update={"name": "shifted", "detections_of": "exact"})
    entrants = [borrower, planted("crash", tmp_path), planted("nothing", tmp_path), exact]
    monkeypatch.setattr(
        "scenarios.studies.benchmark.benchmark.python_of", lambda entrant, _: one.pythons[entrant.name]
    )
    monkeypatch.setattr("scenarios.studies.benchmark.benchmark.make_set", lambda *_: None)
    job = dataclasses.replace(one.job, workers=workers)
    steps: list[int] = []
    small = SetFile(Path("small.toml"))
    monkeypatch.setattr("scenarios.studies.benchmark.benchmark.row_key", lambda *_: "key")
    found = run_benchmark([small], entrants, seeds.given("a"), job, lambda done, _: steps.append(done))
    assert [row.entrant for row in found.rows] == ["shifted", "crash", "nothing", "exact"]
    assert [row.scores["completeness"].value for row in found.rows] == [1.0, 0.0, 0.0, 1.0]
    assert [bool(row.error) for row in found.rows] == [False, True, False, False]
    assert steps == list(range(1, 10))


def test_memory_is_that_of_the_entrant_alone(tmp_path):
    held = np.ones(1 << 27, np.uint8)  # 134 MB of this process are none of it
    little = execute([str(PYTHON), "-S", "-c", "import time; time.sleep(0.3)"], {}, tmp_path, 30.0)
    much = execute(
        [str(PYTHON), "-S", "-c", "import time; b = b'1' * (1 << 27); time.sleep(0.3)"], {}, tmp_path, 30.0
    )
    assert held.any()
    if little.peak_mb is None:
        pytest.skip("this operating system does not say how much memory a process held")
    assert little.peak_mb < 100.0
    assert much.peak_mb == pytest.approx(128 + little.peak_mb, rel=0.2)


def test_one_that_cannot_be_installed_stands_in_the_table_with_the_reason(where, tmp_path):
    (row,) = where.rows_of(Entrant(name="gone", title="gone", adapter="gone.py", tables=("images",)))
    assert row.error == "cannot be installed: no wheel"
    assert row.scores["completeness"].value == 0.0


def test_an_environment_that_cannot_be_built_says_why_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("venv.create", lambda folder, with_pip: _fake_python(folder))
    entrant = Entrant(name="x", title="x", adapter="x.py", tables=("images",), requirements=("no-such-package==1",))
    with pytest.raises(EnvironmentFailed, match=r"cannot be installed: ERROR: No matching distribution"):
        python_of(entrant, tmp_path)
    assert list((tmp_path / "environments").iterdir()) == []


def _fake_python(folder: Path) -> None:
    (folder / "bin").mkdir(parents=True)
    path = folder / "bin" / "python"
    path.write_text("#!/bin/sh\necho 'ERROR: No matching distribution found for no-such-package==1' >&2\nexit 1\n")
    path.chmod(0o755)


def test_figures_that_differ_the_second_time_are_told(tmp_path):
    (row,) = on_set(tmp_path, twice=True).rows_of(planted("once", tmp_path))
    assert row.again == ""  # neither point is near a marker: the same figures
    (row,) = on_set(tmp_path, twice=True).rows_of(planted("shifted", tmp_path))
    assert row.again == ""
    found = dataclasses.replace(row, again="ospa 1 and 2")
    assert Benchmarked((found,), {}, {}, {}).failures == [
        "shifted on small (images): not the same twice: ospa 1 and 2"
    ]


def test_matches_are_given_from_the_truth_and_scored_by_the_same_code(where, tmp_path):
    (row,) = where.rows_of(planted("exact", tmp_path, "matched"))
    assert row.error == ""
    assert row.scores["position_rms"].value == pytest.approx(0.0, abs=1e-12)
    assert row.scores["completeness"].value == 1.0


def test_one_without_detections_of_its_own_gets_the_others(where, tmp_path):
    exact = planted("exact", tmp_path, "matched")
    borrower = exact.model_copy(update={"name": "shifted", "detections_of": "exact"})
    where.rows_of(exact)
    (row,) = where.rows_of(borrower)
    assert row.scores["completeness"].value == 1.0
    failed = borrower.model_copy(update={"detections_of": "crash"})
    (row,) = where.rows_of(failed)
    assert row.error == "no image points of crash: it did not run"


def test_ospa_is_that_of_the_paper():
    _, truth = small_truth()
    # one marker missed, one 3 mm off, one ghost far away, in every frame
    xyz = np.array(truth.xyz)
    xyz[:, 0] = (0.4, -0.4, 0.4)
    xyz[:, 1, 0] += 0.003
    frame = np.repeat(np.arange(FRAMES), MARKERS)
    found = score_found(FoundPoints(frame, xyz.reshape(-1, 3)), truth, 1.0)
    expected = np.sqrt((0.003**2 + 0.01**2) / MARKERS)
    assert found["ospa"].value == pytest.approx(expected, rel=1e-9)
    assert found["completeness"].value == pytest.approx(0.8)
    assert found["ghosts_per_frame"].value == 1.0
    # two ghosts more: seven points for five markers
    more = np.concatenate([xyz, np.full((FRAMES, 1, 3), 0.45), np.full((FRAMES, 1, 3), -0.45)], axis=1)
    found = score_found(FoundPoints(np.repeat(np.arange(FRAMES), 7), more.reshape(-1, 3)), truth, 1.0)
    assert found["ospa"].value == pytest.approx(np.sqrt((0.003**2 + 3 * 0.01**2) / 7), rel=1e-9)


def test_image_points_are_matched_one_to_one_within_the_disc(tmp_path):
    _, truth = small_truth()
    rows = ["camera,frame,u,v"]
    (u0, v0), (u1, v1) = truth.image_xy_px[0, 0, 0], truth.image_xy_px[0, 1, 0]
    # nearer one wins, 2.9 px is inside of a disc of 6 px and 3.1 px outside
    rows += [f"c0,0,{u0 + 0.5},{v0}", f"c0,0,{u0 + 0.1},{v0}", f"c0,0,{u1 + 2.9},{v1}", f"c1,0,{u0 + 300},{v0}"]
    (tmp_path / "d.csv").write_text("\n".join(rows) + "\n")
    assert match_detections(tmp_path / "d.csv", truth, tmp_path / "m.csv") == 2
    found = table_of(tmp_path / "m.csv")
    assert [(row["target"], float(row["u"])) for row in found] == [("0", u0 + 0.1), ("1", u1 + 2.9)]
    rows[3] = f"c0,0,{u1 + 3.1},{v1}"
    (tmp_path / "d.csv").write_text("\n".join(rows) + "\n")
    assert match_detections(tmp_path / "d.csv", truth, tmp_path / "m.csv") == 1


def test_stated_covariances_stay_with_their_image_points(tmp_path):
    _, truth = small_truth()
    rows = ["camera,frame,u,v,var_u,cov_uv,var_v", "c0,0,-50,-50,9,9,9"]
    rows += [f"c0,0,{u},{v},0.{k + 1},0.0{k + 1},0.5" for k, (u, v) in enumerate(truth.image_xy_px[0, ::-1, 0])]
    (tmp_path / "d.csv").write_text("\n".join(rows) + "\n")
    assert match_detections(tmp_path / "d.csv", truth, tmp_path / "m.csv") == MARKERS
    found = {row["target"]: (row["var_u"], row["cov_uv"], row["var_v"]) for row in table_of(tmp_path / "m.csv")}
    assert found == {str(MARKERS - 1 - k): (f"0.{k + 1}", f"0.0{k + 1}", "0.5") for k in range(MARKERS)}


def test_a_written_set_is_read_back_and_its_cameras_are_opencvs(tmp_path):
    made(tmp_path)
    _, truth = small_truth()
    read = read_set_truth(tmp_path / "truth" / "small")
    for name in ("time_ns", "xyz", "visible", "image_xy_px", "diameter_px"):
        np.testing.assert_array_equal(getattr(read, name), getattr(truth, name))
    assert read_about(tmp_path / "small" / "dataset.json").marker_diameter_px == 6.0
    cameras = json.loads((tmp_path / "small" / "cameras.json").read_text())["cameras"]
    table = table_of(tmp_path / "small" / "calibration" / "points.csv")
    for one in cameras:
        rows = [row for row in table if row["camera"] == one["name"]]
        points = np.array([[float(row[k]) for k in "xyz"] for row in rows])
        images = np.array([[float(row[k]) for k in "uv"] for row in rows])
        matrix = np.array([[one["fx"], 0, one["cx"]], [0, one["fy"], one["cy"]], [0, 0, 1]])
        lens = np.array([one[key] for key in ("k1", "k2", "p1", "p2", "k3")])
        rotation = cv2.Rodrigues(np.array(one["R"]))[0]
        projected = cv2.projectPoints(points, rotation, np.array(one["t"]), matrix, lens)[0][:, 0]
        # 0.02 px an axis, of some 300 points: 4 sigma of the rms
        assert np.sqrt(np.mean((projected - images) ** 2)) == pytest.approx(0.02, rel=0.15)


def test_the_twins_set_shows_markers_where_its_truth_says(tmp_path):
    (one,) = set_files(("pair_10",))
    make_set(one, seeds.given("a test"), tmp_path, 1, frames=2)
    truth = read_set_truth(tmp_path / "truth" / "pair_10")
    cameras = json.loads((tmp_path / "pair_10" / "cameras.json").read_text())["cameras"]
    off = []
    for c, one_camera in enumerate(cameras):
        image = cv2.imread(
            str(tmp_path / "pair_10" / "images" / truth.cameras[c] / "000001.png"), cv2.IMREAD_GRAYSCALE
        )
        matrix = np.array(
            [[one_camera["fx"], 0, one_camera["cx"]], [0, one_camera["fy"], one_camera["cy"]], [0, 0, 1]]
        )
        lens = np.array([one_camera[key] for key in ("k1", "k2", "p1", "p2", "k3")])
        rotation = cv2.Rodrigues(np.array(one_camera["R"]))[0]
        places = cv2.projectPoints(truth.xyz[1], rotation, np.array(one_camera["t"]), matrix, lens)[0][:, 0]
        light = np.clip(image.astype(float) - 20, 0, None)
        for place in places:
            if np.sort(np.linalg.norm(places - place, axis=1))[1] < 24:
                continue
            x, y = np.round(place).astype(int)
            window = light[y - 8 : y + 9, x - 8 : x + 9]
            rows, columns = np.mgrid[y - 8 : y + 9, x - 8 : x + 9]
            off.append([np.average(columns, weights=window) - place[0], np.average(rows, weights=window) - place[1]])
    assert len(off) >= 8
    # body shake 0.03 px, noise of a centroid 0.03 px
    assert np.sqrt(np.mean(np.square(off))) < 0.1


def test_seeds_follow_from_the_passphrase_by_sha256():
    # printf 'abc/cloud_50' | sha256sum
    import hashlib

    word = int.from_bytes(hashlib.sha256(b"abc/cloud_50").digest()[:4], "big") >> 1
    assert seeds.given("abc").seed("cloud_50") == word < 2**31
    assert seeds.digest("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert seeds.fresh().text != seeds.fresh().text


def test_a_published_passphrase_must_be_the_committed_one(tmp_path):
    path = tmp_path / "rounds.toml"
    path.write_text(f'[[round]]\ncommitment_sha256 = "{seeds.digest("a")}"\npassphrase = "a"\n')
    told = seeds.published(path)
    assert told is not None
    assert (told.text, told.sets) == ("a", ())
    path.write_text(
        f'[[round]]\ncommitment_sha256 = "{seeds.digest("a")}"\npassphrase = "a"\nsets = ["actor", "ring_8"]\n'
    )
    told = seeds.published(path)
    assert told is not None
    assert told.sets == ("actor", "ring_8")
    path.write_text(f'[[round]]\ncommitment_sha256 = "{seeds.digest("a")}"\npassphrase = "b"\n')
    with pytest.raises(InputError, match="round 1: SHA-256"):
        seeds.published(path)
    path.write_text(f'[[round]]\ncommitment_sha256 = "{seeds.digest("a")}"\n')
    assert seeds.published(path) is None


def test_a_mean_of_sets_has_an_interval_of_all_their_blocks():
    rng = np.random.default_rng(2)
    low, high = mean_interval(
        [Score(1.0, 40, sums=tuple(rng.normal(1, 0.1, 40) ** 2), weights=(1.0,) * 40) for _ in range(4)]
    )
    # the mean of 160 squares of spread 0.2, and half of that of its root
    assert high - low == pytest.approx(2 * 1.96 * 0.1 / np.sqrt(160), rel=0.25)


def test_the_page_names_every_entrant_and_every_failure(where, tmp_path):
    entrants = [planted("shifted", tmp_path), planted("crash", tmp_path)]
    rows = tuple(row for one in entrants for row in where.rows_of(one))
    found = Benchmarked(
        rows, {"small": read_about(where.job.data / "small" / "dataset.json")}, {"far": "no Mitsuba"}, {}
    )
    document = document_of(found, entrants, seeds.given("abc"), where.job)
    assert [row.entrant for row in overall(document, "images")] == ["shifted", "crash"]
    assert overall(document, "images")[1].failed == 1
    write_result(document, tmp_path / "result.json")
    assert json.loads((tmp_path / "result.json").read_text())["rows"][0]["metrics"]["completeness"]["value"] == 1.0
    write_leaderboard(tmp_path / "page.html", document)
    page = (tmp_path / "page.html").read_text()
    for words in ("shifted", "the lens fell off", "left out: no Mitsuba", "OSPA", seeds.digest("abc")):
        assert words in page
    write_leaderboard(tmp_path / "again.html", document)
    assert (tmp_path / "again.html").read_bytes() == (tmp_path / "page.html").read_bytes()


def test_the_projects_own_files_are_whole():
    entrants = read_entrants()
    assert [one.name for one in entrants] == ["mosca", "openptv", "opencv", "trackpy", "aniposelib", "pose2sim"]
    sets = set_files()
    assert len([one for one in sets if not one.by_mitsuba]) == 8
    assert len([one for one in sets if one.by_mitsuba]) == 2
    for one in entrants:
        assert set(one.tried) <= set(one.settings)
        for made_set in sets:
            settings = settings_for(one, made_set.name)
            assert set(settings) == set(one.settings)
            assert all(settings[key] in [one.settings[key], *values] for key, values in one.tried.items())
    assert settings_for(entrants[0], "cloud_50") == {}


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["--set", "nowhere"], "--set nowhere: no such data set; there are actor"),
        (["--entrant", "nobody"], "--entrant nobody: no such entrant; there are mosca"),
        (["--fresh", "--passphrase", "a"], "--fresh and --passphrase exclude each other"),
        (["--passphrase", "tuning"], "settings were tuned on the seeds of 'tuning'"),
        (["--passphrase", ""], "settings were tuned"),
        (["--tune", "--fresh"], "--tune and --fresh or --passphrase"),
        (["--tune", "--twice"], "--tune goes with"),
        (["--export", "x", "--twice"], "--export writes data sets"),
    ],
)
def test_wrong_options_are_told_in_one_line(given, told):
    done = CliRunner().invoke(cli, ["benchmark", *given])
    assert isinstance(done.exception, InputError)
    assert told in str(done.exception)
    assert "\n" not in str(done.exception)


def test_the_plain_command_runs_the_sets_of_the_published_round(tmp_path, monkeypatch):
    rounds = tmp_path / "rounds.toml"
    rounds.write_text(
        f'[[round]]\ncommitment_sha256 = "{seeds.digest("a")}"\npassphrase = "a"\nsets = ["actor", "ring_8"]\n'
    )
    published = seeds.published
    monkeypatch.setattr("scenarios.studies.benchmark.seeds.published", lambda: published(rounds))
    ran: list[list[str]] = []
    monkeypatch.setattr("scenarios.cli.benchmark._run", lambda sets, *_: ran.append([one.name for one in sets]))
    for given in ([], ["--set", "cloud_50"], ["--fresh"]):
        CliRunner().invoke(cli, ["benchmark", *given, "--out", str(tmp_path)])
    assert ran[0] == ["actor", "ring_8"]
    assert ran[1] == ["cloud_50"]
    assert len(ran[2]) == 10


def test_an_export_leaves_files_that_are_there_alone(tmp_path):
    (tmp_path / "actor").mkdir()
    done = CliRunner().invoke(cli, ["benchmark", "--export", str(tmp_path), "--passphrase", "a test"])
    assert "holds files already" in str(done.exception)
    assert (tmp_path / "actor").is_dir()


def test_wrong_tables_are_told_in_one_line(tmp_path):
    made(tmp_path)
    _, truth = small_truth()
    path = tmp_path / "p.csv"
    for text, told in (
        ("a,b\n", "first line"),
        ("frame,x,y,z\n0,1\n", "row 2: 2 values given, 4 wanted"),
        ("frame,x,y,z\n0.5,1,1,1\n", "row 2: frame = '0.5'"),
        ("frame,x,y,z\n-1,1,1,1\n", "row 2: frame -1; the set has 0 to 11"),
        ("frame,x,y,z\n" + "0,1,1,1\n" * 1101, "frame 0 has more than 1100 points"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=r"\S") as caught:
            read_found(path, truth)
        assert told in str(caught.value)
    path.write_text("camera,frame,u,v\nc9,0,1,1\n")
    with pytest.raises(InputError, match=r"camera 'c9'; the set has c0, c1, c2"):
        match_detections(path, truth, tmp_path / "m.csv")
    about = tmp_path / "small" / "dataset.json"
    about.write_text(about.read_text().replace('"frames": 12', '"frames": 0'))
    with pytest.raises(InputError, match="frames"):
        read_about(about)
    about.write_text("[1")
    with pytest.raises(InputError, match="no JSON"):
        read_about(about)
    images = tmp_path / "truth" / "small" / "images.csv"
    images.write_text("\n".join(images.read_text().splitlines()[:-1]) + "\n")
    with pytest.raises(InputError, match="one row for each frame, marker and camera"):
        read_set_truth(tmp_path / "truth" / "small")


@pytest.mark.slow
def test_the_real_entrants_give_the_same_twice(tmp_path):
    """Installs the peers: needs a package registry."""
    done = CliRunner().invoke(
        cli, ["benchmark", "--set", "pair_10", "--passphrase", "a test", "--twice", "--out", str(tmp_path / "out")]
    )
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert done.exit_code == 0, [row["error"] or row["again"] for row in document["rows"]]
    assert {row["entrant"] for row in document["rows"]} == {one.name for one in read_entrants()}
    # any of them finds nine of ten markers where correspondence is given
    for row in document["rows"]:
        if row["table"] == "matched":
            assert row["metrics"]["completeness"]["value"] > 0.9
