"""The site builds without a warning and without a network; its reference is complete and its drawings are current."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import gknet
from tests.docs.pages import DOCS, ROOT
from tests.docs.test_links import options

FROM_ELSEWHERE = re.compile(r"(?:src|href)=\"(?:https?:)?//[^\"]+\.(?:js|css|woff2?)")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx")
    pytest.importorskip("myst_parser")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", str(DOCS), str(out)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-4000:]
    return out


@pytest.mark.slow
def test_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        assert not FROM_ELSEWHERE.search(page.read_text(encoding="utf-8")), page


@pytest.mark.slow
def test_equations_are_mathml(site: Path) -> None:
    text = (site / "conventions.html").read_text(encoding="utf-8")
    assert text.count("<math") > 15
    assert "$" not in re.sub(r"<[^>]+>", "", text)


@pytest.mark.slow
def test_every_command_is_in_the_reference(site: Path) -> None:
    text = re.sub(r"<[^>]+>", "", (site / "reference" / "commands.html").read_text(encoding="utf-8"))
    for command, words in options().items():
        assert f"gknet {command}" in text
        assert all(word in text for word in words if word.startswith("--"))  # as they are typed, with two hyphens
    assert "OUT/&lt;name&gt;.glb" in text


def test_the_whole_public_api_is_in_the_reference() -> None:
    text = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    assert set(re.findall(r"auto\w+:: gknet\.(\w+)", text)) == set(gknet.__all__)


def test_drawings_are_current(tmp_path: Path) -> None:
    """docs/figures.py draws the images in docs/images, up to the last digits of its numbers."""
    pytest.importorskip("matplotlib")
    drawn = runpy.run_path(str(DOCS / "figures.py"))["draw"](tmp_path)
    assert {path.name for path in drawn} == {path.name for path in (DOCS / "images").glob("*.svg")}
    for path in drawn:
        kept = DOCS / "images" / path.name
        assert shape(path) == shape(kept), f"{path.name}: draw it again with python docs/figures.py, and look at it"


def shape(drawing: Path) -> str:
    """A drawing without the numbers and ids that depend on the machine."""
    return re.sub(r"-?\d+(\.\d+)?", "0", re.sub(r"(#|id=\")\w+", "", drawing.read_text(encoding="utf-8")))
