"""Mitsuba for the tests that render: skipped with a reason where it is absent."""

from types import ModuleType

import pytest


def needs_mitsuba() -> ModuleType:
    """Return the witness's module that loads Mitsuba; skip the test file that calls this without it."""
    surfaces: ModuleType = pytest.importorskip("witness.mitsuba.surfaces")
    try:
        surfaces.load_mitsuba()
    except ImportError as error:
        pytest.skip(f"no Mitsuba: {error}; pip install -e '.[witness]'", allow_module_level=True)
    return surfaces
