"""The notebooks run from top to bottom in an empty folder, and print what their words say."""

import os
import re
import subprocess
import sys

import pytest
from doc_pages import DOCS, ROOT
from scipy.stats import chi2


def printed(name, folder):
    """Run a notebook as a script; return what it prints."""
    bare = {"PATH": os.environ["PATH"], "HOME": str(folder), "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, DOCS / "notebooks" / f"{name}.py"],
        cwd=folder, env=bare | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, timeout=1800,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_cameras_are_placed(tmp_path):
    found = [float(one) for one in re.findall(r"([\d.]+) mm", printed("place_cameras", tmp_path))]
    # by the number of rays alone, sqrt(3 / 8) = 0.61; a little less, since three cameras also see from fewer sides
    assert 0.4 < found[2] / found[0] < 0.61
    assert (tmp_path / "sigma.png").is_file()


@pytest.mark.slow
def test_tracks_are_read_and_cameras_calibrated_in_one_lab(tmp_path):
    text = printed("read_tracks", tmp_path)
    assert re.search(r"^8 tracks, 800 samples", text, re.MULTILINE)
    nees, inside = re.search(r"mean ([\d.]+), ([\d.]+)% inside", text).groups()
    # half way to an error of a factor of two of the standard deviation; with twice the variance 73 % are inside
    assert 1.5 < float(nees) < 6.0
    assert float(inside) > 100.0 * chi2.cdf(0.5 * chi2.ppf(0.95, 3), 3)
    text = printed("calibrate_folder", tmp_path)
    assert 0.7 < float(re.search(r"sigma0 ([\d.]+)", text)[1]) < 1.5
    off = [(float(one), float(other)) for one, other in re.findall(r"([\d.]+) mm off, stated ([\d.]+) mm", text)]
    assert len(off) == 4
    # squared errors over stated variances of 12 coordinates: below their 99.9 % quantile, 32.9
    assert sum(3 * (away / stated) ** 2 for away, stated in off) < 32.9
    assert {"errors.png", "residuals.png", "rig.toml"} <= {path.name for path in tmp_path.iterdir()}
