"""What a test needs of the machine: skipped with a reason where it is absent, failed where CI should have it."""

import ctypes
import importlib
import os
import warnings
from types import ModuleType

import pytest


def _absent(reason: str) -> None:
    if os.environ.get("MOSCA_CI"):
        pytest.fail(f"{reason}, and this is CI, which installs it")
    pytest.skip(reason)


def needs_aravis() -> None:
    """Skip, or fail in CI, without libaravis-0.8."""
    try:
        ctypes.CDLL("libaravis-0.8.so.0")
    except OSError:
        _absent("libaravis-0.8.so.0 is not installed (Debian: apt install libaravis-0.8-0)")


def needs_module(name: str, extra: str = "", package: str = "") -> ModuleType:
    """Return module ``name`` of the project's ``extra`` or of ``package``; skip, or fail in CI, without it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            return importlib.import_module(name)
    except ImportError:
        wanted = package or f"mosca-testbench[{extra}]"
        _absent(f"{name} is not installed (pip install '{wanted}')")
        raise
