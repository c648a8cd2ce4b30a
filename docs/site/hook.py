"""Hook of MkDocs: adds the pages that are made from code and files, and keeps links into the repository whole.

Nothing that is made here is committed: the source of a page is what it is about.
"""

from pathlib import Path
from typing import Any

import commands
import gallery
import links
import notebooks
import offline
import python_pages
import schemas
import terms
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
COPIES = {
    "index.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "decisions.md": "DECISIONS.md",
    "contributing.md": "CONTRIBUTING.md",
}
"""Pages of the site that are files of the repository's root."""

SHIM = "https://unpkg.com/iframe-worker/shim"
VENDORED = "site/vendor/iframe-worker-1.0.4.js"
"""The same (MIT, 1 kB), unchanged from npm's package but for the name."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and pictures."""
    made: dict[str, str | bytes] = {}
    for page, name in COPIES.items():
        made[page] = links.from_root((ROOT / name).read_text(encoding="utf-8"))
    made |= commands.pages() | schemas.pages() | terms.pages(ROOT) | python_pages.pages() | gallery.pages(ROOT)
    made |= notebooks.pages(ROOT)
    written = {file.src_uri: Path(file.abs_src_path or "") for file in files.documentation_pages()}
    texts = {uri: path.read_text(encoding="utf-8") for uri, path in written.items()}
    texts |= {uri: text for uri, text in made.items() if isinstance(text, str)}
    made |= links.source_pages(ROOT, texts)
    for uri, content in made.items():
        files.append(File.generated(config, uri, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files of the repository into links to the pages that show them."""
    return links.on_site(ROOT, markdown, page.file.src_uri)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Load from the site what Material's offline plugin would fetch: search in a site opened from a disk."""
    return output.replace(SHIM, "/".join([*[".."] * page.file.src_uri.count("/"), VENDORED]))


def on_post_template(output_content: str, template_name: str, config: MkDocsConfig) -> str:
    """Do the same in 404.html."""
    return output_content.replace(SHIM, VENDORED)


def on_post_build(config: MkDocsConfig, **_: Any) -> None:
    """Refuse a site that would load anything from elsewhere."""
    offline.check(Path(config.site_dir))
