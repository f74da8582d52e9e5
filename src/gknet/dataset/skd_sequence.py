"""One SKD sequence as it lies on disk: the rows of its table, its camera matrix, keypoints and skeleton."""

from __future__ import annotations

import csv
import io
import operator
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from numpy import ndarray

from gknet.dataset.skd_format import AUTHORS_COLUMNS, frame_stem, from_skd_points
from gknet.errors import GknetError
from gknet.io.text import quoted, read_json, read_text
from gknet.io.text_table import read_skd_camera_matrix, read_table
from gknet.io.torch_file import load_torch_file

MOST_DIGITS = 9
"""Of a frame's number."""


@dataclass(frozen=True, eq=False)
class SkdSequence:
    """One sequence's files, read.

    Attributes:
        name: As in the split files: data/000001.
        folder: Where it is.
        category: The spacecraft as the split file spells it.
        rows: The cells as text, parsed when a frame is asked for.
        indices: The frame of each row, from 0.
        camera_matrix: (3, 3) K in our axes, of the whole sensor.
        points_m: (n, 3) keypoints in our body axes, in m.
    """

    name: str
    folder: Path
    category: str
    rows: tuple[dict[str, str], ...]
    indices: tuple[int, ...]
    camera_matrix: Float[ndarray, "3 3"]
    points_m: Float[ndarray, "n 3"]

    def image_path(self, index: int) -> Path:
        return self.folder / "image" / f"{frame_stem(index)}.jpg"


@dataclass(frozen=True)
class Skeleton:
    """Names of the n keypoints, and pairs of their indices."""

    keypoint_names: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]


def read_sequence(root: Path, name: str, category: str) -> SkdSequence:
    """Read the labels of a sequence, not its images.

    Args:
        root: The dataset's folder.
        name: Of the sequence in a split file, such as data/000001.
        category: The spacecraft.

    Raises:
        GknetError: A file is missing or damaged.
    """
    folder = root / name
    rows = read_rows(folder / "annotations.csv")
    own = folder / "camera_matrix.txt"
    return SkdSequence(
        name=name,
        folder=folder,
        category=category,
        rows=rows,
        indices=_indices(folder, rows),
        camera_matrix=read_skd_camera_matrix(own if own.exists() else root / "camera_matrix.txt"),
        points_m=from_skd_points(read_table(folder / "keypoints.txt")),
    )


def read_rows(path: Path) -> tuple[dict[str, str], ...]:
    """The rows of an annotations.csv as text, each with the authors' columns at least.

    Raises:
        GknetError: The file cannot be read, a column is missing, or a row has another number of cells.
    """
    reader = csv.DictReader(io.StringIO(read_text(path), newline=""), skipinitialspace=True)
    try:
        rows = tuple(reader)
        columns = reader.fieldnames or []
    except csv.Error as error:
        raise GknetError(f"{path}: cannot read the annotations ({error})") from error
    missing = [column for column in AUTHORS_COLUMNS if column not in columns]
    if missing:
        raise GknetError(f"{path}: column '{missing[0]}' is missing; expected {', '.join(AUTHORS_COLUMNS)}")
    for number, row in enumerate(rows, start=1):
        if None in row or any(value is None for value in row.values()):
            raise GknetError(
                f"{path}: row {number}: expected {len(columns)} cells as in the header, got another number"
            )
    return rows


def _indices(folder: Path, rows: tuple[dict[str, str], ...]) -> tuple[int, ...]:
    """The frame of each row: its `frame` cell, else, as with the authors, row i is frame i. Images may be lost."""
    path = folder / "annotations.csv"
    if rows and "frame" in rows[0]:
        for number, row in enumerate(rows, start=1):
            if not row["frame"].strip().isdecimal() or len(row["frame"].strip()) > MOST_DIGITS:
                raise GknetError(f"{path}: row {number}: frame: expected 0, 1, ..., got {quoted(row['frame'])}")
        return tuple(int(row["frame"]) for row in rows)
    stems = [path.stem for path in (folder / "image").glob("*.jpg")]
    last = max((stem for stem in stems if stem.isdecimal() and len(stem) <= MOST_DIGITS), key=int, default="0")
    if int(last) > len(rows):
        raise GknetError(f"{path}: {len(rows)} rows, yet there is an image {last}; add a column 'frame' (from 0)")
    return tuple(range(len(rows)))


def read_skeleton(folder: Path, keypoint_count: int) -> Skeleton:
    """skeleton.json, else the authors' skeleton.pth, whose keypoints have no names.

    Raises:
        GknetError: Neither is there, or it is not the skeleton of so many keypoints.
    """
    path = folder / "skeleton.json"
    if path.exists():
        return _read_json_skeleton(path, keypoint_count)
    path = folder / "skeleton.pth"
    if not path.exists():
        raise GknetError(f"{folder}: expected skeleton.json or skeleton.pth, found neither")
    names = tuple(f"keypoint_{k + 1:02d}" for k in range(keypoint_count))
    return Skeleton(names, _edges(path, load_torch_file(path), keypoint_count))


def _read_json_skeleton(path: Path, keypoint_count: int) -> Skeleton:
    content = read_json(path)
    try:
        names, edges = tuple(content["keypoint_names"]), content["edges"]
    except (KeyError, TypeError) as error:
        raise GknetError(f"{path}: expected the keys keypoint_names and edges ({error!r})") from error
    if len(names) != keypoint_count or not all(isinstance(name, str) for name in names):
        raise GknetError(f"{path}: expected {keypoint_count} keypoint names as in keypoints.txt, got {len(names)}")
    return Skeleton(names, _edges(path, edges, keypoint_count))


def _edges(path: Path, edges: object, keypoint_count: int) -> tuple[tuple[int, int], ...]:
    try:
        pairs = tuple((operator.index(i), operator.index(j)) for i, j in edges)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise GknetError(f"{path}: expected a list of pairs of keypoint indices") from error
    for i, j in pairs:
        if not (0 <= i < keypoint_count and 0 <= j < keypoint_count and i != j):
            raise GknetError(f"{path}: edge {quoted((i, j))} is no pair of the keypoints 0 to {keypoint_count - 1}")
    return pairs
