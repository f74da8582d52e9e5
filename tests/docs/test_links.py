"""Every link, file and command that a page names is there. Links to the network are checked for their form alone."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import typer

from gknet.cli.main import app
from gknet.frame import FailureKind
from tests.docs.pages import GENERATED, ROOT, anchors, blocks, links, name_of, pages, prose

PAGES = pages()
FOLDERS = ("src", "tests", "experiments", "benchmarks", "examples", "docs", "results")
HISTORY = ("docs/experiments.md", "docs/decisions/", "CHANGELOG.md")
"""Pages that may name files that are gone."""


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_resolve(page: Path) -> None:
    broken = []
    for link in links(page):
        if link.startswith(("http:", "https:")):
            parts = urlsplit(link)
            good = "." in parts.netloc and not re.search(r"[\s,.;]$", link)
        elif link.startswith("mailto:"):
            good = "@" in link
        else:
            target, _, anchor = link.partition("#")
            path = (page.parent / target).resolve() if target else page
            found = path.exists() and (not anchor or path.suffix != ".md" or anchor in anchors(path))
            good = found or path in GENERATED
        if not good:
            broken.append(link)
    assert not broken


@pytest.mark.parametrize("page", [page for page in PAGES if not name_of(page).startswith(HISTORY)], ids=name_of)
def test_files_named_in_the_text_are_there(page: Path) -> None:
    named = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w./-]*\w/?)`", prose(page))
    missing = [name for name in named if not (ROOT / name).exists()]
    assert not missing


def commands(page: Path) -> list[list[str]]:
    """The words of every `gknet ...` in the blocks of a page."""
    found = []
    for block in blocks(page):
        for line in block.text.replace("\\\n", " ").splitlines():
            if re.match(r"\s*gknet\s", line):
                found.append(shlex.split(line.replace("<", "").replace(">", ""), comments=True)[1:])
    return found


def options() -> dict[str, set[str]]:
    """The options of each command, as its help shows them."""
    group = typer.main.get_command(app)
    found = {}
    for name, command in group.commands.items():  # type: ignore[attr-defined]
        words = {word for parameter in command.params for word in [*parameter.opts, *parameter.secondary_opts]}
        found[name] = words | {"--help", "-h"}
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=name_of)
def test_commands_have_the_options_that_pages_show(page: Path) -> None:
    known = options()
    for words in commands(page):
        if words[0].startswith("-"):
            continue
        assert words[0] in known, f"no command: gknet {' '.join(words)}"
        given = {word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert given <= known[words[0]], f"no option of gknet {words[0]}: {sorted(given - known[words[0]])}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_blocks_are_python(page: Path) -> None:
    for block in blocks(page):
        if block.language == "python":
            ast.parse(block.text, f"{name_of(page)}:{block.line}")


def test_every_kind_of_failure_is_explained() -> None:
    listed = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "howto" / "poses-file.md").read_text("utf-8"), re.MULTILINE)
    assert listed == [kind.value for kind in FailureKind]
