"""Pages of the notebooks: scripts in the percent format, which Jupyter opens with jupytext."""

from pathlib import Path

LEAD = """
*`docs/notebooks/{name}.py`: run it as a script, cell by cell in an editor, or as a notebook
(`jupytext --to ipynb docs/notebooks/{name}.py`). It runs each night.*
"""


def pages(root: Path) -> dict[str, str]:
    """Return a page for each notebook (uri -> Markdown)."""
    made = {}
    for path in sorted((root / "docs" / "notebooks").glob("*.py")):
        heading, *others = (_cell(cell) for cell in path.read_text(encoding="utf-8").split("# %%")[1:])
        title, _, words = heading.partition("\n")
        made[f"notebooks/{path.stem}.md"] = "\n".join([title, LEAD.format(name=path.stem), words, *others])
    return made


def _cell(cell: str) -> str:
    """Return a cell as Markdown: its words, or its code in a block."""
    kind, _, text = cell.partition("\n")
    if "[markdown]" in kind:
        return "\n".join(line.removeprefix("#").removeprefix(" ") for line in text.strip().splitlines()) + "\n"
    return f"```python\n{text.strip()}\n```\n"
