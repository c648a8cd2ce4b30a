"""What CI runs again once more is installed: the files in which the newcomer's run skipped something."""

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / ".ci" / "skipped_tests.py"
specification = importlib.util.spec_from_file_location("skipped_tests", SCRIPT)
skipped_tests = importlib.util.module_from_spec(specification)
specification.loader.exec_module(skipped_tests)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("SKIPPED [4] tests/mosca/test_proptv.py:168: no data", ["tests/mosca/test_proptv.py"]),
        ("SKIPPED [1] tests/mosca/test_proptv.py:168: slow: pytest --tier full runs it", []),
        ("SKIPPED [1] tests/mosca/test_proptv.py: whole module", ["tests/mosca/test_proptv.py"]),
        ("PASSED tests/mosca/test_proptv.py:168: no data", []),
        ("SKIPPED [1] tests/mosca/test_gone.py:1: no data", []),
    ],
)
def test_files_are_found_by_their_reason(line, found):
    assert skipped_tests.skipped_files(f"....\n{line}\n== 3 passed in 1 s ==\n") == found


def test_a_helper_stands_for_the_files_that_name_it():
    found = skipped_tests.skipped_files("SKIPPED [2] tests/hardware/needs.py:15: no pypylon\n")
    assert "tests/hardware/test_drivers_pylon.py" in found
    assert all(name.startswith("tests/hardware/test_") for name in found)
    assert "tests/hardware/test_counting.py" not in found
