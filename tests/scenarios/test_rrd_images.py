"""As many images in a Rerun recording as are asked for: of a run evenly, of a live run by the second."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tiny_scenario import write_tiny

from scenarios.cli.main import cli

chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk 0.41 or later is not installed")


def frames_of(path: Path, end: str) -> dict[str, list[int]]:
    """Return entity that ends so -> the frames at which something was logged there, ascending."""
    found: dict[str, list[int]] = {}
    for one in chunk.RrdReader(path).store().stream().to_chunks():
        if one.entity_path.endswith(end) and not one.is_static:
            batch = one.to_record_batch()
            found.setdefault(one.entity_path, []).extend(batch.column("frame").to_pylist())
    return {name: sorted(frames) for name, frames in found.items()}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("rrd"), duration_s=0.3)


def made(tiny: Path, *words: str) -> Path:
    out = tiny.parent / "run"
    result = CliRunner().invoke(cli, ["run", str(tiny), "--out", str(out), "--rrd", *words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return out / "run.rrd"


def test_a_run_keeps_so_many_images_evenly_and_counts_of_all(tiny: Path) -> None:
    path = made(tiny, "--images", "4")
    images = frames_of(path, "/image")
    pulses = len(next(iter(frames_of(path, "/world/truth").values())))
    wanted = np.linspace(0, pulses - 1, 4).round().astype(int).tolist()
    assert images
    assert all(frames == wanted for frames in images.values())
    assert all(frames == wanted for frames in frames_of(path, "/image/detections").values())
    counts = {name: frames for name, frames in frames_of(path, "").items() if name.startswith("/plots/detections/")}
    assert len(counts) == len(images)
    assert all(frames == list(range(pulses)) for frames in counts.values())
    assert frames_of(path, "/world/points")["/world/points"] == list(range(pulses))
    assert "/plots/error/rms" in frames_of(path, "/rms")


def test_all_and_none_are_numbers_too(tiny: Path) -> None:
    path = made(tiny, "--images", "all")
    (pulses,) = frames_of(path, "/world/truth").values()
    assert all(frames == pulses for frames in frames_of(path, "/image").values())
    assert frames_of(made(tiny, "--images", "0"), "/image") == {}


@pytest.mark.parametrize("words", [("--images", "few"), ("--images", "-1"), ("--images", "1.5")])
def test_other_words_are_refused(tiny: Path, words: tuple[str, ...]) -> None:
    result = CliRunner().invoke(cli, ["run", str(tiny), "--rrd", *words])
    assert result.exit_code == 2
    assert "allowed are 'all' and whole numbers" in result.output


def test_images_without_a_recording_are_refused(tiny: Path) -> None:
    for verb in ("run", "live"):
        result = CliRunner().invoke(cli, [verb, str(tiny), "--images", "3"])
        assert "--images" in str(result.exception)
        assert "add --rrd" in str(result.exception)


def test_a_live_run_shows_images_by_its_frames_clock(tiny: Path) -> None:
    path = tiny.parent / "live.rrd"
    words = ["live", str(tiny), "--rrd", str(path), "--images", "10"]
    result = CliRunner().invoke(cli, words, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    images = frames_of(path, "/image")
    assert images
    for frames in images.values():
        # 10 a second of a take of 0.3 s; sets that a slow machine drops move them on
        assert 1 <= len(frames) <= 4
        assert len(set(frames)) == len(frames)
    assert len(frames_of(path, "/world/points")["/world/points"]) > len(next(iter(images.values())))
    assert "/world/trails" in frames_of(path, "/trails")
    assert "/plots/sigma/rms" in frames_of(path, "/rms")
