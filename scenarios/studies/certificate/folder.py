"""The folder of a certificate: JSON, page and PDF."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mosca.data.files.whole_file import check_folder, write_text
from mosca.errors import InputError
from reports.certificate.page import write_certificate_page
from reports.certificate.pdf import write_certificate_pdf

RESULT, PAGE, PDF = "certificate.json", "certificate.html", "certificate.pdf"


def check_out(out: Path) -> None:
    """Raise InputError where ``out`` cannot become a certificate's folder; ask before the work, not after it."""
    if out.is_file():
        raise InputError(f"{out}: is a file; choose a folder with --out")
    if out.exists() and not (out / RESULT).exists() and any(out.iterdir()):
        raise InputError(f"{out}: holds other files and no {RESULT}; choose a new folder with --out")
    check_folder(out)


def write_certificate(document: Mapping[str, Any], out: Path, pdf: bool) -> list[Path]:
    """Write the certificate, each file whole or not at all, and return the files for people."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / RESULT, json.dumps(document, indent=1, allow_nan=False) + "\n")
    write_certificate_page(out / PAGE, document)
    if not pdf:
        return [out / PAGE]
    write_certificate_pdf(out / PDF, document)
    return [out / PAGE, out / PDF]
