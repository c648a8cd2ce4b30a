"""Pages of words: what each metric means (from ``reports/glossary.py``), and the terms of the project."""

from pathlib import Path

import commands
from markdown_text import cell

from reports.glossary import GLOSSARY
from reports.metrics import kind_of

LEAD = """\
# Metrics

What `record.json`, the page of a run and `[limits]` of a scenario call by these names. Lengths are in metres in a
record, and in the unit that reads best on a page. In a scenario a limit is a number in the unit below, or a text with
its unit: `position_rms = "0.5 mm"`.

| metric | unit | meaning | how it is computed |
|---|---|---|---|
"""
REFERENCE = """\
# Reference

Made from the code: the command line, the schemas, the docstrings. [Functions and types](python.md) of the library,
[scenario](scenario.md), [rig](rig.md), [target](target.md) and [marker-model](marker_model.md) files,
[metrics](metrics.md), and these commands:

"""


def pages(root: Path) -> dict[str, str]:
    """Return the pages of metrics and terms, and the front page of the reference (uri -> Markdown)."""
    rows = []
    for name, term in sorted(GLOSSARY.items()):
        kind = kind_of(name)
        unit = "" if kind is None else "share" if kind.quantity == "share" else kind.unit
        rows.append(f'| <a id="{name}"></a>`{name}` | {unit} | {term.sentence} | {cell(term.formula)} |')
    terms = (root / "CONTRIBUTING.md").read_text(encoding="utf-8").split("## Glossary\n", 1)[1].split("\n## ")[0]
    more = "What metrics mean: [metrics](../reference/metrics.md)."
    return {
        "reference/metrics.md": LEAD + "\n".join(rows) + "\n",
        "reference/index.md": REFERENCE + commands.index() + "\n",
        "explanations/glossary.md": f"# Glossary\n{terms}\n\n{more}\n",
    }
