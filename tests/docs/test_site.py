"""The documentation site: what its hook makes of files, and (where MkDocs is installed) the whole site, strictly."""

import importlib
import json
import re
import subprocess
import sys

import pytest
from doc_pages import ROOT

from reports.glossary import GLOSSARY
from scenarios.spec.catalog import built_in
from scenarios.spec.scenario import scenario_schema


@pytest.fixture(scope="module")
def made():
    """The modules of the site's hook that need no MkDocs, by name."""
    sys.path.insert(0, str(ROOT / "docs" / "site"))
    try:
        yield {
            name: importlib.import_module(name)
            for name in ("commands", "gallery", "links", "offline", "schemas", "terms")
        }
    finally:
        sys.path.remove(str(ROOT / "docs" / "site"))


def test_every_scenario_is_in_the_gallery(made):
    pages = made["gallery"].pages(ROOT)
    for path in built_in():
        page = pages[f"gallery/{path.parent.name}.md"]
        assert f"{{ #{path.stem} }}" in page
        assert f"`mosca run {path.parent.name}/{path.stem}`" in page
    baseline = json.loads((ROOT / "reports/baselines/subjects/actor.json").read_text(encoding="utf-8"))
    (rms,) = (one["value"] for one in baseline["metrics"] if one["name"] == "position_rms")
    assert f"| {1e3 * rms:.3f} mm |" in pages["gallery/subjects.md"]


def test_the_navigation_names_every_page(made):
    """``mkdocs build --strict`` asks for it; that is run at night."""
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
    named = set(re.findall(r"[\w/-]+\.md", nav))
    docs = ROOT / "docs"
    written = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}
    generated = set(made["gallery"].pages(ROOT)) | set(made["commands"].pages())
    assert sorted(one for one in written | generated if one.endswith(".md") and one not in named) == []
    depths = {len(line) - len(line.lstrip()) for line in nav.splitlines() if line.lstrip().startswith("- ")}
    assert depths <= {2, 6, 10}


def test_every_key_of_a_scenario_is_in_the_reference(made):
    page = made["schemas"].pages()["reference/scenario.md"]
    schema = scenario_schema()
    tables = [schema, *schema["$defs"].values()]
    keys = {key for one in tables for key in one.get("properties", {})}
    assert {key for key in keys if f"| `{key}` |" not in page} == set()
    assert '### `[scene] kind = "own"`' in page.replace("\n## ", "\n### ")
    assert "| `exposure_s` | number > 0 |" in page


def test_every_metric_is_in_the_reference(made):
    page = made["terms"].pages(ROOT)["reference/metrics.md"]
    assert {name for name in GLOSSARY if f"`{name}`" not in page} == set()


@pytest.mark.parametrize(
    ("link", "on_site"),
    [
        ("../scenarios/library/subjects/actor.toml", "gallery/subjects.md#actor"),
        ("../scenarios/library/calibration", "gallery/calibration.md"),
        ("../twin/source.py", "source/twin/source.py.md"),
        ("../CONTRIBUTING.md#glossary", "contributing.md#glossary"),
        ("people.md#live", "people.md#live"),
        ("../nowhere.py", "../nowhere.py"),
        ("https://example.org/a.md", "https://example.org/a.md"),
    ],
)
def test_links_out_of_the_docs_lead_to_pages(made, link, on_site):
    assert made["links"].on_site(ROOT, f"[a]({link})", "page.md") == f"[a]({on_site})"


def test_links_of_the_root_are_taken_from_docs(made):
    text = made["links"].from_root(
        "[a](docs/people.md#live) [b](LICENSE) ![c](docs/pictures/x.webp) [d](https://e.org) [e](#f)"
    )
    assert text == "[a](people.md#live) [b](../LICENSE) ![c](pictures/x.webp) [d](https://e.org) [e](#f)"


@pytest.mark.parametrize(
    "loaded",
    [
        '<script src="https://unpkg.com/x.js"></script>',
        '<link rel="stylesheet" href="//fonts.example/css">',
        '<img alt="" src="http://example.org/a.png">',
        "<style>@import 'https://example.org/a.css';</style>",
        "<style>a { background: url(https://example.org/a.png) }</style>",
    ],
)
def test_what_is_loaded_from_elsewhere_is_found(made, tmp_path, loaded):
    kept = '<a href="https://example.org">to follow</a><script src="a.js"></script><img src="data:image/png;base64,">'
    page = tmp_path / "index.html"
    page.write_text(kept)
    assert made["offline"].outside_loads(tmp_path) == []
    page.write_text(kept + loaded)
    assert len(made["offline"].outside_loads(tmp_path)) == 1
    with pytest.raises(SystemExit):
        made["offline"].check(tmp_path)


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs", reason="pip install -e '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path / "site"],
        cwd=ROOT, capture_output=True, text=True, timeout=1800,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "mosca-reconstruct" in (tmp_path / "site/reference/commands/trajectories.html").read_text(encoding="utf-8")
