"""The pages of the documentation as a test sees them: their code blocks, links and headings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NOT_RUN = re.compile(r"<!-- not run: .+ -->")
_FENCE = re.compile(r"^(?P<indent> *)(?P<ticks>`{3,})(?P<info>[^`\n]*)$")


GENERATED = frozenset({DOCS / "reference" / "commands.md"})
"""Pages that the build of the site writes."""


@dataclass(frozen=True)
class Block:
    """A fenced block. `run` is False below a comment <!-- not run: why -->."""

    language: str
    text: str
    line: int
    run: bool


def pages() -> list[Path]:
    """Every page of the site, and those that a repository's page shows."""
    fronts = list(ROOT.glob("*.md"))
    cards = ROOT.glob("src/gknet/models/*/README.md")
    return sorted([*fronts, *cards, *(path for path in DOCS.rglob("*.md") if path not in GENERATED)])


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page in order."""
    found: list[Block] = []
    lines, i = page.read_text(encoding="utf-8").splitlines(), 0
    while i < len(lines):
        fence = _FENCE.match(lines[i])
        if fence is None:
            i += 1
            continue
        end = i + 1
        while end < len(lines) and lines[end].strip() != fence["ticks"]:
            end += 1
        body = "\n".join(line.removeprefix(fence["indent"]) for line in lines[i + 1 : end])
        run = not (i and NOT_RUN.fullmatch(lines[i - 1].strip()))
        found.append(Block(fence["info"].strip(), body + "\n", i + 2, run))
        i = end + 1
    return found


def prose(page: Path) -> str:
    """The page without its fenced blocks, which hold no links."""
    text = page.read_text(encoding="utf-8")
    for block in blocks(page):
        text = text.replace(block.text, "\n" * block.text.count("\n"), 1)
    return text


def links(page: Path) -> Iterator[str]:
    """Targets of Markdown links and images, and of what HTML in the page points to."""
    text = re.sub(r"`[^`\n]*`", "", prose(page))
    yield from re.findall(r"\]\(<?([^)\s>]+)>?(?: \"[^\"]*\")?\)", text)
    yield from re.findall(r"(?:src|href)=\"([^\"]+)\"", text)
    yield from re.findall(r"<(https?:[^>\s]+)>", text)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and the site make them."""
    slugs: set[str] = set()
    for title in re.findall(r"^#+ +(.+?) *$", prose(page), re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title).replace("`", "")
        slugs.add(re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-"))
    return slugs
