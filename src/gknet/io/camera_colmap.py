"""COLMAP's cameras.txt: one line for each camera, `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`.

COLMAP's top-left pixel has its centre at (0.5, 0.5), as ours.
"""

from __future__ import annotations

import re

import numpy as np

from gknet.errors import GknetError
from gknet.geometry import Camera, LensModel
from gknet.io.camera_values import camera_from_values, matrix_of, numbers
from gknet.io.lens import MatrixOnly
from gknet.io.text import quoted

_LINE = re.compile(r"\d+\s+[A-Z_\d]*[A-Z][A-Z_\d]*\s")

_MODELS: dict[str, tuple[LensModel, bool, int]] = {
    "SIMPLE_PINHOLE": ("pinhole", True, 0),
    "PINHOLE": ("pinhole", False, 0),
    "SIMPLE_RADIAL": ("pinhole", True, 1),
    "RADIAL": ("pinhole", True, 2),
    "OPENCV": ("pinhole", False, 4),
    "FULL_OPENCV": ("pinhole", False, 8),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", True, 1),
    "RADIAL_FISHEYE": ("fisheye", True, 2),
    "OPENCV_FISHEYE": ("fisheye", False, 4),
}
"""The lens model, whether one focal length stands for both, and the number of coefficients, in OpenCV's order."""


def is_colmap(line: str) -> bool:
    """Whether a line begins as one of cameras.txt."""
    return _LINE.match(line) is not None


def from_colmap(source: object, text: str) -> Camera | MatrixOnly:
    """The one camera of a cameras.txt; `source` is the file, which errors name."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) != 1:
        raise GknetError(f"{source}: expected one camera, got {len(lines)}; keep the line of the camera in question")
    (words,) = lines
    if len(words) < 4 or words[1] not in _MODELS:
        name = quoted(words[1] if len(words) > 1 else "")
        raise GknetError(f"{source}: expected one of COLMAP's models {', '.join(_MODELS)}, got {name}")
    model, one_focal, coefficients = _MODELS[words[1]]
    focals = 1 if one_focal else 2
    values = numbers(source, words[1], words[4:], (focals + 2 + coefficients,))
    fx_fy, centre, distortion = values[:focals], values[focals : focals + 2], values[focals + 2 :]
    matrix = matrix_of(source, [fx_fy[0], fx_fy[-1], *centre])
    width, height = numbers(source, "size", words[2:4], (2,))
    bent = np.pad(distortion, (0, max(0, 4 - len(distortion))))
    return camera_from_values(source, matrix, bent, (float(width), float(height)), model)
