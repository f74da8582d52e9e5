"""Text files in: UTF-8 text, JSON and TOML, whose every defect is one GknetError that names the file.

Also how names and values from outside are written into a line of text: `printable` for names, `quoted` for values.
"""

from __future__ import annotations

import json
import reprlib
import stat
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from gknet.errors import GknetError

if TYPE_CHECKING:
    from pydantic import BaseModel, TypeAdapter, ValidationError

    Model = TypeVar("Model", bound=BaseModel)
    Value = TypeVar("Value")

TEXT_LIMIT_BYTES = 256 * 2**20
"""A text file larger than this is no text file of ours."""

QUOTED_CHARACTERS = 80
_LARGEST_INTEGER = 2**64
_BIDIRECTIONAL = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
_LINE_ENDS = frozenset("\u2028\u2029")


def printable(text: object) -> str:
    """A name from outside as text that a terminal, an image and UTF-8 can take.

    Control characters (ESC among them), line ends, marks that turn the direction of writing and lone surrogates (a file
    name that is not UTF-8) become backslash escapes. Everything else is kept.
    """
    return "".join(_escaped(character) if _is_unprintable(character) else character for character in str(text))


def counted(number: int, noun: str) -> str:
    """A number with its noun: "1 frame", "2 frames"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def writable(text: str) -> str:
    """A name from outside as text that UTF-8 can take: lone surrogates become the escapes that `printable` gives."""
    return "".join(_escaped(character) if _is_surrogate(character) else character for character in text)


def spreadsheet_text(text: str) -> str:
    """A text as a cell of a CSV file: `printable`, and no formula for a spreadsheet.

    A text that a spreadsheet would compute (it begins with =, +, - or @) gets an apostrophe in front, which means text;
    so does one that begins with an apostrophe, so that taking one away is the way back.
    """
    shown = printable(text)
    return f"'{shown}" if shown.startswith(("=", "+", "-", "@", "'")) else shown


def _is_unprintable(character: str) -> bool:
    code = ord(character)
    return code < 0x20 or 0x7F <= code < 0xA0 or _is_surrogate(character) or character in _BIDIRECTIONAL | _LINE_ENDS


def _is_surrogate(character: str) -> bool:
    return 0xD800 <= ord(character) < 0xE000


def _escaped(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code < 0xDD00:  # a byte of a file name that is not UTF-8 (PEP 383)
        code -= 0xDC00
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def quoted(value: object, limit: int = QUOTED_CHARACTERS) -> str:
    """A value from a file for a message: its repr, cut to `limit` characters."""
    short = reprlib.Repr()
    short.maxlevel, short.maxstring, short.maxother, short.maxlong = 3, limit, limit, limit
    try:
        text = printable(short.repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits
        text = f"a very large {type(value).__name__}"
    return text if len(text) <= limit else text[: limit - 3] + "..."


def read_text(path: str | Path, limit_bytes: int = TEXT_LIMIT_BYTES) -> str:
    """The text of a UTF-8 file; a byte-order mark at its start is left out.

    Args:
        path: A regular file. A pipe or a device is refused: it could block, or never end.
        limit_bytes: The largest size that is read.

    Returns:
        The text, with its line ends as they are on disk.

    Raises:
        GknetError: There is no such file, it is too large, cannot be read, or is not UTF-8.
    """
    path = Path(path)
    try:
        found = path.stat()
        if stat.S_ISDIR(found.st_mode):
            raise GknetError(f"{path}: expected a text file, got a folder")
        if not stat.S_ISREG(found.st_mode):
            raise GknetError(f"{path}: expected a regular file, got a pipe or a device; save its content to a file")
        if found.st_size > limit_bytes:
            raise GknetError(
                f"{path}: expected a text file of {limit_bytes / 2**20:.0f} MiB at most, "
                f"got {found.st_size / 2**20:.0f} MiB"
            )
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError as error:
        raise GknetError(f"{path}: no such file") from error
    except UnicodeDecodeError as error:
        raise GknetError(f"{path}: expected UTF-8 text, byte {error.start} is none; save it as UTF-8") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        raise GknetError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error


def read_json(path: str | Path) -> Any:
    """The content of a JSON file, see `parse_json`."""
    return parse_json(read_text(path), path)


def parse_json(text: str, source: object) -> Any:
    """The value of a JSON text.

    Args:
        text: The JSON text.
        source: What errors name: a path, or words.

    Raises:
        GknetError: The text is not JSON, is nested too deeply, names a key twice, or holds an integer beyond 64 bits.
    """
    return _parsed(lambda: json.loads(text, object_pairs_hook=_unique_keys), "JSON", source)


def read_toml(path: str | Path) -> dict[str, Any]:
    """The content of a TOML file, see `parse_toml`."""
    return parse_toml(read_text(path), path)


def parse_toml(text: str, source: object) -> dict[str, Any]:
    """The table of a TOML text.

    Args:
        text: The TOML text.
        source: What errors name: a path, or words.

    Raises:
        GknetError: The text is not TOML, is nested too deeply, or holds an integer beyond 64 bits.
    """
    return _parsed(lambda: tomllib.loads(text), "TOML", source)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {quoted(twice)} is there twice")
    return content


def _parsed(parse: Callable[[], Any], language: str, source: object) -> Any:
    try:
        value = parse()
    except RecursionError as error:
        raise GknetError(f"{source}: expected {language}, it is nested too deeply") from error
    except ValueError as error:  # the parsers' own errors, and Python's on an integer of 4,300 digits
        raise GknetError(f"{source}: not valid {language}: {_reason(error)}") from error
    for leaf in _leaves(value):
        if isinstance(leaf, int) and abs(leaf) > _LARGEST_INTEGER:
            raise GknetError(f"{source}: expected integers of 64 bits at most, got {quoted(leaf)}")
    return value


def _reason(error: ValueError) -> str:
    text = str(error)
    return "an integer has too many digits" if "integer string conversion" in text else quoted(text, 200)[1:-1]


def _leaves(value: object) -> Iterator[object]:
    """What is not a list or a table, at any depth."""
    pending = [value]
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            pending.extend(item.values())
        elif isinstance(item, list):
            pending.extend(item)
        else:
            yield item


def validated(model: type[Model] | TypeAdapter[Value], values: object, source: object) -> Any:
    """`values` as an instance of a pydantic model, or as what a pydantic TypeAdapter makes of them.

    Args:
        model: A subclass of `pydantic.BaseModel`, or a `pydantic.TypeAdapter`.
        values: What a parser returned.
        source: What errors name: a path, or words.

    Raises:
        GknetError: The first thing that pydantic objects to.
    """
    from pydantic import TypeAdapter, ValidationError

    validate = model.validate_python if isinstance(model, TypeAdapter) else model.model_validate
    try:
        return validate(values)
    except ValidationError as error:
        raise GknetError(f"{source}: {one_line(error)}") from error
    except (OverflowError, RecursionError) as error:
        raise GknetError(f"{source}: a value is too large ({type(error).__name__})") from error


def one_line(error: ValidationError) -> str:
    """The first thing that pydantic objects to: where, what was expected, and what came."""
    first = error.errors(include_url=False, include_context=False)[0]
    place = ".".join(printable(part)[:QUOTED_CHARACTERS] for part in first["loc"])
    message = printable(first["msg"].removeprefix("Value error, "))
    got = "" if first["type"] in ("missing", "value_error") else f", got {quoted(first['input'])}"
    return f"{place}: {message}{got}" if place else f"{message}{got}"
