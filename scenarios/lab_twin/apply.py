"""A scenario with a lab's cameras in place of its own."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mosca.accuracy.lab_twin.defocus import LEAST_PSF_PX
from mosca.data.arrays import Array
from mosca.data.files.toml import Table, check, read_toml
from mosca.errors import InputError
from scenarios.lab_twin.lab_file import SIGNED, LabTwin, as_written, is_scenario_key, put, read_lab
from scenarios.spec.cameras import CameraSpec
from scenarios.spec.scenario import Scenario, apply_overrides

ROOTS = (
    "errors.read_noise_e", "errors.body_px", "errors.trigger_jitter_s", "mount.vibration_px", "sensor.dsnu_e",
    "sensor.prnu",
)  # fmt: skip
"""Keys that are estimated as variances."""
LEAST_SHARE = 0.05
"""Lower limit of a draw, as a share of the value, for a key that must be above 0."""


def load_with_lab(path: Path, lab_path: Path | None, overrides: tuple[str, ...] = ()) -> Scenario:
    """Read a scenario file with a lab's cameras in place of its own; ``overrides`` come last.

    InputError names file, key, value and what is allowed; also where lab and scenario have different cameras.
    """
    lab = None if lab_path is None else read_lab(lab_path)
    document = read_toml(path)
    if lab is not None:
        put_cameras(document, lab)
    apply_overrides(document, overrides)
    spec = check(Scenario, document, path if lab_path is None else f"{path} with {lab_path}")
    if lab is not None and lab.cameras is None and spec.cameras.rig is None:
        _check_ring(spec, lab, str(lab_path))
    return spec


def put_cameras(document: dict[str, Any], lab: LabTwin) -> None:
    """Put a lab's cameras into a scenario's document: its rig, and each key of its cameras."""
    if lab.cameras is not None:
        document["cameras"] = {"rig": lab.cameras.rig}
    there = document.setdefault("camera", [])
    for camera in lab.camera:
        given = written_keys(camera)
        own = next((one for one in there if one.get("name") == camera.name), None)
        if own is None:
            there.append(given)
            continue
        for key, value in given.items():
            own[key] = {**own.get(key, {}), **value} if isinstance(value, dict) else value


def written_keys(table: CameraSpec) -> dict[str, Any]:
    """Return the keys that are set in a camera's table, as a document."""
    return {
        name: value.model_dump(exclude_unset=True) if isinstance(value, Table) else value
        for name, value in table
        if name in table.model_fields_set
    }


def _check_ring(spec: Scenario, lab: LabTwin, where: str) -> None:
    """Raise InputError where a ring, which has no rig file of its own, has other cameras than the lab."""
    ring = [f"cam{k + 1}" for k in range(spec.cameras.count)]
    own = [one.name for one in lab.camera]
    if set(own) != set(ring):
        raise InputError(
            f"{where}: cameras {', '.join(own)}; the scenario's ring has {', '.join(ring)}: fit with --rig, or give "
            "the scenario cameras.rig"
        )


def drawn(lab: LabTwin, random: np.random.Generator) -> LabTwin:
    """Return a lab whose keys are drawn about their values, with their standard deviations and correlations."""
    cameras: dict[str, dict[str, Any]] = {one.name: written_keys(one) for one in lab.camera}
    normals = _root_of_correlation(lab) @ random.standard_normal(len(lab.estimate))
    for one, normal in zip(lab.estimate, normals.tolist(), strict=True):
        if one.sigma == 0.0 or not is_scenario_key(one.key):
            continue
        value = _stated(cameras[one.camera], one.key)
        if value is not None:
            put(
                cameras[one.camera],
                one.key,
                as_written(one.key, bounded(one.key, value, stepped(one.key, value, one.sigma, normal))),
            )
    return check(LabTwin, {**_rest(lab), "camera": list(cameras.values())}, "a draw of the lab's parameters")


def _root_of_correlation(lab: LabTwin) -> Array:
    """Return the symmetric root of the correlation matrix of the estimates (n, n)."""
    row = {(one.camera, one.key): k for k, one in enumerate(lab.estimate)}
    matrix = np.eye(len(row))
    for pair in lab.correlation:
        first, second = (row[pair.camera, key] for key in pair.keys)
        matrix[first, second] = matrix[second, first] = pair.value
    np.fill_diagonal(matrix, 1.0)
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root


def stepped(key: str, value: float, sigma: float, normal: float) -> float:
    """Return a draw of a key, ``normal`` standard deviations off; before ``bounded``.

    The root of a variance that is not above its own uncertainty (``estimates.root``) is drawn as that variance: the
    squares of such roots drawn about their values would have twice the variance, or more, in the mean.
    """
    if key in ROOTS and sigma > value:
        return math.sqrt(abs(value**2 + (sigma**2 - value**2) * normal))
    return value + sigma * normal


def bounded(key: str, value: float, drawn_value: float) -> float:
    """Return a draw of a key within what is possible: folded at 0, and of a key above 0 not far below its value."""
    if key.startswith(SIGNED):
        return drawn_value
    if value == 0.0 and key == "timing.row_time_s":
        return 0.0
    least = LEAST_PSF_PX if key == "errors.psf_sigma_px" else LEAST_SHARE * value
    return max(abs(drawn_value), least)


def _stated(camera: Mapping[str, Any], key: str) -> float | None:
    """Return the value of ``table.key``, or of one number of a pair, in a camera's table; None if it is not set."""
    table, name = key.split(".")
    index = None
    if name.endswith("]"):
        name, place = name[:-1].split("[")
        index = int(place)
    found: Any = camera.get(table, {}).get(name)
    if found is None:
        return None
    pair: Array = np.atleast_1d(found)
    return float(pair[index or 0])


def _rest(lab: LabTwin) -> dict[str, Any]:
    return lab.model_dump(exclude={"camera"}, exclude_none=True)
