"""What the inputs of `gknet predict` name: files one by one, in order, each with a name of its own.

An input is an image, a video, a folder of them, a pattern such as "frames/*.png", a list (`@list.txt`, or a .txt file)
with one of these on each line, a camera's number, or a URL of a stream. A folder is searched with its sub-folders;
links are followed once, and hidden files are left out. Numbers in names count as numbers: 2.png comes before 10.png.
What an earlier run of gknet wrote into a folder (overlays/ and overlay.mp4 beside its poses) is left out.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from gknet.errors import GknetError
from gknet.io.text import printable, quoted, read_text
from gknet.io.video import STREAM_SCHEMES, VIDEO_SUFFIXES

IMAGE_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".jp2", ".pgm", ".ppm", ".pnm", ".pbm"}
)
POSES_NAMES = frozenset({"poses.jsonl", "poses.csv"})
OWN_NAMES = frozenset({"overlays", "overlay.mp4"})
"""What lies beside a poses file was written by gknet."""

LIST_SUFFIX = ".txt"


class Kind(Enum):
    """What a file is read as."""

    IMAGE = "image"
    VIDEO = "video"
    LIVE = "live"
    BAD = "bad"


@dataclass(frozen=True)
class Found:
    """A file, a stream, or what cannot be read.

    Attributes:
        kind: what it is read as.
        path: of the file; the URL or number of a stream.
        name: unique among the inputs, in characters that can be printed; without the suffix for a video.
        reason: why it cannot be read, of `Kind.BAD`.
    """

    kind: Kind
    path: str
    name: str
    reason: str = ""


def find_files(inputs: Sequence[str | Path]) -> list[Found]:
    """What the inputs name, in their order; a file that two of them name is there once.

    Raises:
        GknetError: an input is empty or does not exist, or there is no image in any.
    """
    if not inputs:
        raise GknetError("expected an image, video, folder, pattern or list, got no input")
    return _with_own_names(list(_once(item for text in inputs for item in _of_input(os.fspath(text)))))


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """For sorting names with numbers in them as people count: a2 before a10, folder by folder."""
    words = (word for part in re.split(r"[/\\]", text) for word in [*re.split(r"([0-9]+)", part), "\0"])
    return [
        (0, 0, "") if word == "\0" else (1, int(word), word) if word.isdecimal() else (2, 0, word) for word in words
    ]


def _once(items: Iterable[Found]) -> Iterator[Found]:
    seen: set[tuple[str, str]] = set()
    folders: dict[str, str] = {}
    for item in items:
        folder, file = os.path.split(item.path)
        if item.kind is not Kind.LIVE and folder not in folders:
            folders[folder] = os.path.realpath(folder)  # two links to a folder hold the same files
        key = folders.get(folder, folder), file
        if key not in seen:
            seen.add(key)
            yield item


def _of_input(text: str) -> Iterator[Found]:
    """What one input names. A file that exists goes before every other meaning of its name."""
    if not text.strip():
        raise GknetError("INPUT: expected an image, video, folder, pattern or list, got an empty name")
    if text.startswith(STREAM_SCHEMES):
        yield Found(Kind.LIVE, text, "stream")
    elif os.path.lexists(text):
        list_file = Path(text).suffix.lower() == LIST_SUFFIX and not os.path.isdir(text)
        yield from _listed(Path(text)) if list_file else _of_path(text)
    elif text.startswith("@"):
        yield from _listed(Path(text[1:]))
    elif re.fullmatch(r"[0-9]{1,2}", text):
        yield Found(Kind.LIVE, text, f"camera{text}")
    elif _is_pattern(text):
        for match in _matches(text):
            if os.path.isdir(match) or _kind(match) is not None:
                yield from _of_path(match)
    else:
        raise GknetError(f"{printable(text)}: no such image, video or folder")


def _matches(pattern: str) -> list[str]:
    """What matches a pattern, hidden files left out; "**" is any number of folders, and no links."""
    start = Path(pattern).anchor
    try:
        matches = [str(path) for path in Path(start).glob(pattern[len(start) :]) if not path.name.startswith(".")]
    except (ValueError, NotImplementedError, OSError) as error:
        raise GknetError(f"{printable(pattern)}: not a pattern that can be followed ({error})") from error
    if not matches:
        raise GknetError(f"{printable(pattern)}: no file matches this pattern")
    return sorted(matches, key=natural_key)


def _is_pattern(text: str) -> bool:
    return any(character in text for character in "*?[")


def _kind(path: str) -> Kind | None:
    """By the suffix."""
    suffix = os.path.splitext(path)[1].lower()
    return Kind.VIDEO if suffix in VIDEO_SUFFIXES else Kind.IMAGE if suffix in IMAGE_SUFFIXES else None


def _of_path(text: str) -> Iterator[Found]:
    if os.path.isdir(text):
        found = _of_folder(text)
        if not found:
            suffixes = ", ".join(sorted(IMAGE_SUFFIXES | VIDEO_SUFFIXES))
            raise GknetError(f"{printable(text)}: no image in this folder, and no video (looked for {suffixes})")
        yield from found
    else:
        yield _file(text, os.path.basename(text))


def _file(path: str, name: str) -> Found:
    kind = _kind(path) or Kind.IMAGE
    return Found(kind, path, os.path.splitext(name)[0] if kind is Kind.VIDEO else name)


def _of_folder(root: str) -> list[Found]:
    """Images and videos in a folder and below; a sub-folder that cannot be opened is named."""
    found: list[Found] = []
    visited: set[tuple[int, int]] = set()

    def cannot_open(error: OSError) -> None:
        folder = os.fsdecode(error.filename)
        name = os.path.relpath(folder, root)
        found.append(Found(Kind.BAD, folder, name, f"{folder}: the folder cannot be opened ({error.strerror})"))

    for folder, folders, files in os.walk(root, followlinks=True, onerror=cannot_open):
        state = os.stat(folder)
        if (state.st_dev, state.st_ino) in visited:  # a link to a folder above, or a second one
            folders.clear()
            continue
        visited.add((state.st_dev, state.st_ino))
        below = os.path.relpath(folder, root).replace(os.sep, "/")
        prefix = "" if below == "." else f"{below}/"
        own = OWN_NAMES if POSES_NAMES & set(files) else frozenset()
        folders[:] = sorted((name for name in folders if name not in own and name[0] != "."), key=natural_key)
        for file in files:
            path = os.path.join(folder, file)
            taken = file not in own and file[0] != "." and _kind(file) is not None
            if taken and (os.path.isfile(path) or os.path.islink(path)):  # a broken link is an image that is missing
                found.append(_file(path, f"{prefix}{file}"))
    return sorted(found, key=lambda item: natural_key(item.path))


def _listed(path: Path) -> Iterator[Found]:
    """The inputs on the lines of a text file; relative ones start from its folder."""
    lines = [line.strip() for line in read_text(path, limit_bytes=2**28).splitlines()]
    inputs = [line for line in lines if line and not line.startswith("#")]
    if not inputs:
        raise GknetError(f"{path}: expected a list with the path of an image or video on each line, found none")
    for line in inputs:
        text = line if line.startswith(STREAM_SCHEMES) else os.path.join(path.parent, line)
        if Path(text).suffix.lower() == LIST_SUFFIX or os.path.basename(line).startswith("@"):
            raise GknetError(f"{path}: expected images and videos, got another list, {quoted(line)}")
        if not os.path.lexists(text) and _kind(text) is not None and not _is_pattern(text):
            yield Found(Kind.BAD, text, line, f"{text}: no such file, though it is listed in {path}")
        else:
            for item in _of_input(text):
                yield item if os.path.isdir(text) else replace(item, name=_list_name(item, line))


def _list_name(item: Found, line: str) -> str:
    """A listed file's name is its line, so that files of one name in several folders stay apart."""
    if item.kind not in (Kind.IMAGE, Kind.VIDEO) or _is_pattern(line) or os.path.isabs(line):
        return item.name
    line = os.path.normpath(line).replace(os.sep, "/")
    return os.path.splitext(line)[0] if item.kind is Kind.VIDEO else line


def _with_own_names(found: list[Found]) -> list[Found]:
    """Names that can be printed and differ: where two are the same, with the folders above, else with a number."""
    named = [replace(item, name=printable(item.name)) for item in found]
    counts = Counter(item.name for item in named)
    files = [os.path.abspath(item.path) for item in named if item.kind is not Kind.LIVE]
    common = os.path.commonpath(files) if files else ""
    named = [_longer(item, common) if counts[item.name] > 1 else item for item in named]
    taken: set[str] = set()
    return [replace(item, name=_untaken(item.name, taken)) for item in named]


def _longer(item: Found, folder: str) -> Found:
    """With its folders below `folder` and its suffix in its name."""
    if item.kind is Kind.LIVE:
        return item
    return replace(item, name=printable(os.path.relpath(os.path.abspath(item.path), folder).replace(os.sep, "/")))


def _untaken(name: str, taken: set[str]) -> str:
    number, own = 1, name
    while own in taken:
        number += 1
        own = f"{name}-{number}"
    taken.add(own)
    return own
