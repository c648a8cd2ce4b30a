"""Words of other files as Markdown: shown as they are."""


def plain(text: str) -> str:
    """Return a paragraph on one line, no sign of it taken for markup."""
    return " ".join(text.split()).replace("<", "&lt;").replace("*", "\\*").replace("[", "\\[")


def cell(text: str) -> str:
    """Return Markdown that may stand in a cell of a table."""
    return text.replace("|", "\\|")


def plain_cell(text: str) -> str:
    """Return words, shown as they are, that may stand in a cell of a table."""
    return cell(plain(text))
