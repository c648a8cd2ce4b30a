"""A run's result in a Rerun file, read back: colours on their scale, names, trails, plots, edges of the box."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps
from reports_examples import example_evidence, without_truth
from test_viewer import columns, rerun_chunk

from reports.evidence import ErrorTable, Evidence
from reports.viewer import RerunLog
from reports.viewer_colours import FALSE_POINT, Trails, coloured, scale_top
from reports.viewer_result import log_result

FRAMES, MARKERS = 40, 3
GHOST = 17
"""A row of the tracks that belongs to no marker."""


def evidence() -> Evidence:
    base = example_evidence(frames=FRAMES, markers=MARKERS)
    assert base.errors is not None
    rows = np.setdiff1d(np.arange(len(base.tracks)), [GHOST])
    kept = {name: getattr(base.errors, name)[rows] for name in ("frame", "time_s", "marker", "error_xyz_m")}
    return replace(base, errors=ErrorTable(**kept, sample=rows))


def written(path: Path, what: Evidence, limit_mm: float | None = None, scale: float = 1.0) -> Path:
    with RerunLog(path, what.rig, (what.working_space_center, scale * what.working_space_size)) as log:
        log_result(log, what, limit_mm)
    return path


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("rrd") / "run.rrd", evidence(), 0.3)


def rgb(packed: list[int]) -> np.ndarray:
    return np.array([[one >> 24 & 255, one >> 16 & 255, one >> 8 & 255] for one in packed])


def test_colours_are_the_errors_on_the_stated_scale(result: Path) -> None:
    what = evidence()
    assert what.errors is not None
    error_mm = np.full(len(what.tracks), np.nan)
    error_mm[what.errors.sample] = 1e3 * np.linalg.norm(what.errors.error_xyz_m, axis=1)
    (text,) = columns(result, "/legend", static=True)["TextDocument:text"][0]
    top = float(text.split("(green) to ")[1].split(" mm")[0])
    # 95 % of the errors lie on the scale, which is no more than a tenth longer than that
    share = np.mean(error_mm[np.isfinite(error_mm)] <= top)
    assert share >= 0.95 - 1 / len(error_mm)
    assert np.quantile(error_mm[np.isfinite(error_mm)], 0.95) > top / 1.1 - 1e-9
    points = columns(result, "/world/points")
    viridis = colormaps["viridis"]
    for frame in points["frame"]:
        rows = np.flatnonzero(what.tracks.frame == frame)
        wanted = 255 * viridis(0.12 + 0.88 * np.clip(error_mm[rows] / top, 0, 1))[:, :3]
        wanted[np.isnan(error_mm[rows])] = (204, 121, 167)
        np.testing.assert_allclose(rgb(points["Points3D:colors"][frame]), wanted, atol=4)  # 256 colours
        np.testing.assert_allclose(points["Points3D:positions"][frame], what.tracks.xyz[rows], atol=1e-6)


def test_points_have_names_and_radii_in_proportion_to_the_scene(result: Path, tmp_path: Path) -> None:
    what = evidence()
    points = columns(result, "/world/points")
    ghost_frame = int(what.tracks.frame[GHOST])
    for frame in (0, ghost_frame):
        rows = np.flatnonzero(what.tracks.frame == frame)
        ghost = f"{what.tracks.label[GHOST]}"
        assert points["Points3D:labels"][frame] == [
            ghost if row == GHOST else f"marker {int(what.tracks.track[row]):02d}" for row in rows
        ]
    (radius,) = points["Points3D:radii"][0]
    assert 0.002 < radius / np.linalg.norm(what.working_space_size) < 0.02
    (ten,) = columns(written(tmp_path / "large.rrd", what, None, 10.0), "/world/points")["Points3D:radii"][0]
    assert ten == pytest.approx(10 * radius, rel=1e-5)


def test_the_working_space_is_its_edges(result: Path) -> None:
    from rerun.components import FillMode

    box = columns(result, "/world/working_space", static=True)
    assert box["Boxes3D:fill_mode"][0] == [FillMode.MajorWireframe.value]
    np.testing.assert_allclose(box["Boxes3D:half_sizes"][0][0], evidence().working_space_size / 2)


def test_errors_are_plots_on_the_timeline(result: Path) -> None:
    what = evidence()
    assert what.errors is not None
    error_mm = 1e3 * np.linalg.norm(what.errors.error_xyz_m, axis=1)
    by_frame = [error_mm[what.errors.frame == frame] for frame in range(FRAMES)]
    for name, wanted in (
        ("error/rms", [np.sqrt(np.mean(one**2)) for one in by_frame]),
        ("error/largest", [one.max() for one in by_frame]),
    ):
        plot = columns(result, f"/plots/{name}")
        assert plot["frame"] == list(range(FRAMES))
        assert plot["session"] == [10_000_000 * k for k in range(FRAMES)]
        np.testing.assert_allclose(np.ravel(plot["Scalars:scalars"]), wanted)
    own = columns(result, r"/plots/markers/marker\ 01")
    rows = what.errors.marker == 1
    np.testing.assert_allclose(np.ravel(own["Scalars:scalars"]), error_mm[rows])
    assert own["frame"] == what.errors.frame[rows].tolist()
    limit = columns(result, "/plots/error/limit")
    assert limit["frame"] == [0, FRAMES - 1]
    assert np.ravel(limit["Scalars:scalars"]).tolist() == [0.3, 0.3]


def test_trails_are_the_last_half_second_and_end_at_the_point(result: Path) -> None:
    what = evidence()
    trails = columns(result, "/world/trails")["LineStrips3D:strips"]
    for frame in (0, 5, FRAMES - 1):
        rows = np.flatnonzero(what.tracks.frame == frame)
        for strip, row in zip(trails[frame], rows, strict=True):
            np.testing.assert_allclose(strip[-1], what.tracks.xyz[row], atol=1e-6)
            own = what.tracks.xyz[what.tracks.track == what.tracks.track[row]]
            away = np.linalg.norm(np.array(strip)[:, None] - own[None], axis=2).min(axis=1)
            assert away.max() < 1e-6


def test_a_trail_is_short_and_cut_by_a_gap() -> None:
    trails = Trails()
    for k in range(200):
        (path,) = trails.step(10_000_000 * k, np.array([[0.01 * k, 0.0, 0.0]]), np.array([4]))
        assert path[-1, 0] == pytest.approx(0.01 * k)
        assert np.ptp(path[:, 0]) <= 0.5 + 1e-9
        assert len(path) <= 12
    assert np.ptp(path[:, 0]) > 0.4
    assert trails.step(2_000_000_000, np.empty((0, 3)), np.empty(0, int)) == []
    (path,) = trails.step(2_010_000_000, np.ones((1, 3)), np.array([4]))
    assert path.tolist() == [[1, 1, 1]]


def test_without_a_truth_colours_are_the_stated_deviation(tmp_path: Path) -> None:
    what = without_truth(evidence())
    path = written(tmp_path / "run.rrd", what)
    (text,) = columns(path, "/legend", static=True)["TextDocument:text"][0]
    assert "stated standard deviation" in text
    assert "No truth" in text
    # covariances of 1e-8 m^2 an axis: sqrt(3) x 0.1 mm
    np.testing.assert_allclose(np.ravel(columns(path, "/plots/sigma/rms")["Scalars:scalars"]), 0.1 * np.sqrt(3))
    assert {chunk.entity_path for chunk in rerun_chunk.RrdReader(path).store().stream().to_chunks()}.isdisjoint(
        {"/plots/error/rms"}
    )


def test_live_points_are_coloured_by_deviation_on_one_scale(tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    with RerunLog(path, evidence().rig) as log:
        for frame, sigma in enumerate((1e-4, 2e-4, 9e-4)):
            log.log_step(frame, frame, points_xyz=np.ones((1, 3)), track_ids=np.array([5]), sigma_m=np.array([sigma]))
    (text,) = columns(path, "/legend", static=True)["TextDocument:text"][0]
    assert "to 0.2 mm" in text  # twice the first
    shown = [rgb(one)[0].tolist() for one in columns(path, "/world/points")["Points3D:colors"]]
    yellow = (255 * np.array(colormaps["viridis"](1.0)[:3])).round()
    assert shown[1] == shown[2] == yellow.tolist()
    assert shown[0] != shown[1]


@pytest.mark.parametrize(
    ("values", "top"),
    [([0.1] * 20, 0.1), ([0.1234] * 20, 0.13), ([np.nan], 1.0), ([], 1.0), ([0.0], 1.0), ([17.1], 18.0)],
)
def test_a_scale_ends_at_two_digits_above_95_per_cent(values: list[float], top: float) -> None:
    assert scale_top(np.array(values)) == pytest.approx(top)


def test_a_false_point_has_a_colour_of_its_own() -> None:
    assert coloured(np.array([np.nan, 5.0]), 1.0)[0].tolist() == list(FALSE_POINT)
