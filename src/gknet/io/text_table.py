"""Numbers in plain text: tables of three columns, and SKD's camera matrix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.io.text import quoted, read_text

LIMIT_BYTES = 2**20
MOST_ROWS = 1000
"""A row is that of a matrix or a keypoint; what is computed from keypoints grows with the square of their number."""


def read_table(path: str | Path) -> Float[ndarray, "n 3"]:
    """Rows of three finite numbers, see `parse_table`."""
    return parse_table(read_text(path, LIMIT_BYTES), path)


def parse_table(text: str, source: object) -> Float[ndarray, "n 3"]:
    """Rows of three finite numbers, separated by commas or spaces; lines that start with # are comments.

    Args:
        text: the table.
        source: the file, which errors name.

    Raises:
        GknetError: there is no row, there are too many, or one is not three finite numbers.
    """
    rows = [_row(line, number, source) for number, line in enumerate(text.splitlines(), start=1) if _is_row(line)]
    if not rows:
        raise GknetError(f"{source}: expected rows of three numbers, found none")
    if len(rows) > MOST_ROWS:
        raise GknetError(f"{source}: expected {MOST_ROWS} rows of three numbers at most, got {len(rows)}")
    return np.array(rows)


def _is_row(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _row(line: str, number: int, source: object) -> list[float]:
    try:
        values = [float(cell) for cell in line.replace(",", " ").split()]
    except ValueError as error:
        raise GknetError(f"{source}: row {number}: expected three numbers, got {quoted(line.strip())}") from error
    if len(values) != 3 or not np.isfinite(values).all():
        raise GknetError(f"{source}: row {number}: expected three finite numbers, got {quoted(line.strip())}")
    return values


def read_skd_camera_matrix(path: str | Path) -> Float[ndarray, "3 3"]:
    """SKD's camera_matrix.txt as K in our axes, see `skd_camera_matrix`."""
    return skd_camera_matrix(read_table(path), path)


def skd_camera_matrix(stored: Float[ndarray, "n 3"], source: object) -> Float[ndarray, "3 3"]:
    """A matrix of SKD, whose axes are Unreal's (x forward, y right, z down), as K in our axes.

    Args:
        stored: the table of a camera_matrix.txt.
        source: the file, which errors name.

    Raises:
        GknetError: it is not 3 x 3, or has another order of axes.
    """
    if stored.shape != (3, 3):
        raise GknetError(f"{source}: expected a 3 x 3 matrix, got {stored.shape[0]} x {stored.shape[1]}")
    matrix = stored[:, [1, 2, 0]]
    if not np.allclose(matrix[2], (0, 0, 1)):
        raise GknetError(f"{source}: expected SKD's order of axes, [[cx, fx, 0], [cy, 0, fy], [1, 0, 0]]")
    return matrix
