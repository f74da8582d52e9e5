"""An option for each field: its name, type, default and help are the dataclass's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from gknet.cli.dataclass_options import attribute_texts, with_options


@dataclass(frozen=True)
class Settings:
    """Some settings.

    Attributes:
        count: How many, of which
            the first matters.
        rate: Per second: a number.
        shape: Width and height, such as 3x4.
        is_dry: Write nothing.
        folder: Where.
        hidden: Not for the command line.

    More about them: nothing.
    """

    count: int
    rate: float = 0.5
    shape: tuple[int, int] = (1, 2)
    is_dry: bool = False
    folder: Path | None = None
    hidden: int = 7


@dataclass(frozen=True)
class Others:
    """Attributes:
    word: A word.
    """

    word: str = "so"


def parse_shape(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def results_of(*words: str) -> tuple[int, str, list[tuple[Path, Settings, Others]]]:
    """Exit code, output and what the command was called with."""
    calls: list[tuple[Path, Settings, Others]] = []
    app = typer.Typer()

    @app.command()
    @with_options(Others)
    @with_options(Settings, {"rate": "--hz"}, {"shape": parse_shape}, ("hidden",), "Settings")
    def measure(place: Annotated[Path, typer.Argument(help="Of it all.")], settings: Settings, others: Others) -> None:
        """Measure something."""
        calls.append((place, settings, others))

    result = CliRunner().invoke(app, words, env={"COLUMNS": "200", "TERM": "dumb"})
    return result.exit_code, result.output, calls


def test_what_is_not_given_is_the_dataclass_default() -> None:
    assert results_of("here", "--count", "3")[2] == [(Path("here"), Settings(3), Others())]


def test_what_is_given_gets_there_in_its_type() -> None:
    words = ["here", "--count", "3", "--hz", "2", "--shape", "5x6", "--is-dry", "--folder", "a", "--word", "no"]
    expected = Settings(3, rate=2.0, shape=(5, 6), is_dry=True, folder=Path("a"))
    assert results_of(*words)[2] == [(Path("here"), expected, Others("no"))]


@pytest.mark.parametrize("words", [(), ("--count", "many"), ("--count", "3", "--rate", "2")])
def test_a_wrong_line_ends_with_code_2(words: tuple[str, ...]) -> None:
    code, _, calls = results_of("here", *words)
    assert (code, calls) == (2, [])


def test_the_help_is_the_docstring_and_the_defaults() -> None:
    _, text, _ = results_of("--help")
    for words in ("Measure something.", "How many, of which the first matters.", "Per second: a number.", "0.5"):
        assert words in text
    assert "--hz" in text
    assert "hidden" not in text


def test_the_section_ends_where_the_next_begins() -> None:
    assert list(attribute_texts(Settings)) == ["count", "rate", "shape", "is_dry", "folder", "hidden"]
    assert attribute_texts(int) == {}
