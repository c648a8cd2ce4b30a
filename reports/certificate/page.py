"""Writes a certificate as one self-contained HTML file that opens offline and prints."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reports.certificate.words import HEADINGS, KINDS, RULE, conclusion, hash_rows, rows_of, version_lines
from reports.claim.page import BADGES
from reports.page import write_rendered


def write_certificate_page(path: Path, document: Mapping[str, Any]) -> None:
    """Write the page to ``path``, whole or not at all; the same document gives the same bytes."""
    write_rendered(
        path,
        "certificate/certificate.html.j2",
        document=document,
        badge=BADGES[document["verdict"]],
        badges=BADGES,
        conclusion=conclusion(document),
        kinds=KINDS,
        headings=HEADINGS,
        rule=RULE,
        results=[(one, rows_of(one)) for one in document["results"] if one["counts"]],
        hashes=hash_rows(document),
        versions=version_lines(document),
    )
