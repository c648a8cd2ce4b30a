"""A fitted person as .npz: every field of ``mosca.skeleton.fit.FittedSubject``, to the last bit, with a checksum.

Arrays have the names of the fields, those of the model ``model.NAME``. A mapping is stored as two arrays,
``NAME.keys`` and ``NAME.values``. The model itself is its MJCF text, which is compiled and never run.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_origin, get_type_hints

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.npz import from_npz, write_npz_file
from mosca.data.files.whole_file import check_writable, whole_file
from mosca.errors import InputError
from mosca.skeleton.fit import FittedSubject
from mosca.skeleton.mjcf import compiled
from mosca.skeleton.start import SIZES

SUFFIX = ".npz"
_UNIT = 1e-6
"""Largest allowed difference of axes from a rotation, and of a quaternion's norm from 1."""


def check_subject_file(path: Path) -> None:
    """Raise InputError where ``path`` is no file for a subject; to be called before long work."""
    if path.suffix.lower() != SUFFIX:
        raise InputError(f"{path}: suffix '{path.suffix}' given; a subject is a {SUFFIX} file")
    check_writable(path)


def write_subject(subject: FittedSubject, path: Path) -> None:
    """Write ``subject`` to ``path`` as .npz, whole or not at all. Raises InputError where that fails."""
    path = Path(path)
    check_subject_file(path)
    with whole_file(path) as temporary:
        write_npz_file(temporary, _arrays(subject))


def read_subject(path: Path) -> FittedSubject:
    """Return the subject in a file that ``write_subject`` wrote.

    Raises InputError for a missing, damaged or other file, and where its numbers are not those of a fitted model.
    """
    return from_npz(Path(path), _subject, "skeleton subject", "'mosca skeleton fit'")


def _arrays(owner: Any, prefix: str = "") -> dict[str, Array]:
    """Return the fields of a dataclass as arrays by their names."""
    found: dict[str, Array] = {}
    for field in dataclasses.fields(owner):
        name, value = prefix + field.name, getattr(owner, field.name)
        if dataclasses.is_dataclass(value):
            found |= _arrays(value, f"{name}.")
        elif isinstance(value, Mapping):
            found[f"{name}.keys"] = np.array(list(value), dtype=np.str_)
            found[f"{name}.values"] = np.array(list(value.values()), dtype=np.float64)
        else:
            texts = isinstance(value, tuple)
            found[name] = np.array(value, dtype=np.str_) if texts else np.asarray(value)
    return found


def _made(kind: type, arrays: Mapping[str, Array], prefix: str = "") -> Any:
    """Return a ``kind``, made from ``arrays`` by their names; ValueError for an array of another type."""
    hints = get_type_hints(kind)
    values = {}
    for field in dataclasses.fields(kind):
        name, hint = prefix + field.name, hints[field.name]
        if dataclasses.is_dataclass(hint):
            values[field.name] = _made(hint, arrays, f"{name}.")  # type: ignore[arg-type]
        elif get_origin(hint) is tuple:
            values[field.name] = tuple(_texts(arrays, name).tolist())
        elif get_origin(hint) is Mapping:
            keys, rows = _texts(arrays, f"{name}.keys"), _numbers(arrays, f"{name}.values")
            if len(set(keys.tolist())) < len(keys) or rows.ndim < 1 or len(rows) != len(keys):
                raise ValueError(f"{name}: {len(keys)} names and values of shape {rows.shape}")
            values[field.name] = dict(zip(keys.tolist(), rows, strict=True))
        elif hint in (str, int, float):
            values[field.name] = _single(arrays, name, hint)
        else:
            values[field.name] = _numbers(arrays, name)
    return kind(**values)


def _texts(arrays: Mapping[str, Array], name: str) -> Array:
    values = np.asarray(arrays[name])
    if values.ndim != 1 or values.dtype.kind != "U":
        raise ValueError(f"{name} is {values.dtype} of shape {values.shape}; a list of names is wanted")
    return values


