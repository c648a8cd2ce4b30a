"""Blind labs: twins with hidden settings play a lab; the fit sees their recordings alone.

Run as a module for a table of z = (estimate - truth) / sigma and of the predicted length errors:
``python -m tests.studies.lab_twin --labs 4``. With ``--mitsuba`` another renderer plays the labs: ``lab_mitsuba``.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from mosca.data.files.rig_file import write_rig
from mosca.data.files.toml import check
from mosca.recording.writer import RecordingWriter
from scenarios.build.cameras import calibrated, true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.lab_twin.apply import load_with_lab
from scenarios.lab_twin.fit import FitRequest, fit_lab
from scenarios.lab_twin.lab_file import read_lab
from scenarios.lab_twin.predict import predict
from scenarios.run.scenario import run_scenario
from scenarios.spec.scenario import Scenario
from scenarios.types import RunOptions
from twin.cameras.sensor.level_lookup import SPACING

AT_REST = 1e-9
"""Speed of targets at rest [m/s]: a cloud has some."""
NO_LIGHT = 1e-7
"""Signal of a marker that is not to be seen."""
BRIGHT = 0.6
"""Light of the brighter even surface over the full well."""
WORST_M = 0.5e-3
"""Largest stated standard deviation of points whose lengths count, in the lab and in its prediction: a ball that
another one hides in part is stated, and is, up to some mm off. One such length in 1,500 doubles an rms of 0.05 mm."""
TAKES = 4
"""Takes in which the lab measures: the rms of one of 60 s scatters by 8 % from take to take."""
BLIND = {"kind": "cloud", "markers": 1, "marker_diameter_m": 0.01, "speed_mps": AT_REST}
STILL = {"kind": "cloud", "markers": 30, "marker_diameter_m": 0.02, "speed_mps": AT_REST}
MOVING = {"kind": "cloud", "markers": 30, "marker_diameter_m": 0.02, "speed_mps": 1.5}


def hidden_settings(seed, cameras=3):
    """Return the ``[[camera]]`` tables of a lab, drawn by a seed."""
    random = np.random.default_rng(seed)
    bits = int(random.choice([10, 12]))
    tables = []
    for k in range(cameras):
        well = float(random.uniform(8e3, 3e4))
        tables.append(
            {
                "name": f"cam{k + 1}",
                "errors": {
                    "full_well_e": well,
                    # noise of some counts: what rounding hides is not asked for
                    "read_noise_e": (read := max(float(random.uniform(5.0, 30.0)), well / 2.0**bits)),
                    "bits": bits,
                    "background_e": float(random.uniform(50.0, 400.0)),
                    "psf_sigma_px": float(random.uniform(0.45, 0.9)),
                    "marker_signal": float(random.uniform(0.35, 0.8)),
                    "body_px": float(random.uniform(0.02, 0.12)),
                    "trigger_jitter_s": float(random.uniform(20e-6, 200e-6)),
                },
                "sensor": {
                    "black_dn": float(random.uniform(3.0, 6.0)),
                    "dsnu_e": read * float(random.uniform(0.25, 0.8)),
                    "prnu": float(random.uniform(0.003, 0.015)),
                },
                "timing": {"delay_s": float(random.uniform(-2e-4, 2e-4))},
                "delivery": {"dropped_share": float(random.uniform(0.0, 0.03))},
            }
        )
    return tables


def lab_spec(tables, scene, *, frames, light=None, gap="none", seed=1, more=None):
    """Return the scenario of a recording in a lab of ``tables``.

    ``light`` [share of the full well]: an even surface so bright, or the cap (0), in place of the scene.
    """
    tables = [{**one, "errors": dict(one["errors"])} for one in tables]
    if light is not None:
        for one in tables:
            one["errors"] |= {"background_e": light * one["errors"]["full_well_e"], "marker_signal": NO_LIGHT}
    document = {
        "title": "a blind lab",
        "seed": seed,
        "model_gap": gap,
        "working_space": {"center_m": [0.0, 0.0, 1.0], "size_m": [1.2, 1.2, 1.2]},
        "capture": {"duration_s": frames / 100.0, "frame_rate_hz": 100.0},
        "scene": scene,
        "cameras": {
            "count": len(tables), "radius_m": 2.5, "height_m": [1.0 + 0.5 * (k % 3) for k in range(len(tables))],
            "size_px": [512, 400], "pixel_pitch_mm": 0.0099, "c_mm": 6.0,
        },
        "camera": tables,
        "limits": {"completeness": 0.1},
        **(more or {}),
    }  # fmt: skip
    return check(Scenario, document, "blind lab")


def record(spec, folder, skip=0, workers=2):
    """Record a scenario's frames into a folder, but the first ``skip``; return the rig that the lab believes in.

    The noise of a frame follows from its number: recordings of the same numbers would have the same noise.
    """
    rig = true_rig(spec, Path())
    cameras = virtual_cameras(spec, rig)
    source = twin_source(spec, build_scene(spec, Path()), cameras, workers)
    with source as twin, RecordingWriter(folder, twin.cameras) as writer:
        for frame in twin:
            if frame.index >= skip:
                writer.write(frame)
    return calibrated(spec, cameras).rig


def record_lab(tables, folder, *, still=150, moving=300, gap="none", seed=1):
    """Record what the fit needs into a folder, with rig.toml; return the recordings as the verb takes them."""
    record(lab_spec(tables, BLIND, frames=16, light=0.0, gap=gap, seed=seed), folder / "dark")
    record(lab_spec(tables, BLIND, frames=32, light=0.3, gap=gap, seed=seed), folder / "lit", 20)
    record(lab_spec(tables, BLIND, frames=52, light=BRIGHT, gap=gap, seed=seed), folder / "bright", 40)
    record(lab_spec(tables, STILL, frames=60 + still, gap=gap, seed=seed), folder / "still", 60)
    begin = 60 + still
    rig = record(lab_spec(tables, MOVING, frames=begin + moving, gap=gap, seed=seed), folder / "moving", begin)
    write_rig(rig, folder / "rig.toml")
    kinds = {"dark": "dark", "lit": "lit", "bright": "lit", "still": "static", "moving": "moving"}
    return tuple(f"{kind}:{folder / name}" for name, kind in kinds.items())


def truth_of(tables, camera, key):
    """Return the hidden value of one parameter of one camera, None where the tables do not say it."""
    table, _, name = key.partition(".")
    own = next(one for one in tables if one["name"] == camera)
    if name == "delay_s":  # a delay that all share is no delay
        return own["timing"]["delay_s"] - float(np.mean([one["timing"]["delay_s"] for one in tables]))
    found = own.get(table, {}).get(name)
    # the twin rounds the pixels' mean light to levels, SPACING of the temporal noise apart
    dark_e = SPACING * own["errors"]["read_noise_e"] / np.sqrt(12.0)
    if name == "dsnu_e":
        return float(np.hypot(found, dark_e))
    if name == "prnu":
        light_e = BRIGHT * own["errors"]["full_well_e"]
        lit_e = np.hypot(dark_e, SPACING * np.sqrt(light_e / 12.0))
        return float(np.sqrt(found**2 + (dark_e**2 + lit_e**2) / light_e**2))
    return None if found is None else float(found)


def z_scores(tables, told):
    """Return (camera, key, truth, value, sigma, z) of all estimates whose truth the tables say."""
    rows = []
    for one in told:
        truth = truth_of(tables, one.camera, one.key) if hasattr(one, "value") else None
        if truth is not None and one.sigma > 0.0:
            rows.append((one.camera, one.key, truth, one.value, one.sigma, (one.value - truth) / one.sigma))
    return rows


PLAN = """
title = "a wand's length in a lab"
seed = {seed}
model_gap = "none"
[working_space]
center_m = [0.0, 0.0, 1.0]
size_m = [1.2, 1.2, 1.2]
[capture]
duration_s = {seconds}
frame_rate_hz = 25.0
[scene]
kind = "wand"
[[length]]
name = "end to end"
length_m = 0.4
[pipeline.track]
worst_sigma_m = {worst_m}
[limits]
completeness = 0.1
"""
"""The planned experiment; it knows nothing of the lab."""


def plan_text(seed, seconds, worst_m=WORST_M):
    """Return the scenario file of the planned experiment."""
    return PLAN.format(seed=seed, seconds=seconds, worst_m=worst_m)


def measured_lengths(tables, seed, seconds, takes=TAKES, worst_m=WORST_M):
    """Return the length error [m] that the hidden lab measures, rms, in each of some takes."""
    wand = {
        "length": [{"name": "end to end", "length_m": 0.4}],
        "capture": {"duration_s": seconds, "frame_rate_hz": 25.0},
        "pipeline": {"track": {"worst_sigma_m": worst_m}},
    }
    specs = [lab_spec(tables, {"kind": "wand"}, frames=1, seed=seed + 100 * k, more=wand) for k in range(takes)]
    runs = [run_scenario(spec, "lab", Path(), RunOptions(workers=2, page=False)) for spec in specs]
    return [run.record.metric("length_rms").value for run in runs]


def predicted_length(folder, seed, seconds, draws, worst_m=WORST_M):
    """Return the prediction of the fitted lab in a folder."""
    plan = folder / "plan.toml"
    plan.write_text(plan_text(seed, seconds, worst_m))
    lab = folder / "lab.toml"
    _, told = predict(load_with_lab(plan, lab), read_lab(lab), "plan", folder, draws, workers=2)
    return next(one for one in told if one.metric == "length_rms")


def blind(seed, folder, *, seconds=10.0, draws=4, still=120, moving=200, twice=False):
    """Play one blind lab: return its z scores, the measured length error of each take, and the prediction.

    ``twice``: also return what the lab measures with its cameras shaking twice as much as when it was fitted.
    """
    tables = hidden_settings(seed)
    recordings = record_lab(tables, folder, still=still, moving=moving, seed=seed)
    told = fit_lab(FitRequest(recordings, folder / "lab.toml", folder / "rig.toml"))
    measured = measured_lengths(tables, 1000 + seed, seconds)
    prediction = predicted_length(folder, 2000 + seed, seconds, draws)
    worse = None
    if twice:
        loud = [{**one, "errors": {**one["errors"], "body_px": 2.0 * one["errors"]["body_px"]}} for one in tables]
        (worse,) = measured_lengths(loud, 1000 + seed, seconds, 1)
    return z_scores(tables, told), measured, prediction, worse


def report(seed, scores, measured, said):
    """Print the parameters of a lab that are off, and its length error beside the predicted one."""
    z = np.array([row[-1] for row in scores])
    print(f"lab {seed}: {np.sum(np.abs(z) <= 3)} of {len(z)} parameters within 3 sigma")
    for camera, key, truth, value, sigma, score in scores:
        if abs(score) > 2.5:
            print(f"  {camera} {key}: {value:.5g} +- {sigma:.2g}, truth {truth:.5g}, z {score:.1f}")
    inside = said.low <= measured <= said.high
    print(
        f"  length error {1e6 * measured:.1f} um measured, {1e6 * said.value:.1f} predicted "
        f"({100 * (said.value / measured - 1):+.1f} %), 95 % {1e6 * said.low:.1f} .. {1e6 * said.high:.1f}: "
        f"{'inside' if inside else 'OUTSIDE'}",
        flush=True,
    )


def summary(every):
    """Print the z scores of all labs, key by key."""
    for key in dict.fromkeys(row[1] for row in every):
        z = np.array([row[-1] for row in every if row[1] == key])
        rms, most, within = np.sqrt(np.mean(z**2)), np.abs(z).max(), np.sum(np.abs(z) <= 3)
        print(f"{key:26s} {len(z):3d} z: {within} within 3, mean {z.mean():5.2f} rms {rms:5.2f} max {most:5.2f}")


def main():
    """Print z scores and predictions of some labs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--labs", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=10.0, help="of the wand")
    parser.add_argument("--draws", type=int, default=4, help="of the lab's parameters and the seed")
    parser.add_argument("--mitsuba", action="store_true", help="Mitsuba plays the labs, in place of hidden twins")
    given = parser.parse_args()
    every = []
    for seed in range(given.first, given.first + given.labs):
        with tempfile.TemporaryDirectory() as folder:
            if given.mitsuba:
                from tests.studies.lab_mitsuba import blind_and_told

                every += blind_and_told(seed, Path(folder), given.draws)
                continue
            scores, measured, said, worse = blind(
                seed, Path(folder), seconds=given.seconds, draws=given.draws, twice=True
            )
        every += scores
        report(seed, scores, float(np.sqrt(np.mean(np.square(measured)))), said)
        inside = sum(said.low <= one <= said.high for one in measured)
        print(
            f"  of {len(measured)} takes, {', '.join(f'{1e6 * one:.1f}' for one in measured)} um, {inside} are inside"
        )
        seen = "inside, NOT SEEN" if worse <= said.high else "outside as it must be"
        print(f"  shaking twice as much {1e6 * worse:.1f}: {seen}", flush=True)
    summary(every)


if __name__ == "__main__":
    main()
