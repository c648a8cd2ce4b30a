"""The folder of a campaign's result: JSON and a page."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mosca.data.files.whole_file import check_folder, write_text
from mosca.errors import InputError
from reports.claim.page import write_claim_page

RESULT, PAGE = "result.json", "claim.html"


def check_out(out: Path) -> None:
    """Raise InputError where ``out`` cannot become a claim's folder; ask before the runs, not after them."""
    if out.is_file():
        raise InputError(f"{out}: is a file; choose a folder with --out")
    if out.exists() and not (out / RESULT).exists() and any(out.iterdir()):
        raise InputError(f"{out}: holds other files and no {RESULT}; choose a new folder with --out")
    check_folder(out)


def write_result(document: Mapping[str, Any], out: Path) -> None:
    """Write result and page, each whole or not at all; the same document gives the same bytes."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / RESULT, json.dumps(document, indent=1, allow_nan=False) + "\n")
    write_claim_page(out / PAGE, document)
