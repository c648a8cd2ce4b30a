"""The report of a calibration: one offline HTML file with its verdict and uncertainty."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.calibration import Calibration, Finding
from mosca.data.calibration_evidence import CalibrationEvidence
from mosca.data.rig import Camera
from mosca.data.rotations import quaternion_from_rotation
from reports.calibration_plots import calibration_pictures
from reports.page import write_rendered
from reports.units import figure, shown

MOST_COLUMNS = 4
"""Cameras per table of lens parameters; more get further tables."""
SEVERITIES = {"refuse": ("Do not use", "bad"), "warn": ("Warning", "warn"), "note": ("Note", "")}


def write_calibration_page(path: Path, calibration: Calibration, evidence: CalibrationEvidence) -> None:
    """Write the page of ``calibration`` with its ``evidence`` to ``path``, whole or not at all.

    Nothing is loaded from outside; the same data give the same bytes.
    """
    write_rendered(
        path,
        "calibration.html.j2",
        title=f"Calibration of {len(calibration.rig.cameras)} camera{_s(len(calibration.rig.cameras))}",
        badge=verdict(calibration.findings),
        sentence=sentence(calibration, evidence),
        facts=_facts(calibration, evidence),
        tiles=_tiles(calibration, evidence),
        findings=[_finding(one) for one in calibration.findings],
        precision=_precision(calibration),
        interior=_interior(calibration),
        exterior=_exterior(calibration),
        pictures=calibration_pictures(calibration, evidence),
    )


def verdict(findings: tuple[Finding, ...]) -> dict[str, str]:
    """Return text, sign and tone of the verdict on the findings."""
    grave = [one.severity for one in findings]
    if "refuse" in grave:
        return {"text": "Do not use", "sign": "✗", "tone": "bad"}
    if "warn" in grave:
        return {"text": "Use with care", "sign": "!", "tone": "warn"}
    return {"text": "Nothing speaks against it", "sign": "✓", "tone": "good"}


def sentence(calibration: Calibration, evidence: CalibrationEvidence) -> str:
    """Return the main result in words."""
    worst = next((one for one in calibration.findings if one.severity in ("refuse", "warn")), None)
    pixels = figure(_rms(calibration.sigma_px))
    text = f"Image points fit to {pixels} px (standard deviation of a coordinate)"
    if evidence.accuracy is not None and np.isfinite(evidence.accuracy.sigma_m).any():
        middle = float(np.nanmedian(evidence.accuracy.sigma_m))
        text += f"; a point is measured to {_length(middle)} (predicted, median)"
    if worst is None:
        return f"{text}."
    others = sum(one.severity in ("refuse", "warn") for one in calibration.findings) - 1
    more = f" And {others} more below." if others else ""
    return f"{worst.message[0].upper()}{worst.message[1:]}.{more}"


def with_sigma(value: float, sigma: float | None) -> str:
    """Return ``value`` and its standard deviation as text, with two digits of the latter.

    >>> with_sigma(1234.5678, 0.0123)
    '1234.568 ± 0.012'
    """
    if sigma is None:
        return figure(value) if abs(value) < 1e5 and (value == 0 or abs(value) >= 1e-3) else _power(value, None)
    if not math.isfinite(sigma) or sigma <= 0:
        return figure(value)
    if max(abs(value), sigma) < 1e-2:
        return _power(value, sigma)
    places = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{places}f} ± {sigma:.{places}f}".replace("-", "−")


def _power(value: float, sigma: float | None) -> str:
    size = max(abs(value), sigma or 0.0)
    exponent = math.floor(math.log10(size))
    small = f"·10{str(exponent).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
    scaled = value / 10**exponent
    if sigma is None:
        return f"{scaled:.3g}{small}".replace("-", "−")
    other = sigma / 10**exponent
    places = max(0, 1 - math.floor(math.log10(other)))
    return f"({scaled:.{places}f} ± {other:.{places}f}){small}".replace("-", "−")


def _facts(calibration: Calibration, evidence: CalibrationEvidence) -> list[tuple[str, str]]:
    see = calibration.sightings
    facts = [
        ("Target", calibration.target),
        ("Scale from", calibration.scaled_by),
        ("Frames", figure(float(see.frames))),
        ("Image points", f"{figure(float(calibration.used.sum()))} of {figure(float(len(see)))} used"),
        ("Sigma of unit weight", figure(calibration.sigma0)),
    ]
    if calibration.body_px > 0:
        facts.append(("Bodies shake", f"{figure(calibration.body_px)} px rms"))
    if evidence.made_from:
        facts.append(("Made from", evidence.made_from))
    return [(name, value) for name, value in facts if value]


def _tiles(calibration: Calibration, evidence: CalibrationEvidence) -> list[dict[str, str]]:
    tiles = [
        {
            "name": "Image coordinate, σ",
            "value": figure(_rms(calibration.sigma_px)),
            "unit": "px",
            "note": "all cameras",
        },
        _tile("On the target, σ", _rms(calibration.sigma_m), "m", "all cameras"),
    ]
    if evidence.accuracy is not None and np.isfinite(evidence.accuracy.sigma_m).any():
        worst = float(np.nanmax(evidence.accuracy.sigma_m))
        middle = float(np.nanmedian(evidence.accuracy.sigma_m))
        tiles.append(_tile("A point in space, σ", middle, "m", f"predicted, median; at worst {_length(worst)}"))
    if evidence.lengths is not None:
        lengths = evidence.lengths
        tiles.append(
            {
                "name": "Held-out lengths, scale",
                "value": f"{100 * lengths.scale_error:+.3f}".replace("-", "−"),
                "unit": "%",
                "note": f"± {100 * lengths.scale_sigma:.3f} %",
            }
        )
    return tiles


def _tile(name: str, value: float, unit: str, note: str) -> dict[str, str]:
    (scaled,), text = shown((value,), unit)
    return {"name": name, "value": figure(scaled), "unit": text, "note": note}


def _finding(one: Finding) -> dict[str, str]:
    text, tone = SEVERITIES[one.severity]
    return {"text": text, "tone": tone, "code": one.code, "message": f"{one.message[0].upper()}{one.message[1:]}."}


def _precision(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the paper's Table 2, a row for each camera: sigma_x and sigma_y in px and in mm on the target."""
    rows = []
    for k, camera in enumerate(calibration.rig.cameras):
        mine = calibration.sightings.camera == k
        used = mine & calibration.used
        rows.append(
            {
                "camera": camera.name,
                "size": f"{camera.width} × {camera.height}",
                "px": [f"{float(v):#.3g}" for v in calibration.sigma_px[k]],
                "mm": [f"{1e3 * float(v):#.3g}" for v in calibration.sigma_m[k]],
                "used": figure(float(used.sum())),
                "out": figure(float((mine & ~calibration.used).sum())),
                "frames": figure(float(len(np.unique(calibration.sightings.frame[used])))),
                "bad": any(f.camera == camera.name and f.severity == "refuse" for f in calibration.findings),
            }
        )
    return rows


