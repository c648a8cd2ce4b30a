"""mosca twin fit, run --lab and twin predict on a small lab that a twin with other settings plays."""

import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import mosca, refusal
from scipy.special import ndtri

from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate
from scenarios.lab_twin.apply import bounded, drawn, load_with_lab, stepped
from scenarios.lab_twin.lab_file import lab_document, read_lab, write_lab
from scenarios.lab_twin.predict import predicted
from scenarios.lab_twin.still import mean_of_rounded_dn

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies"))
import lab_twin as study

ANY_SIGMA_M = 1.0
"""No point is stated to be less certain: all lengths count, also those of a lab that shakes much."""
TELLING = ("errors.full_well_e", "errors.read_noise_e", "errors.psf_sigma_px", "errors.marker_signal", "sensor.prnu")


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Return the hidden settings, the folder of a lab, and the fit's exit and output."""
    folder = tmp_path_factory.mktemp("lab")
    tables = study.hidden_settings(3)
    recordings = study.record_lab(tables, folder, still=60, moving=60)
    given = [text for text in recordings if not text.startswith("moving:")]
    return tables, folder, mosca("twin", "fit", *given, "--rig", "rig.toml", "--out", "lab.toml", cwd=folder)


def test_the_hidden_settings_come_back(lab):
    tables, folder, done = lab
    assert done.returncode == 0, done.stderr
    fitted = read_lab(folder / "lab.toml")
    for one in fitted.estimate:
        truth = study.truth_of(tables, one.camera, one.key)
        if one.key in TELLING:
            assert abs(one.value - truth) < 5.0 * one.sigma, one
            assert one.low <= one.value <= one.high
    assert {one.key for one in fitted.estimate} >= set(TELLING)
    # a rig file is a path from the lab file
    assert fitted.cameras.rig == str(folder / "rig.toml")


def test_what_was_not_recorded_is_named(lab):
    _tables, folder, done = lab
    assert "needs 30 frame sets or more of moving targets that several cameras see: moving:FOLDER" in done.stdout
    assert "needs a lit recording with saturated pixels" in done.stdout
    lacking = {one.key for one in read_lab(folder / "lab.toml").not_told}
    assert {"errors.trigger_jitter_s", "timing.delay_s", "timing.row_time_s"} <= lacking


