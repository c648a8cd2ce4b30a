"""The tutorials, word for word: files saved, commands run in order, output as the pages show it."""

import re

import pytest
from doc_pages import DOCS, TUTORIALS, blocks, commands, follow, matched

from reports.record import read_record


@pytest.mark.slow
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_leads_where_it_says(path, tmp_path):
    for block, printed in follow(path, tmp_path):
        matched(block.text, printed)
    work = tmp_path / "work"
    text = path.read_text(encoding="utf-8")
    # every page that a reader is told to open, and every file that the text names with its folder, is there
    named = set(re.findall(r"`((?:runs|accuracy)/[\w/]+\.\w+|comparison\.html|suite\.xml)`", text))
    assert {name for name in named if not (work / name).exists()} == set()
    # calibrations that several runs share, and matplotlib's list of fonts: nothing else is left at a reader's home
    assert {one.name for one in (tmp_path / "home").iterdir()} <= {".cache", ".config"}
    if path.stem == "camera_count":
        # twice the rays give at best 1 / sqrt(2) of the error; a common calibration leaves more
        few, many = (
            read_record(work / f"runs/cameras/study/cameras.count={n}/record.json").metric("position_rms").value
            for n in (3, 6)
        )
        assert many < few


def test_the_list_of_tutorials_is_whole():
    index = (DOCS / "tutorials" / "index.md").read_text(encoding="utf-8")
    assert {path.name for path in TUTORIALS} == set(re.findall(r"\]\((\w+\.md)\)", index))


def test_output_is_compared_word_by_word():
    printed = "a 1.00 mm\nb 2 px\nc done\nd 5"
    assert matched("...\nb 2.1 px\nd 5.5\n", printed) == ["...", "b 2 px", "d 5"]
    for wrong in ("b 2 mm", "d 5\na 1", "b 3 px", "e"):
        with pytest.raises(AssertionError):
            matched(wrong, printed)


def test_blocks_are_read_as_a_reader_does(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        '```toml title="a.toml"\nx = 1\n```\nThen\n```sh\ncat a.toml > b && cat b\n```\n```text\nx = 1\n```\n'
    )
    (tmp_path / "f").mkdir()
    ((block, printed),) = follow(page, tmp_path / "f")
    assert (block.text, printed) == ("x = 1\n", "x = 1\n")
    page.write_text("```sh\nfalse\ntrue\n```\n")
    (tmp_path / "g").mkdir()
    with pytest.raises(AssertionError):
        follow(page, tmp_path / "g")
    assert commands("a; mosca run x \\\n  --out y > z || mosca list # mosca no") == [
        ["run", "x", "--out", "y"],
        ["list"],
    ]
    assert blocks("```sh\na\n```\n```python\nb\n```\n")[1].language == "python"
