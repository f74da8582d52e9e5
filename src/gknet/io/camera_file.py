"""Camera files: our own JSON, SPEED+'s camera.json, and a 3x3 matrix as text (an SKD dataset's or OpenCV's).

SPEED+ puts its principal point at half the image's size, which is the image's centre in our pixels too, so it is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.io.text import read_json
from gknet.io.text_table import read_skd_camera_matrix, read_table

_OURS = {"matrix", "width", "height", "distortion"}


@dataclass(frozen=True, eq=False)
class MatrixOnly:
    """A camera matrix whose image size is not known from its file."""

    matrix: Float[ndarray, "3 3"]
    source: str

    def camera(self, width: int, height: int) -> Camera:
        return _named(self.source, self.matrix, width, height, None)


@dataclass(frozen=True)
class FieldOfView:
    """A centred camera with square pixels, known by its horizontal field of view or its focal length."""

    focal_px: float | None = None
    horizontal_rad: float | None = None

    def __post_init__(self) -> None:
        if (self.focal_px is None) == (self.horizontal_rad is None):
            raise GknetError("camera: give either a focal length in pixels or a horizontal field of view")
        if self.focal_px is not None and not (math.isfinite(self.focal_px) and self.focal_px > 0):
            raise GknetError(f"focal length: expected a positive number of pixels, got {self.focal_px}")
        if self.horizontal_rad is not None and not 0 < self.horizontal_rad < math.pi:
            degrees = math.degrees(self.horizontal_rad)
            raise GknetError(f"field of view: expected between 0 and 180 degrees, got {degrees:g}")

    def camera(self, width: int, height: int) -> Camera:
        focal = self.focal_px or width / 2 / math.tan((self.horizontal_rad or 0.0) / 2)
        return Camera.from_focal(focal, width, height)


Lens = Camera | MatrixOnly | FieldOfView
"""Where a picture's camera comes from; the last two learn the image size from the picture."""


def camera_for(lens: Lens, width: int, height: int) -> Camera:
    """The camera of a width x height picture; GknetError when the camera was made for another size."""
    if not isinstance(lens, Camera):
        return lens.camera(width, height)
    if (lens.width, lens.height) != (width, height):
        raise GknetError(f"camera: it is for {lens.width} x {lens.height} pixels, the image has {width} x {height}")
    return lens


def read_camera(path: str | Path) -> Camera | MatrixOnly:
    """Read a camera file of one of the three formats; every defect is a GknetError that names the file."""
    path = Path(path)
    return _from_json(path) if path.suffix.lower() == ".json" else _from_matrix_text(path)


def _named(source: object, matrix: object, width: object, height: object, distortion: object) -> Camera:
    """A camera of values as they stood in `source`, which its errors name."""
    columns, rows = _whole(source, "width", width), _whole(source, "height", height)
    bent = np.zeros(5) if distortion is None else _numbers(source, "camera distortion", distortion, (5,))
    straight = _numbers(source, "camera matrix", matrix, (3, 3))
    try:
        return Camera(straight, columns, rows, bent)
    except GknetError as error:
        raise GknetError(f"{source}: {error}") from error


def _whole(source: object, name: str, value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise GknetError(f"{source}: {name}: expected a whole number of pixels, got {value!r}")
    return value


def _numbers(source: object, name: str, values: object, shape: tuple[int, ...]) -> ndarray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GknetError(f"{source}: {name}: expected numbers of shape {shape}, got {values!r}") from error
    if array.shape != shape:
        raise GknetError(f"{source}: {name}: expected shape {shape}, got {array.shape}")
    return array


def _from_json(path: Path) -> Camera:
    content = read_json(path)
    if not isinstance(content, dict):
        raise GknetError(f"{path}: expected a JSON object with a camera, got {type(content).__name__}")
    if "cameraMatrix" in content:
        return _from_speed_plus(path, content)
    missing, unknown = {"matrix", "width", "height"} - set(content), set(content) - _OURS
    if missing or unknown:
        problem = f"missing {', '.join(sorted(missing))}" if missing else f"unknown key {', '.join(sorted(unknown))}"
        raise GknetError(f"{path}: {problem}; expected matrix, width, height and perhaps distortion")
    return _named(path, content["matrix"], content["width"], content["height"], content.get("distortion"))


def _from_speed_plus(path: Path, content: dict[str, object]) -> Camera:
    missing = {"Nu", "Nv", "distCoeffs"} - set(content)
    if missing:
        raise GknetError(f"{path}: missing {', '.join(sorted(missing))} beside cameraMatrix")
    return _named(path, content["cameraMatrix"], content["Nu"], content["Nv"], content["distCoeffs"])


def _from_matrix_text(path: Path) -> MatrixOnly:
    table = read_table(path)
    if table.shape != (3, 3):
        raise GknetError(f"{path}: expected a 3 x 3 camera matrix, got {table.shape[0]} rows of 3 numbers")
    if np.allclose(table[2], (0, 0, 1)):
        return MatrixOnly(table, str(path))
    return MatrixOnly(read_skd_camera_matrix(path), str(path))
