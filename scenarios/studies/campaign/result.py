"""The folder of a campaign's result: JSON and a page."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mosca.data.files.whole_file import write_text
from reports.claim.page import write_claim_page

RESULT, PAGE = "result.json", "claim.html"


def write_result(document: Mapping[str, Any], out: Path) -> None:
    """Write result and page, each whole or not at all; the same document gives the same bytes."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / RESULT, json.dumps(document, indent=1, allow_nan=False) + "\n")
    write_claim_page(out / PAGE, document)
