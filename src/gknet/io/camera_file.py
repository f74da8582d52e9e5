"""Camera files of gknet and of neighbouring tools; which format a file has is found from its content.

| format | principal point |
|---|---|
| gknet's JSON: matrix, width, height, distortion, model | in our pixels |
| SPEED+'s camera.json | at half the image's size, which is the centre in our pixels too: kept |
| a 3 x 3 matrix as text, in OpenCV's or SKD's order of axes | in our pixels |
| COLMAP's cameras.txt | in our pixels: its top-left pixel has its centre at (0.5, 0.5) too |
| OpenCV's FileStorage (YAML, XML, JSON) | pixel centres are integers: 0.5 is added |
| ROS's camera_info (YAML) | pixel centres are integers: 0.5 is added |
| Kalibr's camchain (YAML) | pixel centres are integers: 0.5 is added |
| BOP's camera.json | pixel centres are integers: 0.5 is added |
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.io.camera_colmap import from_colmap, is_colmap
from gknet.io.camera_json import from_json
from gknet.io.camera_opencv import from_xml
from gknet.io.camera_yaml import from_yaml
from gknet.io.lens import MatrixOnly
from gknet.io.text import parse_json, read_text
from gknet.io.text_table import parse_table, skd_camera_matrix

LIMIT_BYTES = 256 * 1024
"""A camera file is a few hundred bytes."""

FORMATS = (
    "gknet's JSON, SPEED+'s or BOP's camera.json, OpenCV's YAML, XML or JSON, ROS's camera_info, Kalibr's camchain, "
    "COLMAP's cameras.txt, or 3 rows of 3 numbers as text"
)


def read_camera(path: str | Path) -> Camera | MatrixOnly:
    """The camera of a file.

    Args:
        path: a file of one of the formats above, of any name.

    Returns:
        A `Camera`, or a `MatrixOnly` where the file does not state the image size.

    Raises:
        GknetError: the file cannot be read, has no known format, or its values are no camera. It names the file.
    """
    text = read_text(path, LIMIT_BYTES)
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith(("#", "---"))), "")
    if first.startswith(("{", "[")):
        return from_json(path, parse_json(text, path))
    if first.startswith("<"):
        return from_xml(path, text)
    if is_colmap(first):
        return from_colmap(path, text)
    if first.startswith("%YAML") or re.match(r"[^\s:,]+:(\s|$)", first):
        return from_yaml(path, text)
    if re.match(r"[-+.\d]|nan|inf", first, re.IGNORECASE):
        return _from_matrix_text(path, text)
    raise GknetError(f"{path}: expected a camera file: {FORMATS}")


def _from_matrix_text(path: str | Path, text: str) -> MatrixOnly:
    table = parse_table(text, path)
    if table.shape != (3, 3):
        raise GknetError(f"{path}: expected a 3 x 3 camera matrix, got {table.shape[0]} rows of 3 numbers")
    return MatrixOnly(table if np.allclose(table[2], (0, 0, 1)) else skd_camera_matrix(table, path), str(path))
