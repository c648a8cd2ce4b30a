"""Writes a certificate as PDF."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import matplotlib

from mosca.data.files.whole_file import whole_file
from mosca.errors import InputError
from reports.certificate.words import HEADINGS, KINDS, RULE, conclusion, hash_rows, rows_of, version_lines

FONTS = {"": "DejaVuSans.ttf", "B": "DejaVuSans-Bold.ttf"}
"""Fonts that come with matplotlib and have all signs of the figures."""
MARGIN_MM, TEXT_PT, SMALL_PT, TITLE_PT = 18, 9, 7, 16
NO_DAY = datetime(2000, 1, 1, tzinfo=UTC)


def check_pdf() -> None:
    """Raise InputError where the library that writes PDF is not installed."""
    try:
        import fpdf  # noqa: F401
    except ImportError:
        raise InputError(
            "certificate: a PDF needs fpdf2, which is not installed; run "
            "pip install 'mosca-testbench[certificate]', or leave --pdf out and print the page"
        ) from None


def write_certificate_pdf(path: Path, document: Mapping[str, Any]) -> None:
    """Write the PDF to ``path``, whole or not at all; the same document gives the same bytes."""
    from fpdf import FPDF

    sheet = FPDF(format="A4")
    day = document["issued"]
    sheet.creation_date = datetime.fromisoformat(day).replace(tzinfo=UTC) if day else NO_DAY
    sheet.set_title(document["title"])
    sheet.set_lang("en")
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for style, name in FONTS.items():
        sheet.add_font("dejavu", style, folder / name)
    sheet.set_margin(MARGIN_MM)
    sheet.set_auto_page_break(True, MARGIN_MM)
    sheet.add_page()
    _write(sheet, document)
    with whole_file(Path(path)) as temporary:
        temporary.write_bytes(bytes(sheet.output()))


def _write(sheet: Any, document: Mapping[str, Any]) -> None:
    head = [f"For {document['customer']}."] if document["customer"] else []
    head += [f"Issued on {document['issued']}."] if document["issued"] else []
    _text(sheet, " ".join([*head, f"Number {document['digest'][:16]}"]), SMALL_PT)
    _text(sheet, document["title"], TITLE_PT, bold=True)
    _text(sheet, document["verdict"].capitalize(), TITLE_PT, bold=True)
    _text(sheet, conclusion(document), TEXT_PT)
    for one in document["results"]:
        if not one["counts"]:
            continue
        _heading(sheet, f"{KINDS[one['kind']]}: {one['title']}")
        _table(sheet, HEADINGS, rows_of(one), (40, 17, 17, 13, 13))
        for key, value in one["conditions"]:
            _text(sheet, f"{key}: {value}", SMALL_PT)
    _text(sheet, RULE, SMALL_PT)
    for table in document["beside"]:
        _heading(sheet, f"{KINDS[table['kind']]}: side by side")
        rows = [("verdict", *(verdict or "–" for verdict in table["verdicts"]))]
        rows += [(row["what"], *row["cells"]) for row in table["rows"]]
        width = 60 // len(table["names"])
        _table(sheet, ("Figure", *table["names"]), rows, (40, *(width for _ in table["names"])))
    for table in document["history"]:
        _heading(sheet, f"History: {table['name']}")
        rows = [(row["commit"], row["verdict"] or "–", row["worst"]) for row in table["rows"]]
        _table(sheet, ("Commit", "Verdict", "Nearest to its limit"), rows, (20, 20, 60))
    _heading(sheet, "Not covered")
    for line in document["not_covered"]:
        _text(sheet, f"– {line}", TEXT_PT)
    _heading(sheet, "What went in")
    _table(sheet, ("What", "File", "SHA-256"), hash_rows(document), (18, 37, 45))
    for line in version_lines(document):
        _text(sheet, line, SMALL_PT)
    _text(sheet, f"SHA-256 of this certificate's content: {document['digest']}", SMALL_PT)


def _heading(sheet: Any, text: str) -> None:
    sheet.ln(3)
    _text(sheet, text, TEXT_PT + 2, bold=True)


def _text(sheet: Any, text: str, size: float, bold: bool = False) -> None:
    sheet.set_font("dejavu", "B" if bold else "", size)
    sheet.multi_cell(
        0, size * 0.5, text, new_x="LMARGIN", new_y="NEXT", align="L", wrapmode="CHAR" if " " not in text else "WORD"
    )


def _table(sheet: Any, headings: Sequence[str], rows: Sequence[Sequence[str]], widths: Sequence[int]) -> None:
    sheet.set_font("dejavu", "", SMALL_PT)
    with sheet.table(col_widths=tuple(widths), line_height=SMALL_PT * 0.5, wrapmode="CHAR") as table:
        for cells in (headings, *rows):
            row = table.row()
            for cell in cells:
                row.cell(str(cell))
