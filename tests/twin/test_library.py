"""The library of sensors and lenses: its values, their sources, and error messages."""

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.errors import InputError
from twin.cameras.library import FILES, Sourced, lens, lenses, sensor, sensors

ROOT = Path(__file__).parents[2]
GOOD = (FILES / "sensors.toml").read_text(encoding="utf-8")
GOOD_LENSES = (FILES / "lenses.toml").read_text(encoding="utf-8")


def test_the_cameras_that_the_papers_name():
    # tables 1 and 3 of the Mosca paper; the guide's T160
    expected = {
        "mosca_656": (656, 491, 100.0, "global"),
        "ardrone2_frontal": (1280, 720, 30.0, "rolling"),
        "ardrone2_vertical": (320, 240, 60.0, "rolling"),
        "vicon_t160": (4704, 3456, 120.0, "global"),
    }
    for name, values in expected.items():
        spec = sensor(name)
        assert (spec.width, spec.height, spec.max_frame_rate_hz, spec.shutter) == values
    megapixels = {name: spec.width * spec.height / 1e6 for name, spec in sensors().items()}
    assert any(2 <= value < 3 for value in megapixels.values())
    assert any(12 <= value < 13 for value in megapixels.values())
    assert 16 <= megapixels["vicon_t160"] < 17


@pytest.mark.parametrize(
    ("name", "snr_db", "range_db"),
    [("sony_imx249", 45.1, 73.0), ("sony_imx253", 40.3, 71.3), ("sony_imx535", 39.7, 69.8)],
)
def test_electrons_follow_from_the_published_decibels(name, snr_db, range_db):
    spec = sensor(name)
    # EMVA 1288: at saturation the shot noise alone is left, SNR = sqrt(capacity)
    assert 20 * np.log10(np.sqrt(spec.full_well_e)) == pytest.approx(snr_db, abs=0.05)
    # the threshold is the signal that equals its noise: e^2 = dark^2 + e
    threshold = max(np.roots([1.0, -1.0, -(spec.read_noise_e**2)]).real)
    assert 20 * np.log10(spec.full_well_e / threshold) == pytest.approx(range_db, abs=0.05)


@pytest.mark.parametrize("spec", [*sensors().values(), *lenses().values()], ids=lambda spec: spec.title)
def test_every_number_has_a_source_or_is_called_an_assumption(spec):
    numbers = {
        name for name in type(spec).model_fields
        if name not in Sourced.model_fields and getattr(spec, name) not in (None, 0.0)
    }  # fmt: skip
    documented = numbers - set(spec.assumed)
    # who has neither paper nor page assumes everything
    assert spec.urls or not documented or "Knyaz" in spec.source


@pytest.mark.parametrize(
    ("find", "name", "message"),
    [
        (sensor, "sony_imx17", "sensor 'sony_imx17' is unknown; did you mean 'sony_imx174'.*mosca_656"),
        (lens, "fa_8m", "lens 'fa_8m' is unknown; did you mean 'fa_8mm'"),
        (sensor, "", "sensor '' is unknown; There are mosca_656"),
    ],
)
def test_unknown_names_are_answered_with_what_there_is(find, name, message):
    with pytest.raises(InputError, match=message) as caught:
        find(name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("width = 656", "width = 0", r"\[mosca_656\]: key 'width': 0 given.*greater than 0"),
        ("bits = 8", "bits = 9", "bits.*9 given"),
        ('shutter = "global"', 'shutter = "rolling"', "row_time_s 0 given for a rolling shutter"),
        ("row_time_s = 45e-6", "row_time_s = 50e-6", "720 rows of 5e-05 s do not fit into a frame at 30 Hz"),
        ('"full_well_e", ', '"full_wel_e", ', "assumed names 'full_wel_e'.*did you mean 'full_well_e'"),
        ("https://easymanua", "easymanua", "urls"),
        ("full_well_e = 20000.0", "fullwell_e = 1.0", "unknown key 'fullwell_e'; did you mean 'full_well_e'"),
        ("[mosca_656]", "x = 1\n[mosca_656]", r"\[x\]: 1 given; a table is wanted"),
    ],
)
def test_faults_of_the_file_are_said_in_one_line(tmp_path, old, new, message):
    assert old in GOOD
    (tmp_path / "sensors.toml").write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        sensors(tmp_path)
    assert "sensors.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("f_number_max = 16.0", "f_number_max = 1.0", "f_number_max 1 is below f_number_min 2.4"),
        ("field_deg = 90.0\n", "", "field_deg is missing"),
    ],
)
def test_faults_of_a_lens_are_said_in_one_line(tmp_path, old, new, message):
    (tmp_path / "lenses.toml").write_text(GOOD_LENSES.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        lenses(tmp_path)


def what_it_says(folder: Path) -> str:
    """Read sensors; return the error's text, or nothing. Any other exception goes through."""
    try:
        sensors(folder)
    except InputError as error:
        return str(error)
    return ""


@settings(max_examples=100, deadline=None)
@given(place=st.integers(0, len(GOOD) - 1), length=st.integers(0, 12), text=st.text(max_size=6))
def test_any_edit_gives_sensors_or_an_input_error(tmp_path_factory, place, length, text):
    folder = tmp_path_factory.mktemp("library")
    edited = GOOD[:place] + text + GOOD[place + length :]
    (folder / "sensors.toml").write_text(edited, encoding="utf-8", newline="")
    assert "\n" not in what_it_says(folder)


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=200))
def test_any_bytes_give_nothing_or_an_input_error(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("library")
    (folder / "sensors.toml").write_bytes(data)
    assert "\n" not in what_it_says(folder)


def test_looking_up_loads_nothing_heavy():
    code = (
        "import sys; from twin.cameras.library import sensors, lenses; sensors(); lenses(); "
        "print(sorted({'numba', 'mujoco', 'scipy', 'cv2', 'trimesh'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_install_has_the_files():
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = document["tool"]["setuptools"]["package-data"].get("twin", [])
    assert {FILES / "sensors.toml", FILES / "lenses.toml"} <= {
        path for pattern in patterns for path in (ROOT / "twin").glob(pattern)
    }
