"""The label rows of a sequence under way: one JSON line for each frame, until annotations.csv takes its place."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path

from gknet.dataset.skd_format import AUTHORS_COLUMNS, OUR_COLUMNS, annotation_from
from gknet.errors import GknetError
from gknet.io.atomic import naming
from gknet.io.text import parse_json

JOURNAL = "journal.jsonl"


def append_row(journal: Path, row: dict[str, str]) -> None:
    """Append a row in one write. A line starts with its newline, so that one cut off by a kill spoils no other.

    Raises:
        OSError: The disk is full or the file cannot be written; the error names it.
    """
    line = ("\n" + json.dumps(row)).encode()
    with naming(journal):
        handle = os.open(journal, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            if os.write(handle, line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        finally:
            os.close(handle)


def read_journal(journal: Path, frames: int, keypoint_count: int) -> Iterator[dict[str, str]]:
    """The rows of a journal that are whole. A damaged line is left out, and its frame is rendered again.

    Args:
        journal: The file, which may be absent.
        frames: The number of frames of a sequence.
        keypoint_count: The number of keypoints of the sequence's spacecraft.
    """
    if not journal.exists():
        return
    for line in journal.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = parse_json(line, journal)
        except GknetError:
            continue
        if is_row(row, frames, keypoint_count):
            yield row


def is_row(row: object, frames: int, keypoint_count: int) -> bool:
    """Whether this is the complete label row of a frame of the sequence."""
    if not isinstance(row, dict) or set(row) != {*AUTHORS_COLUMNS, *OUR_COLUMNS}:
        return False
    if not all(isinstance(cell, str) for cell in row.values()) or not is_frame(row["frame"], frames):
        return False
    try:
        annotation = annotation_from(row, int(row["frame"]), keypoint_count, "journal")
    except GknetError:
        return False
    return annotation.camera is not None and annotation.visible is not None and annotation.sun_direction is not None


def is_frame(cell: str, frames: int) -> bool:
    """Whether a cell is the number of a frame, from 0."""
    return cell.isdecimal() and len(cell) <= 9 and int(cell) < frames
