"""Every link of a page leads to a file of the repository, and to a heading where it names one."""

import re

import pytest
from doc_pages import FENCE, PAGES, ROOT

LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.*?)(?: \{.*\})?$", re.MULTILINE)
MADE = ("reference", "gallery")
"""Folders of pages that the site's hook makes: ``mkdocs build --strict`` looks at links into them."""


def anchors(text):
    """Return the anchors of a page's headings, as GitHub makes them."""
    titles = HEADING.findall(FENCE.sub("", text))
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]", "", title)).strip().lower().replace(" ", "-") for title in titles}


def broken(path, text):
    """Yield the links of a page that lead nowhere."""
    for target in LINK.findall(re.sub(r"`[^`\n]*`", "", FENCE.sub("", text))):
        name, _, anchor = target.partition("#")
        there = (path.parent / name).resolve() if name else path
        if "://" in target or (
            there.is_relative_to(ROOT / "docs") and there.relative_to(ROOT / "docs").parts[0] in MADE
        ):
            continue
        if not there.exists() or (anchor and anchor not in anchors(there.read_text(encoding="utf-8"))):
            yield target


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    assert list(broken(path, path.read_text(encoding="utf-8"))) == []


def test_a_broken_link_is_found():
    page = ROOT / "docs" / "page.md"
    text = "[a](nowhere.md) [b](limits.md) [c](people.md#runing) [d](people.md#running) [e](https://e.org) `[f](g)`"
    assert list(broken(page, text)) == ["nowhere.md", "people.md#runing"]
