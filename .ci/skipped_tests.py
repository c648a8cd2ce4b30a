"""Prints the test files that pytest's output says something was skipped in, for another reason than being slow.

``python3 .ci/skipped_tests.py OUTPUT``. Where the reason lies in a helper (``tests/hardware/needs.py``), these are
the test files beside it that name the helper. Exit code 1 where the output has no summary of a run.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINE = re.compile(r"^SKIPPED \[\d+\] ([\w/.-]+\.py)(?::\d+)?: (.*)$", re.MULTILINE)
SUMMARY = re.compile(r"^=+ .*\d+ passed", re.MULTILINE)
LATER = "slow: pytest --tier full runs it"


def skipped_files(output: str) -> list[str]:
    """Return the test files, relative to the project, in order."""
    found: set[str] = set()
    for name, reason in LINE.findall(output):
        path = ROOT / name
        if reason.startswith(LATER) or not path.exists():
            continue
        if path.name.startswith("test_"):
            found.add(name)
            continue
        helper = re.compile(rf"\b{re.escape(path.stem)}\b")
        beside = [one for one in path.parent.glob("test_*.py") if helper.search(one.read_text(encoding="utf-8"))]
        found |= {str(one.relative_to(ROOT)) for one in beside}
    return sorted(found)


if __name__ == "__main__":
    text = Path(sys.argv[1]).read_text(encoding="utf-8", errors="replace")
    if not SUMMARY.search(text):
        sys.exit(f"{sys.argv[1]}: no summary of a run of pytest")
    print("\n".join(skipped_files(text)))
