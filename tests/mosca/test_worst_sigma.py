"""Samples that are too uncertain are left out, counted, and still followed."""

from dataclasses import replace

import numpy as np

from mosca.data.tracks import Samples


def samples(covariance: np.ndarray) -> Samples:
    n = len(covariance)
    none = Samples.none()
    return replace(
        none, frame=np.zeros(n, np.int64), time_ns=np.zeros(n, np.int64), track=np.arange(n), xyz=np.zeros((n, 3)),
        covariance=covariance, n_cameras=np.full(n, 2), residual_px=np.zeros(n), status=np.zeros(n, np.int8),
    )  # fmt: skip


def test_the_largest_standard_deviation_decides() -> None:
    draw = np.random.default_rng(3)
    turned = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    # by hand: 1, 1 and 0.9 mm have a trace's root of 1.68 mm, and 1.6 mm across them all is a longer ellipsoid
    sigmas = np.array([[1.0, 1.0, 0.9], [0.1, 0.1, 1.6], [0.2, 0.2, 0.2]]) * 1e-3
    covariance = turned @ (sigmas[:, :, None] ** 2 * np.eye(3)) @ turned.T
    assert samples(covariance).certain(1.5e-3).track.tolist() == [0, 2]
    assert samples(covariance).certain(np.inf).track.tolist() == [0, 1, 2]
    assert len(Samples.none().certain(1e-3)) == 0
