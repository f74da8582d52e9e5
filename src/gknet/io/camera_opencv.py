"""Cameras in OpenCV's FileStorage: YAML, XML or JSON, as its calibration samples and users' own programs write it.

The files are parsed by a YAML, XML or JSON library: cv2.FileStorage itself can crash on a damaged file. The names of
the values differ between programs, so camera_matrix, cameraMatrix, K and so on are the same here. OpenCV's pixel
centres are integers, so 0.5 is added to the principal point. A file does not state whether its four coefficients are
those of a fisheye, unless it has a fisheye_model as the calibration sample writes it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from xml.etree import ElementTree

from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.io.camera_values import CENTRE_AT_INTEGER, camera_from_values, numbers, whole
from gknet.io.lens import MatrixOnly
from gknet.io.text import quoted

_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx")
_DISTORTION = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distortion", "dist", "d")
_WIDTH, _HEIGHT, _SIZE = ("imagewidth", "width"), ("imageheight", "height"), ("imagesize", "size")
_LARGEST = 100
"""Numbers in a matrix; a camera's largest has fourteen."""


def is_storage(content: Mapping[str, object]) -> bool:
    """Whether one of the values is a matrix (opencv-matrix, opencv-nd-matrix) as FileStorage writes it."""
    kinds = (value.get("type_id") for value in content.values() if isinstance(value, dict))
    return any(str(kind).startswith("opencv-") for kind in kinds)


def from_storage(source: object, content: Mapping[str, object]) -> Camera | MatrixOnly:
    """The camera of a FileStorage's top level; `source` is the file, which errors name."""
    values = {re.sub(r"[_ -]", "", str(key)).casefold(): value for key, value in content.items()}
    matrix, distortion = _first(values, _MATRIX), _first(values, _DISTORTION)
    if matrix is None:
        found = ", ".join(quoted(key)[1:-1] for key in list(content)[:10])
        raise GknetError(f"{source}: expected camera_matrix, as OpenCV's calibration sample writes it, got {found}")
    fisheye = values.get("fisheyemodel") in (1, "1", True) or values.get("model") == "fisheye"
    return camera_from_values(
        source,
        _matrix(source, "camera_matrix", matrix).reshape(3, 3),
        None if distortion is None else _matrix(source, "distortion_coefficients", distortion, None),
        _size(source, values),
        "fisheye" if fisheye else "pinhole",
        CENTRE_AT_INTEGER,
    )


def _first(values: Mapping[str, object], names: tuple[str, ...]) -> object:
    return next((values[name] for name in names if name in values), None)


def _matrix(source: object, name: str, value: object, count: int | None = 9) -> Float[ndarray, " n"]:
    """The numbers of a matrix in the order of its rows."""
    data = value.get("data") if isinstance(value, dict) else value
    flat = numbers(source, name, data.split()[:_LARGEST] if isinstance(data, str) else data, None)
    if count is not None and len(flat) != count:
        raise GknetError(f"{source}: {name}: expected {count} numbers, got {len(flat)}")
    return flat


def _size(source: object, values: Mapping[str, object]) -> tuple[object, object] | None:
    width, height, both = _first(values, _WIDTH), _first(values, _HEIGHT), _first(values, _SIZE)
    if both is not None:
        words = both.split() if isinstance(both, str) else both
        width, height = (float(number) for number in numbers(source, "image_size", words, (2,)))
    if width is None or height is None:
        return None
    return _pixels(source, "image_width", width), _pixels(source, "image_height", height)


def _pixels(source: object, name: str, value: object) -> int:
    """XML knows no numbers, only text."""
    is_number = isinstance(value, str) and re.fullmatch(r"[0-9]{1,9}", value.strip())
    return whole(source, name, int(str(value)) if is_number else value)


def from_xml(source: object, text: str) -> Camera | MatrixOnly:
    """The camera of an <opencv_storage>; `source` is the file, which errors name."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise GknetError(f"{source}: expected an <opencv_storage> without a DOCTYPE")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise GknetError(f"{source}: not valid XML: {error}") from error
    if root.tag != "opencv_storage":
        raise GknetError(f"{source}: expected <opencv_storage>, as OpenCV writes it, got <{quoted(root.tag)[1:-1]}>")
    return from_storage(source, {node.tag: _xml_value(node) for node in root})


def _xml_value(node: ElementTree.Element) -> object:
    if len(node) == 0:
        return (node.text or "").strip()
    return {"type_id": node.get("type_id"), **{child.tag: (child.text or "").strip() for child in node}}
