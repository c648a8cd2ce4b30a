"""The vibrating panel: closed forms of its modes, the size of its response, and what the cameras are shown of it."""

import numpy as np
import pytest

from mosca.errors import InputError
from twin.scenes.panel import build_panel
from twin.scenes.plate import ThinPlate, random_response
from twin.scenes.scene import Scene

STEEL = ThinPlate((0.6, 0.4), 0.0009, 210e9, 0.3, 7850.0)
XY = np.array([[0.3, 0.2], [0.15, 0.2], [0.3, 0.1]])


def panel(**changed: object) -> Scene:
    """Return a panel of three modes for a second."""
    given: dict[str, object] = {
        "duration_s": 1.0,
        "box_center_m": np.array([0.0, 0.0, 0.5]),
        "box_size_m": np.array([0.64, 0.44, 0.1]),
        "rng": np.random.default_rng(1),
        "size_m": (0.6, 0.4),
        "plate": STEEL,
        "damping": (0.02, 0.02, 0.02),
        "grid": (6, 5),
        "target_diameter_m": 0.01,
        "rms_m": 0.0002,
        "band_hz": (5.0, 95.0),
    }
    return build_panel(**given | changed)  # type: ignore[arg-type]


def test_frequencies_are_those_of_the_textbook() -> None:
    # Leissa (1969): omega a^2 sqrt(rho h / D) = pi^2 (m^2 + n^2 a^2 / b^2): 32.08, 61.69, 98.70, 111.03, 128.30 at
    # a / b = 1.5; D = 210e9 0.0009^3 / (12 0.91) = 14.0192 N m, rho h = 7.065 kg/m^2
    unit = np.sqrt(14.0192 / 7.065) / 0.36 / (2 * np.pi)
    modes = STEEL.modes(XY, 5, np.full(5, 0.01))
    np.testing.assert_allclose(modes.frequency_hz / unit, [32.08, 61.69, 98.70, 111.03, 128.30], rtol=2e-4)


def test_shapes_and_slopes_at_the_middle_and_beside_it() -> None:
    modes = STEEL.modes(XY, 3, np.full(3, 0.01))
    # sin(pi x / a) sin(pi y / b), sin(2 pi x / a) sin(pi y / b), sin(pi x / a) sin(2 pi y / b)
    expected = [[1, 0, 0], [np.sqrt(0.5), 1, 0], [np.sqrt(0.5), 0, 1]]
    np.testing.assert_allclose(modes.shapes, expected, atol=1e-12)
    np.testing.assert_allclose(modes.slopes[0, 1], [-2 * np.pi / 0.6, 0.0], atol=1e-12)
    step = 1e-6
    moved = STEEL.modes(XY + [step, 0.0], 3, np.full(3, 0.01))
    np.testing.assert_allclose((moved.shapes - modes.shapes) / step, modes.slopes[..., 0], atol=1e-4)


def test_the_response_is_as_large_as_white_forces_make_it() -> None:
    modes = STEEL.modes(XY, 2, np.full(2, 0.05))
    response = random_response(modes, (1.0, 400.0), 2e-4, (0.0, 200.0), np.random.default_rng(5))
    q = np.array([response(t) for t in np.arange(0.0, 200.0, 0.01)])
    # mean squares go with 1 / (zeta w^3); 2 pi f zeta T = 1257 and more: 3 % for 1 sigma of a mean square
    w = 2 * np.pi * modes.frequency_hz
    share = w**-3 / np.sum(w**-3)
    np.testing.assert_allclose(q.var(axis=0), 4e-8 * share, rtol=0.12)


def test_the_response_solves_the_equation_of_motion() -> None:
    modes = STEEL.modes(XY, 2, np.full(2, 0.02))
    response = random_response(modes, (5.0, 95.0), 2e-4, (0.0, 1.0), np.random.default_rng(5))
    # within one step of the force, and across the next
    h = response.step_s / 8
    for k in (100, 101):
        t = response.first_s + (k + 0.5) * response.step_s
        before, here, after = response(t - h), response(t), response(t + h)
        w = 2 * np.pi * modes.frequency_hz
        force = (after - 2 * here + before) / h**2 + 2 * modes.damping * w * (after - before) / (2 * h) + w**2 * here
        np.testing.assert_allclose(force, response.force[k], atol=1e-3 * np.abs(response.force).max())


def test_targets_go_with_the_sheet_and_turn_with_its_slope() -> None:
    scene = panel()
    assert scene.modes is not None
    sampler = scene.sampler()
    state = sampler.at(0.37)
    q = scene.configuration_at.response(0.37)  # type: ignore[attr-defined]
    np.testing.assert_allclose(state.marker_xyz[:, 2] - 0.5, scene.modes.shapes @ q, atol=1e-9)
    slope = np.einsum("mki,k->mi", scene.modes.slopes, q)
    np.testing.assert_allclose(state.marker_axis[:, :2], -slope, atol=1e-6)


def test_the_carrier_shakes_all_targets_as_one_body() -> None:
    scene = panel(shake_m=0.002, rms_m=1e-9)
    places = [scene.sampler().at(t).marker_xyz for t in (0.1, 0.6)]
    apart = [np.linalg.norm(xyz[:, None] - xyz[None], axis=-1) for xyz in places]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-7)
    assert np.abs(places[0] - places[1]).max() > 5e-4


@pytest.mark.parametrize(
    ("changed", "told"),
    [({"size_m": (0.7, 0.4)}, "scene.size_m"), ({"target_diameter_m": 0.09}, "target_diameter_m = 0.09")],
)
def test_what_does_not_fit_is_refused(changed: dict[str, object], told: str) -> None:
    with pytest.raises(InputError, match=told):
        panel(**changed)