@pytest.mark.slow
def test_a_scenario_runs_with_the_labs_cameras(lab):
    _tables, folder, _done = lab
    plan = folder / "plan.toml"
    plan.write_text(study.plan_text(4, 4.0))
    spec = load_with_lab(plan, folder / "lab.toml", ("capture.duration_s=1.2",))
    fitted = read_lab(folder / "lab.toml")
    assert spec.capture.duration_s == 1.2
    assert spec.cameras.rig == fitted.cameras.rig
    assert [one.name for one in spec.camera] == ["cam1", "cam2", "cam3"]
    assert spec.camera[0].errors.read_noise_e == fitted.camera[0].errors.read_noise_e
    done = mosca("twin", "predict", "plan.toml", "--lab", "lab.toml", "--draws", "3", "--out", "new", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "length_rms: " in done.stdout
    assert "95 %" in done.stdout
    assert "draws of the lab's parameters" in (folder / "new" / "record.json").read_text()


@pytest.mark.slow
def test_what_is_left_out_of_the_fit_shows_in_the_prediction(lab):
    """The lab shakes by 0.3 px; of a lab file without that key the prediction is another one.

    10 s: in 2 s of film the length error scatters by a third, by the way of the wand alone.
    """
    tables, folder, _done = lab
    shaken = [{**one, "errors": {**one["errors"], "body_px": 0.3}} for one in tables]
    (measured,) = study.measured_lengths(shaken, 7, 10.0, 1, ANY_SIGMA_M)
    (folder / "a").mkdir(exist_ok=True)
    names = [one["name"] for one in tables]
    told = [ParameterEstimate(name, "errors.body_px", 0.3, 0.01, "planted") for name in names]
    predictions = []
    for kept in (told, [NotTold(name, "errors.body_px", "left out") for name in names]):
        write_lab(folder / "a" / "lab.toml", lab_document(kept, (), "../rig.toml"))
        predictions.append(study.predicted_length(folder / "a", 8, 10.0, 3, ANY_SIGMA_M))
    whole, without = predictions
    assert whole.value == pytest.approx(measured, rel=0.35)
    assert without.high < measured
    # twice the noise that the file states is outside what it predicts
    loud = [{**one, "errors": {**one["errors"], "body_px": 0.6}} for one in shaken]
    (louder,) = study.measured_lengths(loud, 7, 10.0, 1, ANY_SIGMA_M)
    assert louder > 1.5 * whole.value


def test_draws_follow_the_standard_deviations(tmp_path):
    told = [
        ParameterEstimate("cam1", "errors.read_noise_e", 10.0, 0.5, "x"),
        ParameterEstimate("cam1", "timing.delay_s", 1e-5, 1e-4, "x"),
        ParameterEstimate("cam1", "mount.vibration_hz[0]", 8.0, 0.0, "x"),
        ParameterEstimate("cam1", "mount.vibration_hz[1]", 20.0, 0.0, "x"),
        ParameterEstimate("cam1", "errors.bits", 12, 0.0, "x"),
    ]
    write_lab(tmp_path / "lab.toml", lab_document(told, ("dark:a",), None))
    fitted = read_lab(tmp_path / "lab.toml")
    assert fitted.camera[0].mount.vibration_hz == (8.0, 20.0)
    made = [drawn(fitted, np.random.default_rng(k)).camera[0] for k in range(300)]
    noise = np.array([one.errors.read_noise_e for one in made])
    delay = np.array([one.timing.delay_s for one in made])
    assert noise.mean() == pytest.approx(10.0, abs=0.1)
    assert noise.std() == pytest.approx(0.5, rel=0.15)
    assert delay.std() == pytest.approx(1e-4, rel=0.15)
    assert delay.min() < 0.0
    assert {one.errors.bits for one in made} == {12}
    assert bounded("errors.body_px", 0.1, -0.5) == 0.5
    assert bounded("errors.full_well_e", 1e4, 1.0) == 500.0
    assert bounded("delivery.dropped_share", 0.0, -0.01) == 0.01


def test_a_root_near_zero_is_drawn_as_its_variance():
    """A variance of 0 +- 4 (root: 0 +- 2): half-normal, 4 sqrt(2 / pi) in the mean, not 4 as the root's square."""
    normal = np.random.default_rng(2).standard_normal(20_000)
    square = np.array([stepped("errors.trigger_jitter_s", 0.0, 2.0, z) ** 2 for z in normal])
    assert square.mean() == pytest.approx(4.0 * np.sqrt(2.0 / np.pi), rel=0.03)
    # a variance of 1 +- 1, its root 1 +- sqrt(2)
    square = np.array([stepped("errors.body_px", 1.0, np.sqrt(2.0), z) ** 2 for z in normal])
    assert np.sqrt(square.var()) < 1.0
    assert square.mean() == pytest.approx(np.abs(1.0 + normal).mean(), rel=1e-9)
    # others, and well determined roots, about their values
    assert stepped("timing.delay_s", 0.0, 2.0, -1.0) == -2.0
    assert stepped("errors.body_px", 1.0, 0.1, 1.0) == pytest.approx(1.1)


def test_the_mean_of_rounded_values():
    """Against the error of the mean of rounded normal values, at 200 places between two grey values."""
    for sigma in (0.0, 0.2, 0.35):
        middle = np.arange(200) / 200.0
        draws = ndtri((np.arange(20_000) + 0.5) / 20_000)
        off = [np.rint(mean + sigma * draws).mean() - mean for mean in middle]
        assert mean_of_rounded_dn(sigma**2) == pytest.approx(np.sqrt(np.mean(np.square(off))), rel=0.03)


def test_the_interval_is_students():
    # closed form: t(0.975, 3) = 3.18245, times the root of 1 + 1/4, about the mean of the logarithms
    values = np.exp([0.0, 0.1, 0.2, 0.3])
    one = predicted("length_rms", "m", values)
    reach = 3.182446 * np.sqrt(1.25) * np.std([0.0, 0.1, 0.2, 0.3], ddof=1)
    assert (one.low, one.high) == pytest.approx((np.exp(0.15 - reach), np.exp(0.15 + reach)))
    assert one.value == pytest.approx(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (('camera = "cam1"', 'camera = "cam9"'), "key 'estimate[0].camera': 'cam9' given; one of cam1 is wanted"),
        (("errors.read_noise_e", "errors.read_nose_e"), "'errors.read_nose_e' given, which no scenario has"),
        (("low = 9.0", "low = 19.0"), "key 'estimate[0].low': 19 given, above high = 11"),
        (("sigma = 0.5", "sigma = -1"), "key 'estimate[0].sigma': -1 given; a number greater than or equal to 0"),
        (
            (
                'evidence = "x"\n',
                'evidence = "x"\n[[correlation]]\ncamera = "cam1"\nkeys = ["errors.read_noise_e", "optics.focus_m"]\n'
                "value = 0.9\n",
            ),
            "'optics.focus_m' given, of which camera 'cam1' has no [[estimate]]",
        ),
    ],
)
def test_a_wrong_lab_file_is_one_line(tmp_path, change, line):
    text = (
        '[[camera]]\nname = "cam1"\nerrors.read_noise_e = 10.0\n[[estimate]]\ncamera = "cam1"\n'
        'key = "errors.read_noise_e"\nvalue = 10.0\nsigma = 0.5\nlow = 9.0\nhigh = 11.0\nevidence = "x"\n'
    )
    place = text.index("[[estimate]]")
    (tmp_path / "lab.toml").write_text(text[:place] + text[place:].replace(*change))
    (tmp_path / "plan.toml").write_text(study.plan_text(1, 0.3))
    assert line in refusal("run", "plan.toml", "--lab", "lab.toml", "--out", "new", cwd=tmp_path)


def test_cameras_of_other_names_are_refused(tmp_path):
    told = [ParameterEstimate("left", "errors.read_noise_e", 10.0, 0.5, "x")]
    write_lab(tmp_path / "lab.toml", lab_document(told, (), None))
    (tmp_path / "plan.toml").write_text(study.plan_text(1, 0.3))
    said = refusal("run", "plan.toml", "--lab", "lab.toml", "--out", "new", cwd=tmp_path)
    assert "cameras left; the scenario's ring has cam1, cam2, cam3, cam4" in said
