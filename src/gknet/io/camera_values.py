"""Values of a calibration as they stand in a foreign file, checked and brought into our pixels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.geometry import Camera, LensModel
from gknet.io.lens import MatrixOnly
from gknet.io.text import quoted

CENTRE_AT_INTEGER = 0.5
"""Added to a principal point of a convention in which the centre of the top-left pixel is (0, 0)."""


def camera_from_values(
    source: object,
    matrix: object,
    distortion: object,
    size: tuple[object, object] | None,
    model: LensModel = "pinhole",
    centre_shift_px: float = 0.0,
) -> Camera | MatrixOnly:
    """A camera of values as they stood in a file.

    Args:
        source: the file, which errors name.
        matrix: 3 x 3 numbers, K in the file's pixels.
        distortion: the coefficients in OpenCV's order; None or none at all for a lens without distortion.
        size: width and height in pixels; None where the file does not state them.
        model: of the lens.
        centre_shift_px: added to the principal point, see `CENTRE_AT_INTEGER`.

    Raises:
        GknetError: a value is no number, has another shape, or is none that a camera can have.
    """
    shifted = numbers(source, "camera matrix", matrix, (3, 3)).copy()
    shifted[:2, 2] += centre_shift_px
    bent = np.zeros(0) if distortion is None else numbers(source, "camera distortion", distortion, None)
    if bent.size == 0:
        bent = np.zeros(4 if model == "fisheye" else 5)
    lens = MatrixOnly(shifted, str(source), bent, model)
    return lens if size is None else lens.of_size(whole(source, "width", size[0]), whole(source, "height", size[1]))


def matrix_of(source: object, values: object) -> Float[ndarray, "3 3"]:
    """K of the numbers fx, fy, cx, cy."""
    fx, fy, cx, cy = numbers(source, "camera fx, fy, cx, cy", values, (4,))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def whole(source: object, name: str, value: object) -> int:
    """A whole number of pixels."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise GknetError(f"{source}: {name}: expected a whole number of pixels, got {quoted(value)}")
    return value


def numbers(source: object, name: str, values: object, shape: tuple[int, ...] | None) -> ndarray:
    """A float64 array of `shape`; (n,) of any n, whatever the nesting, where `shape` is None."""
    expected = "numbers" if shape is None else f"numbers of shape {shape}"
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise GknetError(f"{source}: {name}: expected {expected}, got {quoted(values)}") from error
    if shape is None:
        return array.ravel()
    if array.shape != shape:
        raise GknetError(f"{source}: {name}: expected shape {shape}, got {array.shape}")
    return array


def required(source: object, content: Mapping[str, object], *keys: str) -> list[object]:
    """The values of keys that a file must have."""
    missing = [key for key in keys if key not in content]
    if missing:
        raise GknetError(f"{source}: missing {', '.join(missing)}; expected {', '.join(keys)}")
    return [content[key] for key in keys]
