"""Readers of text: a byte-order mark is accepted, and every defect is one line that names the file."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, FiniteFloat, TypeAdapter

from gknet.errors import GknetError
from gknet.io.text import parse_json, parse_toml, printable, quoted, read_json, read_text, read_toml, validated


class Point(BaseModel):
    x: FiniteFloat
    name: str = ""


def test_a_byte_order_mark_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for mark in (b"", b"\xef\xbb\xbf"):
        path.write_bytes(mark + '{"ä": 1}\r\n'.encode())
        assert read_text(path) == '{"ä": 1}\r\n'
        assert read_json(path) == {"ä": 1}
    path.write_bytes(b'\xef\xbb\xbfa = "b"\n')
    assert read_toml(path) == {"a": "b"}


def refusal(read: Callable[[], object], source: str) -> str:
    """The one line of a GknetError that begins with the source."""
    with pytest.raises(GknetError) as caught:
        read()
    line = str(caught.value)
    assert line.startswith(f"{source}: ")
    assert "\n" not in line
    assert len(line) < len(source) + 300
    return line


def test_files_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    assert "no such file" in refusal(lambda: read_text(path), str(path))
    path.write_bytes(b"abc\xff")
    assert "byte 3" in refusal(lambda: read_text(path), str(path))
    path.write_bytes(b"12345")
    refusal(lambda: read_text(path, limit_bytes=4), str(path))
    assert "folder" in refusal(lambda: read_text(tmp_path), str(tmp_path))
    refusal(lambda: read_text("a\0b"), "a\0b")


def test_a_pipe_is_refused_and_does_not_block(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert "pipe" in refusal(lambda: read_text(pipe), str(pipe))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[" * 100_000,
        '{"a":' * 100_000,
        "1" * 5_000,
        "1" * 401,
        '{"a": 1, "a": 2}',
        f'{{"{"k" * 5000}": 1, "{"k" * 5000}": 2}}',
    ],
    ids=["empty", "open", "deep lists", "deep tables", "5000 digits", "401 digits", "a key twice", "a long key twice"],
)
def test_defects_of_json(text: str) -> None:
    refusal(lambda: parse_json(text, "x.json"), "x.json")


@pytest.mark.parametrize(
    "text",
    ["a", f"a = {'[' * 100_000}", f"a = {'1' * 5_000}", f"a = {'1' * 401}", "a = 1\na = 2"],
    ids=["no value", "deep", "5000 digits", "401 digits", "a key twice"],
)
def test_defects_of_toml(text: str) -> None:
    refusal(lambda: parse_toml(text, "x.toml"), "x.toml")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64) | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(json_values)
def test_json_comes_back(value: object) -> None:
    assert parse_json(json.dumps(value), "x") == value


def test_what_pydantic_objects_to_is_one_short_line() -> None:
    assert validated(Point, {"x": 1}, "p") == Point(x=1)
    assert validated(TypeAdapter(list[int]), [1], "p") == [1]
    assert refusal(lambda: validated(Point, {}, "p"), "p") == "p: x: Field required"
    assert "got 'far" in refusal(lambda: validated(Point, {"x": "far" * 1000}, "p"), "p")
    refusal(lambda: validated(Point, {"x": 10**401}, "p"), "p")
    refusal(lambda: validated(Point, {"x": 10**5000}, "p"), "p")
    refusal(lambda: validated(TypeAdapter(list[int]), ["\x1b[31m"], "p"), "p")


@given(st.text(st.characters(exclude_categories=()), max_size=30))
def test_printable_text_can_be_written_and_moves_no_cursor(text: str) -> None:
    shown = printable(text)
    shown.encode("utf-8")
    assert not any(ord(c) < 32 or 127 <= ord(c) < 160 for c in shown)
    assert printable(shown) == shown


def test_printable_keeps_names_and_shows_bytes() -> None:
    assert printable("卫星 [é] =a") == "卫星 [é] =a"
    assert printable(os.fsdecode(b"caf\xe9")) == "caf\\xe9"
    assert printable("a\x1b[31mb\n") == "a\\x1b[31mb\\x0a"
    assert printable("\ud800") == "\\ud800"


@pytest.mark.parametrize(
    "value",
    ["x" * 1000, 10**5000, [[[[[[]]]]]] * 100, b"x" * 1000, {1: "a" * 500}, "\ud800\x1b"],
    ids=["text", "integer", "lists", "bytes", "table", "surrogate"],
)
def test_quoted_values_are_short(value: object) -> None:
    text = quoted(value)
    assert len(text) <= 80
    text.encode("utf-8")
    assert "\x1b" not in text
