"""What the pages of docs/ tell a reader to type: blocks, command lines, and following a page word for word.

``python tests/docs/doc_pages.py PAGE ...`` follows pages and writes what is printed now, and the commit, into them.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
TUTORIALS = sorted(path for path in (DOCS / "tutorials").glob("*.md") if path.stem != "index")
PAGES = sorted(DOCS.rglob("*.md")) + [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]

FENCE = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^ {4}(mosca .*)$", re.MULTILINE)
SPAN = re.compile(r"(?<!`)`(mosca [^`]+)`")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
COMMIT = re.compile(r"(?<=Figures of commit `)[0-9a-f]+")
SHELLS = ("sh", "bash", "console")
ENDS = ("&&", "||", ";", "|", "&", "(", ")")
LEADS = ("do", "then", "time", "$")
SAME = 0.25
"""Figures of a page and of this run may differ by this share: another processor has other noise."""


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the file that it is to be saved as ("" for none), its text, where that begins."""

    language: str
    title: str
    text: str
    start: int


def blocks(text: str) -> list[Block]:
    """Return the fenced blocks of a page, in order."""
    return [Block(found[1], found[2] or "", found[3], found.start(3)) for found in FENCE.finditer(text)]


def commands(shell: str) -> list[list[str]]:
    """Return the words of each ``mosca`` command in lines for a shell, without ``mosca`` and redirections."""
    found = []
    for line in shell.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split, lexer.commenters = True, "#"
        words: list[str] = []
        for word in [*lexer, ";"]:
            if word not in ENDS:
                words.append(word)
                continue
            while words and words[0] in LEADS:
                words.pop(0)
            if words and words[0].split("/")[-1] == "mosca":
                end = next((k for k, one in enumerate(words) if one[0] in "<>"), len(words))
                found.append(words[1:end])
            words = []
    return found


def in_blocks(text: str) -> list[list[str]]:
    """Return the commands of a page that stand in blocks, fenced or indented: what a reader copies."""
    fenced = FENCE.sub("", text)
    shells = [block.text for block in blocks(text) if block.language in SHELLS]
    return [words for shell in [*shells, "\n".join(INDENTED.findall(fenced))] for words in commands(shell)]


def in_spans(text: str) -> list[list[str]]:
    """Return the commands that a page names between its words: parts may be left out there."""
    return [words for span in SPAN.findall(FENCE.sub("", text)) for words in commands(span.replace("\n", " "))]


def follow(path: Path, folder: Path) -> list[tuple[Block, str]]:
    """Save the files and run the commands of a page in an empty folder, as a reader does, with an empty home.

    Returns the blocks of output that the page shows, each with what was printed; AssertionError where a block of
    commands fails.
    """
    home, programs = folder / "home", folder / "bin"
    work = folder / "work"
    for one in (home, programs, work):
        one.mkdir()
    program = programs / "mosca"
    program.write_text(f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m scenarios.cli.main "$@"\n')
    program.chmod(0o755)
    bare = {"PATH": f"{programs}:{os.environ['PATH']}", "HOME": str(home), "LANG": "C.UTF-8", "OMP_NUM_THREADS": "1"}
    shown, printed = [], ""
    for block in blocks(path.read_text(encoding="utf-8")):
        if block.title:
            (work / block.title).write_text(block.text, encoding="utf-8")
        elif block.language in SHELLS:
            done = subprocess.run(
                ["bash", "-e", "-c", block.text],
                cwd=work, env=bare, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=1800,
            )  # fmt: skip
            assert done.returncode == 0, f"{path.name}:\n{block.text}{done.stdout}"
            printed = done.stdout
        elif block.language == "text":
            shown.append((block, printed))
    return shown


def matched(block: str, printed: str) -> list[str]:
    """Return the block with its lines as they were printed; "..." stands for any lines.

    AssertionError where a line has other words, or a figure that is farther off than ``SAME``.
    """
    left, new = printed.splitlines(), []
    for line in block.splitlines():
        if line == "...":
            new.append(line)
            continue
        words = _words(line)
        k = next((k for k, one in enumerate(left) if _words(one) == words), None)
        assert k is not None, f"nothing printed reads like '{line}':\n{printed}"
        new.append(left[k].rstrip())
        for one, other in zip(_figures(line), _figures(left[k]), strict=True):
            assert abs(one - other) <= SAME * max(abs(one), abs(other)), f"the page has '{line}', now: '{left[k]}'"
        left = left[k + 1 :]
    return new


def _words(line: str) -> list[str]:
    return NUMBER.sub("#", line).split()


def _figures(line: str) -> list[float]:
    return [float(one) for one in NUMBER.findall(line)]


def rewrite(path: Path) -> None:
    """Follow a page and write into it what is printed now, and the commit."""
    with tempfile.TemporaryDirectory() as folder:
        shown = follow(path, Path(folder))
    text = path.read_text(encoding="utf-8")
    for block, printed in reversed(shown):
        new = "\n".join(matched(block.text, printed)) + "\n"
        text = text[: block.start] + new + text[block.start + len(block.text) :]
    head = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    path.write_text(COMMIT.sub(head.stdout.strip(), text), encoding="utf-8")


if __name__ == "__main__":
    for name in sys.argv[1:]:
        rewrite(Path(name))
