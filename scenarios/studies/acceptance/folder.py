"""The folder of an acceptance test: JSON and a page."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mosca.data.files.whole_file import write_text
from reports.acceptance.page import write_acceptance_page

RESULT, PAGE = "acceptance.json", "acceptance.html"


def write_acceptance(document: Mapping[str, Any], out: Path) -> None:
    """Write result and page, each whole or not at all; the same document gives the same bytes."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / RESULT, json.dumps(document, indent=1, allow_nan=False) + "\n")
    write_acceptance_page(out / PAGE, document)
