"""Settings of the documentation site: make docs builds it into build/docs, offline."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator
from typer.main import get_command

import gknet
from gknet.cli.main import app as gknet_app

DOCS = Path(__file__).parent

project = "gknet"
author = "the gknet developers"
release = version = gknet.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_static"]
nitpicky = True
nitpick_ignore_regex = [
    # Libraries whose documentation is on the network, and annotations that carry shapes.
    (r"py:.*", r"(numpy|np|pathlib|pydantic|collections|typing|jaxtyping|cv2)\..*"),
    (r"py:class", r"(Path|ndarray|'.*')"),
    (r"py:class", r"gknet\..*\..*"),  # what a public signature mentions and is itself no public name
]

myst_enable_extensions = ["dollarmath", "amsmath", "attrs_inline", "colon_fence", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
default_role = "code"
smartquotes = False  # "--" begins an option: it is no dash
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "furo"
html_title = f"gknet {release}"
html_static_path = ["_static"]
html_css_files = ["gknet.css"]
html_show_sourcelink = False
html_copy_source = False
html_show_copyright = False
html_math_renderer = "mathml"
html_theme_options = {"source_repository": "", "navigation_with_keys": True}


def inline_math(self: HTML5Translator, node: nodes.math) -> None:
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def block_math(self: HTML5Translator, node: nodes.math_block) -> None:
    """Equations as MathML, which browsers show without a script or a network."""
    self.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def with_whole_summaries(text: str) -> str:
    """The reference with the first sentence of each command in its list, which typer's tool cuts at 45 characters."""
    for name, command in get_command(gknet_app).commands.items():  # type: ignore[attr-defined]
        summary = " ".join((command.help or "").split("\n\n")[0].split())
        line = f"* `{name}`: {summary}".replace("\\", "\\\\")
        text = re.sub(rf"^\* `{name}`: .*$", line, text, flags=re.MULTILINE)
    return text


def without_markup(text: str) -> str:
    """The text with <name> as it is written, where Markdown would take it for a tag of HTML; code stays."""
    return re.sub(r"(`[^`\n]*`)|<(?=\w+>)", lambda found: found[1] or r"\<", text)


def write_command_reference(app: Sphinx) -> None:
    """reference/commands.md from the help texts of the command line, by typer's own tool."""
    target = DOCS / "reference" / "commands.md"
    tool = ["-m", "typer", "gknet.cli.main", "utils", "docs", "--name", "gknet", "--title", "Commands"]
    run = subprocess.run([sys.executable, *tool], capture_output=True, text=True, check=True)
    introduction = "Made from the help texts of the program: `gknet --help` and `gknet COMMAND --help` print the same."
    text = run.stdout.replace("# Commands\n", f"# Commands\n\n{introduction}\n", 1).replace("&#x27;", "'")
    text = without_markup(with_whole_summaries(text))
    if not target.is_file() or target.read_text(encoding="utf-8") != text:
        target.write_text(text, encoding="utf-8")


def list_decisions(app: Sphinx, document: str, source: list[str]) -> None:
    """Every decision hangs below decisions/README.md, which stays plain Markdown."""
    if document == "decisions/README":
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\n0*\n```\n"


def setup(app: Sphinx) -> None:
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
    app.connect("builder-inited", write_command_reference)
    app.connect("source-read", list_decisions)
