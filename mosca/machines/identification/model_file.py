"""``model.json``: an identified model as plain numbers, for other programs. Rates in rad/s, times in s, SI outputs.

Each quantity is ``[value, low, high]`` with its 95 % interval. ``numerators`` and ``denominator`` are polynomials in
s, highest power first, of the transfer function from each input; its response is to be delayed by ``delay_s``.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.whole_file import write_text
from mosca.machines.identification.identify import IdentifiedModel, IdentifiedOutput
from mosca.machines.identification.modes import poles_of

FORMAT = 1


def write_model(model: IdentifiedModel, path: Path, unseen: tuple[float, ...] | None = None) -> None:
    """Write ``model`` to ``path``, whole or not at all. ``unseen``: fits on another take [%], if there is one."""
    document = {
        "format": FORMAT,
        "inputs": list(model.inputs),
        "period_s": model.period_s,
        "outputs": [
            _output(one, model, None if unseen is None else unseen[k]) for k, one in enumerate(model.outputs)
        ],
        "realization": {
            "poles_discrete": [_pair(p) for p in model.realization.poles],
            "gains": model.realization.gains.tolist(),
            "singular_values": model.realization.singular_values.tolist(),
        },
    }
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def transfer_function(one: IdentifiedOutput, inputs: int) -> tuple[Array, Array]:
    """Return numerators (k, n) and denominator (n + 1,) in s of the gain from each input, highest power first."""
    model = one.estimate.model
    half = poles_of(model.logs)
    whole = model.poles
    numerators = np.zeros((inputs, len(whole)))
    at = 0
    for pole in half:
        for part in (1.0,) if pole.imag == 0 else (1.0, -1j):
            # Re x and Im x of x' = pole x + u: each is half of the pair's responses
            share = model.coefficients[at : at + inputs] * part
            numerators += _with_pole(share, pole, whole, 1.0 if pole.imag == 0 else 0.5)
            at += inputs + 1
    return numerators, np.real(np.poly(whole))


def _with_pole(share: Array, pole: complex, whole: Array, half: float) -> Array:
    """Return the numerators (k, n) of ``share`` (k,) of the response of a pole and of its conjugate."""
    result = np.zeros((len(share), len(whole)), dtype=complex)
    for one, factor in ((pole, share),) if half == 1.0 else ((pole, share), (pole.conjugate(), np.conj(share))):
        rest = np.delete(whole, int(np.argmin(np.abs(whole - one))))
        result += half * np.asarray(factor)[:, None] * np.poly(rest)
    return result.real


def _output(one: IdentifiedOutput, model: IdentifiedModel, unseen: float | None) -> dict[str, Any]:
    estimate, n, k = one.estimate, one.order, len(model.inputs)
    rows = [[float(v), float(low), float(high)] for v, (low, high) in zip(
        estimate.quantities, estimate.intervals, strict=True
    )]  # fmt: skip
    numerators, denominator = transfer_function(one, k)
    poles = estimate.quantities[: 2 * n : 2] + 1j * estimate.quantities[1 : 2 * n : 2]
    return {
        "name": one.name,
        "unit": one.unit,
        "order": n,
        "poles_real_rad_s": rows[: 2 * n : 2],
        "poles_imaginary_rad_s": rows[1 : 2 * n : 2],
        "poles_discrete": [_pair(np.exp(p * model.period_s)) for p in poles],
        "gains": dict(zip(model.inputs, rows[2 * n : 2 * n + k], strict=True)),
        "delay_s": rows[-1],
        "offset": float(estimate.model.coefficients[-1]),
        "numerators": dict(zip(model.inputs, numerators.tolist(), strict=True)),
        "denominator": denominator.tolist(),
        "blocks": estimate.blocks,
        "residual_rms": estimate.residual_rms,
        "held_out_rms": list(one.held_out_rms),
        "fit_held_out_percent": one.fit_held_out,
        "fit_unseen_percent": unseen,
        "arx_poles_discrete": [_pair(p) for p in one.arx],
    }


def _pair(value: complex) -> list[float]:
    return [float(np.real(value)), float(np.imag(value))]
