"""The folder of a certificate: JSON, page and PDF."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mosca.data.files.whole_file import write_text
from reports.certificate.page import write_certificate_page
from reports.certificate.pdf import write_certificate_pdf

RESULT, PAGE, PDF = "certificate.json", "certificate.html", "certificate.pdf"


def write_certificate(document: Mapping[str, Any], out: Path, pdf: bool) -> list[Path]:
    """Write the certificate, each file whole or not at all, and return the files for people."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / RESULT, json.dumps(document, indent=1, allow_nan=False) + "\n")
    write_certificate_page(out / PAGE, document)
    if not pdf:
        return [out / PAGE]
    write_certificate_pdf(out / PDF, document)
    return [out / PAGE, out / PDF]
