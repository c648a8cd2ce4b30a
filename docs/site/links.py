"""Links between files of the repository, and what they become on the site.

Outside the site's folder lie scenario files (shown in the gallery), other source files (shown as a page with their
text) and the root's own pages. A link that leads nowhere is left as it is: the build reports it.
"""

import os
import re
from pathlib import Path, PurePosixPath

LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
LIBRARY = "scenarios/library/"
ROOT_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "DECISIONS.md": "decisions.md",
    "CONTRIBUTING.md": "contributing.md",
}


def from_root(text: str) -> str:
    """Return a page of the repository's root as it stands in the site's root: its links are relative to ``docs``."""

    def turned(found: re.Match[str]) -> str:
        target = found[2]
        if "://" in target:
            return found[0]
        return f"{found[1]}{target.removeprefix('docs/') if target.startswith('docs/') else '../' + target}{found[3]}"

    return LINK.sub(turned, text)


def on_site(root: Path, text: str, uri: str) -> str:
    """Return the text of the page ``uri`` with links that lead out of ``docs`` turned into links on the site."""

    def turned(found: re.Match[str]) -> str:
        there = _outside(root, uri, found[2])
        if there is None:
            return found[0]
        page, anchor = _page(root, there)
        return f"{found[1]}{os.path.relpath(page, PurePosixPath(uri).parent)}{anchor or found[3][:-1]})"

    return LINK.sub(turned, text)


def source_pages(root: Path, texts: dict[str, str]) -> dict[str, str]:
    """Return a page for each source file that ``texts`` (page -> Markdown) link to."""
    made: dict[str, str] = {}
    for uri, text in texts.items():
        for found in LINK.finditer(text):
            there = _outside(root, uri, found[2])
            if there is not None and _page(root, there)[0].startswith("source/"):
                language = PurePosixPath(there).suffix.lstrip(".") or "text"
                content = (root / there).read_text(encoding="utf-8")
                made[f"source/{there}.md"] = f"# {there}\n\n````{language}\n{content}````\n"
    return made


def _outside(root: Path, uri: str, target: str) -> str | None:
    """Return the path below ``root`` of what a page links to, None where that lies in ``docs`` or nowhere."""
    if "://" in target or not target.startswith("../"):
        return None
    path = os.path.normpath(PurePosixPath("docs", uri).parent / target)
    return path if not path.startswith(("docs/", "..")) and (root / path).exists() else None


def _page(root: Path, path: str) -> tuple[str, str]:
    """Return page and anchor that show a file or folder of the repository."""
    if path in ROOT_PAGES:
        return ROOT_PAGES[path], ""
    if path.startswith(LIBRARY):
        folder, _, name = path.removeprefix(LIBRARY).partition("/")
        if path.endswith(".toml"):
            return f"gallery/{folder}.md", f"#{Path(name).stem}"
        if (root / path).is_dir() and not name:
            return f"gallery/{folder}.md", ""
    return f"source/{path}.md", ""
