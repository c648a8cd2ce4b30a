"""Modes from displacements beside those of pyOMA-2, an outside program for operational modal analysis.

Pasca, Aloisio, Rosso and Sotiropoulos, PyOMA and PyOMA_GUI, SoftwareX 2022. It is given the same samples.
"""

import numpy as np
import pytest
from vibration_records import FREQUENCIES_HZ, RATE_HZ, plate_shapes, plate_values, record_of

from mosca.machines.vibration.analysis import analyse
from mosca.machines.vibration.modal import mac

algorithms = pytest.importorskip("pyoma2.algorithms", reason="pyOMA-2 is not installed (bench extra)")
setups = pytest.importorskip("pyoma2.setup", reason="pyOMA-2 is not installed (bench extra)")
pytestmark = pytest.mark.slow


def test_frequencies_damping_and_shapes_are_those_of_pyoma() -> None:
    values = plate_values(60.0, 3)
    single = setups.SingleSetup(values, fs=RATE_HZ)
    algorithm = algorithms.SSI(name="ssi", method="cov", br=30, ordmin=0, ordmax=40)
    single.add_algorithms(algorithm)
    single.run_by_name("ssi")
    single.mpe("ssi", sel_freq=list(FREQUENCIES_HZ), order_in=10, rtol=0.02)
    result = algorithm.result
    own = analyse(record_of(values)).modes
    assert len(own) == len(FREQUENCIES_HZ)
    for k, mode in enumerate(own):
        # the same record: less than the error of either; theirs goes from order to order by as much as ours states
        assert mode.frequency_hz == pytest.approx(float(result.Fn[k]), abs=3 * mode.frequency_sigma_hz)
        assert mode.damping == pytest.approx(float(result.Xi[k]), abs=3 * mode.damping_sigma)
        theirs = np.asarray(result.Phi)[:, k]
        assert mac(mode.shape[:, None], theirs[:, None])[0, 0] > 0.98
        assert (
            mac(mode.shape[:, None], plate_shapes()[:, [k]])[0, 0]
            > mac(theirs[:, None], plate_shapes()[:, [k]])[0, 0] - 0.01
        )
