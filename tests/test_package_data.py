"""Files that are no Python sources are in what pip installs, not only in a checkout."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PATTERNS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["package-data"]
PACKAGES = sorted(path.parent.name for path in ROOT.glob("*/__init__.py"))
OF_A_CHECKOUT = ("reports/baselines/",)
"""What only work on the project itself needs."""


@pytest.mark.parametrize("package", PACKAGES)
def test_files_of_a_package_are_installed(package):
    installed = {path for pattern in PATTERNS.get(package, ()) for path in (ROOT / package).glob(pattern)}
    needed = {
        path
        for path in (ROOT / package).rglob("*")
        if path.is_file()
        and path.suffix not in (".py", ".pyc", ".nbi", ".nbc")
        and not path.relative_to(ROOT).as_posix().startswith(OF_A_CHECKOUT)
    }
    assert not {path.relative_to(ROOT).as_posix() for path in needed - installed}