def _interior(calibration: Calibration) -> list[dict[str, Any]]:
    """Return tables of a few cameras of one lens model each, with the parameters that any of them uses."""
    sigmas = calibration.standard_deviations
    tables = []
    for model in dict.fromkeys(camera.lens.model for camera in calibration.rig.cameras):
        cameras = [camera for camera in calibration.rig.cameras if camera.lens.model == model]
        names = [
            name
            for name in asdict(cameras[0].lens)
            if any(getattr(c.lens, name) or _sigma(sigmas, c, name) is not None for c in cameras)
        ]
        rows = [
            {
                "camera": camera.name,
                "cells": [
                    {
                        "text": with_sigma(getattr(camera.lens, name), _sigma(sigmas, camera, name)),
                        "held": _sigma(sigmas, camera, name) is None,
                    }
                    for name in names
                ],
            }
            for camera in cameras
        ]
        tables += [
            {"model": model, "names": names, "rows": rows[k : k + MOST_COLUMNS]}
            for k in range(0, len(rows), MOST_COLUMNS)
        ]
    return tables


def _sigma(sigmas: dict[str, float], camera: Camera, name: str) -> float | None:
    """Return the standard deviation of a lens parameter; that of both focal lengths if they are estimated as one."""
    found = sigmas.get(f"{camera.name}.{name}")
    return sigmas.get(f"{camera.name}.f_px") if found is None and name in ("fx_px", "fy_px") else found


def _exterior(calibration: Calibration) -> list[dict[str, Any]]:
    sigmas = calibration.standard_deviations
    rows = []
    for camera in calibration.rig.cameras:
        pose = camera.world_from_camera
        turn = [sigmas.get(f"{camera.name}.turn_{axis}_rad") for axis in "xyz"]
        rows.append(
            {
                "camera": camera.name,
                "place": [
                    with_sigma(1e3 * float(value), _scaled(sigmas.get(f"{camera.name}.{axis}_m"), 1e3))
                    for axis, value in zip("XYZ", pose.translation, strict=True)
                ],
                "turn": " ".join(f"{v:+.6f}" for v in quaternion_from_rotation(pose.rotation)).replace("-", "−"),
                "sigma_turn": " / ".join("held" if s is None else figure(1e3 * s) for s in turn),
            }
        )
    return rows


def _scaled(sigma: float | None, factor: float) -> float | None:
    return None if sigma is None else factor * sigma


def _length(value_m: float) -> str:
    (scaled,), unit = shown((value_m,), "m")
    return f"{figure(scaled)} {unit}"


def _rms(values: Any) -> float:
    finite = np.asarray(values)[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def _s(count: int) -> str:
    return "" if count == 1 else "s"
