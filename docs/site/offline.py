"""The built site loads nothing from elsewhere: no script, style, font, picture or frame of another address."""

import re
from pathlib import Path

LOADS = (
    re.compile(r"<(?:script|img|iframe|source|video|audio|embed)\b[^>]*\bsrc=[\"']?((?:https?:)?//[^\"'\s>]+)"),
    re.compile(r"<link\b(?![^>]*rel=[\"']?canonical)[^>]*\bhref=[\"']?((?:https?:)?//[^\"'\s>]+)"),
    re.compile(r"(?:url\(|@import\s+)[\"']?((?:https?:)?//[^\"')\s]+)"),
)
"""What a browser fetches by itself; links to follow (``<a href>``) are none."""


def outside_loads(site: Path) -> list[str]:
    """Return "file: address" for everything that a page or style sheet of ``site`` loads from elsewhere."""
    found = []
    for path in sorted(site.rglob("*")):
        if path.suffix in (".html", ".css", ".svg"):
            text = path.read_text(encoding="utf-8", errors="replace")
            found += [f"{path.relative_to(site)}: {hit}" for one in LOADS for hit in one.findall(text)]
    return found


def check(site: Path) -> None:
    """Raise SystemExit where something is loaded from elsewhere."""
    if found := outside_loads(site):
        raise SystemExit("the site would load from elsewhere:\n" + "\n".join(found[:20]))
