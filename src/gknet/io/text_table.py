"""Numbers in plain text: tables of three columns, and SKD's camera matrix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.io.text import quoted, read_text


def read_table(path: Path) -> Float[ndarray, "n 3"]:
    """Rows of three finite numbers, separated by commas or spaces."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if not lines:
        raise GknetError(f"{path}: expected rows of three numbers, found none")
    table = np.empty((len(lines), 3))
    for number, line in enumerate(lines, start=1):
        try:
            values = [float(cell) for cell in line.replace(",", " ").split()]
        except ValueError as error:
            raise GknetError(f"{path}: row {number}: expected three numbers, got {quoted(line.strip())}") from error
        if len(values) != 3 or not np.isfinite(values).all():
            raise GknetError(f"{path}: row {number}: expected three finite numbers, got {quoted(line.strip())}")
        table[number - 1] = values
    return table


def read_skd_camera_matrix(path: Path) -> Float[ndarray, "3 3"]:
    """SKD's camera_matrix.txt, whose axes are Unreal's (x forward, y right, z down), as K in our axes."""
    stored = read_table(path)
    if stored.shape != (3, 3):
        raise GknetError(f"{path}: expected a 3 x 3 matrix, got {stored.shape[0]} x {stored.shape[1]}")
    matrix = stored[:, [1, 2, 0]]
    if not np.allclose(matrix[2], (0, 0, 1)):
        raise GknetError(f"{path}: expected SKD's order of axes, [[cx, fx, 0], [cy, 0, fy], [1, 0, 0]]")
    return matrix
