"""The documentation as a site: Sphinx over the files of this folder, without a network. `make docs` builds it."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS)]

import reference  # noqa: E402

from engine import __version__  # noqa: E402

try:
    from tests.support.documents.ages import with_ages
except ImportError:  # no checkout, as in the image's build

    def with_ages(text: str) -> str:
        """Return a page as it is: without the history the age of figures is not known."""
        return text


project, author, release = "Tidegate", "Tidegate", __version__
copyright = "Tidegate, Apache-2.0"  # noqa: A001 - Sphinx's name
root_doc = "README"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"Tidegate {__version__}"
html_show_sphinx = html_show_sourcelink = html_copy_source = False
templates_path: list[str] = []
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # names of the engine are described in the code, not here
myst_heading_anchors = 4
myst_enable_extensions = ["attrs_inline"]
autodoc_typehints = "signature"
autodoc_mock_imports = [] if find_spec("pytest") else ["pytest"]  # of the image's build: tidegate.testing is for tests
autodoc_member_order = "bysource"
napoleon_google_docstring = False
suppress_warnings = ["myst.header"]  # tables made by the code begin below a page's second level
MADE = {
    "4-integrate/python": reference.python_names,
    "4-integrate/rest": reference.rest_page,
    "3-operate/settings": reference.settings_page,
}
"""Pages of which the code states the rest."""
_LINK = re.compile(r"(?<!\!)\[([^\]]+)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def _within(name: str, text: str) -> str:
    """Return a page's text with links that lead out of this folder as plain words."""
    here = (DOCS / name).parent

    def kept(link: re.Match[str]) -> str:
        words, target = link.group(1), link.group(2)
        if "://" in target or target.startswith("mailto:"):
            return link.group(0)
        where = (here / target).resolve()
        return link.group(0) if where.is_relative_to(DOCS) and where.suffix == ".md" else words

    return _LINK.sub(kept, text).replace("```mermaid", "```text")


def _with_contents(text: str) -> str:
    """Return the index with a table of contents: each section's links, in their order."""
    parts = []
    for section in re.split(r"\n(?=\*\*\d )", text)[1:]:
        caption = re.match(r"\*\*\d ([^*]+)\*\*", section)
        pages = [target for _, target, _ in _LINK.findall(section) if target.endswith(".md")]
        if caption is not None:
            lines = "\n".join(dict.fromkeys(page.removesuffix(".md") for page in pages if not page.startswith("adr/")))
            parts.append(f"```{{toctree}}\n:caption: {caption.group(1)}\n:hidden:\n\n{lines}\n```")
    decisions = sorted(path.stem for path in (DOCS / "adr").glob("0*.md"))
    lines = "\n".join(["adr/README", *(f"adr/{name}" for name in decisions)])
    parts.append(f"```{{toctree}}\n:caption: Decisions\n:hidden:\n:maxdepth: 1\n\n{lines}\n```")
    return "\n\n".join([text, *parts]) + "\n"


def setup(app: object) -> None:
    """Prepare each page as it is read."""

    def read(_app: object, name: str, source: list[str]) -> None:
        source[0] = with_ages(_within(f"{name}.md", source[0]))
        if name == root_doc:
            source[0] = _with_contents(source[0])
        if name in MADE:
            source[0] += MADE[name]()

    app.connect("source-read", read)  # type: ignore[attr-defined]