def _numbers(arrays: Mapping[str, Array], name: str) -> Array:
    values = np.asarray(arrays[name])
    if values.dtype != np.float64:
        raise ValueError(f"{name} holds {values.dtype}; numbers (float64) are wanted")
    return values


def _single(arrays: Mapping[str, Array], name: str, kind: type) -> Any:
    values = np.asarray(arrays[name])
    if values.shape != () or values.dtype.kind != {str: "U", int: "i", float: "f"}[kind]:
        raise ValueError(f"{name} is {values.dtype} of shape {values.shape}; one {kind.__name__} is wanted")
    return kind(values[()])


def _subject(arrays: Mapping[str, Array]) -> FittedSubject:
    subject: FittedSubject = _made(FittedSubject, arrays)
    known = set(_arrays(subject))
    if more := sorted(set(arrays) - known - {"sha256"}):
        raise ValueError(f"an array '{more[0][:40]}' is not known")
    _check(subject)
    return subject


def _check(subject: FittedSubject) -> None:
    """Raise ValueError where the arrays do not fit the model's text, or hold values that a fit cannot have."""
    model = subject.model
    mj = _compiled(model.mjcf)
    sites = [mj.site(k).name for k in range(mj.nsite)]
    if [mj.joint(k).name for k in range(1, mj.njnt)] != list(model.joints):
        raise ValueError("model.joints are not those of model.mjcf")
    if not model.labels or model.labels != tuple(name for name in sites if name in set(model.labels)):
        raise ValueError("model.labels are not sites of model.mjcf in their order")
    wanted = {"model.rotation_sigma": (mj.nv,), "q": (mj.nq,), "posture": (mj.nv,)}
    arrays = _arrays(subject)
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name}: shape {arrays[name].shape} given, {shape} wanted")
    for name, values in arrays.items():
        if values.dtype.kind == "f" and name != "model.rotation_sigma" and not np.isfinite(values).all():
            raise ValueError(f"{name} holds a number that is not finite")
    if not (model.rotation_sigma > 0).all():
        raise ValueError("model.rotation_sigma holds a number that is not above 0")
    if not SIZES[0] < subject.size < SIZES[1] or subject.frames < 1 or subject.residual_rms_m < 0:
        raise ValueError(f"size {subject.size:g}, {subject.frames} frames: no fit of a person")
    if (subject.skin_m < 0).any():
        raise ValueError("skin_m holds a number below 0")
    quaternions = np.linalg.norm(subject.q[3:].reshape(-1, 4), axis=1)
    if (np.abs(quaternions - 1) > _UNIT).any():
        raise ValueError("q holds a quaternion whose norm is not 1")
    for name, matrix in (("covariance", subject.covariance), ("model.information", model.information)):
        if np.abs(matrix - matrix.T).max() > _UNIT * np.abs(matrix).max() or (np.diag(matrix) < 0).any():
            raise ValueError(f"{name} is not symmetric with a diagonal above 0")
    # factorised as in mosca.skeleton.joints; numpy's error is a ValueError
    np.linalg.cholesky(subject.covariance + 1e-18 * np.eye(len(subject.covariance)))
    _check_axes(subject, {mj.body(k).name for k in range(1, mj.nbody)})


def _compiled(text: str) -> Any:
    try:
        return compiled(text, "model.mjcf")
    except InputError as error:
        raise ValueError(str(error)) from None


def _check_axes(subject: FittedSubject, bodies: set[str]) -> None:
    axes, slopes, p = subject.axes.axes, subject.axes.slopes, len(subject.parameters)
    if not set(axes) <= bodies or set(axes) != set(slopes):
        raise ValueError("axes are not of bodies of the model, each with slopes")
    for body, matrix in axes.items():
        if matrix.shape != (3, 3) or slopes[body].shape != (3, p):
            raise ValueError(
                f"axes of '{body}': shapes {matrix.shape} and {slopes[body].shape}, (3, 3) and (3, {p}) wanted"
            )
        if np.abs(matrix.T @ matrix - np.eye(3)).max() > _UNIT or np.linalg.det(matrix) < 0:
            raise ValueError(f"axes of '{body}' are no rotation")
