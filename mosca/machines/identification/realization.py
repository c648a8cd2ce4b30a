"""A second estimate without a search: Markov parameters by least squares, and their eigensystem realization.

Both are functions of python-control. ``markov`` fits the pulse response of all inputs and outputs together.
``eigensys_realization`` (Juang and Pappa 1985) finds the system of given order with the nearest pulse response in its
Hankel matrix. Its uncertainty is not estimated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.machines.identification.held_inputs import on_grid
from mosca.machines.identification.output_error import OutputRecord


@dataclass(frozen=True, eq=False)
class Realization:
    """Discrete ``poles`` (n,), DC ``gains`` (outputs, inputs), all ``singular_values`` of the Hankel matrix (s,)."""

    poles: Array
    gains: Array
    singular_values: Array

    def __post_init__(self) -> None:
        set_read_only(self, np.complex128, poles=(None,))
        set_read_only(self, gains=(None, None), singular_values=(None,))


def realization(records: Sequence[OutputRecord], delays_s: Sequence[float], order: int, samples: int) -> Realization:
    """Return the realization of ``order`` of the outputs ``records``, all on one grid and with the same inputs.

    Each output is fitted by itself, since it has its own delay, and scaled by its standard deviation, so that units
    have no influence. ``samples``: length of the pulse response. Values that were not measured are interpolated
    linearly.
    """
    import control  # takes a second and loads the plot library: only where a model is identified

    pulses, scales = [], []
    for record, delay in zip(records, delays_s, strict=True):
        at = np.arange(record.grid.n)
        y = np.interp(at, at[record.rows], record.values[record.rows])
        u = on_grid(record.inputs, delay, record.grid).mean
        scales.append(float(y.std()))
        pulses.append(control.markov((y - y.mean())[None] / scales[-1], (u - u.mean(axis=0)).T, m=samples, dt=True))
    k = records[0].inputs.values.shape[1]
    response = np.stack([np.asarray(one).reshape(k, samples) for one in pulses])
    system, singular = control.eigensys_realization(response, r=order, dt=True)
    gains = np.asarray(control.dcgain(system)).reshape(len(records), k) * np.array(scales)[:, None]
    return Realization(np.asarray(system.poles()), gains.real, np.asarray(singular))
