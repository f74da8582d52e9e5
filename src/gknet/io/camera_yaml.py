"""Cameras in YAML: ROS's camera_info, Kalibr's camchain and OpenCV's FileStorage.

All three put pixel centres at integers, so 0.5 is added to the principal point.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from gknet.errors import GknetError
from gknet.geometry import Camera, LensModel
from gknet.io.camera_opencv import from_storage, is_storage
from gknet.io.camera_values import CENTRE_AT_INTEGER, camera_from_values, matrix_of, numbers, required
from gknet.io.lens import MatrixOnly
from gknet.io.text import quoted

MOST_BRACKETS = 500

_ROS_MODELS: dict[str, tuple[LensModel, tuple[int, ...]]] = {
    "plumb_bob": ("pinhole", (4, 5)),
    "rational_polynomial": ("pinhole", (8, 12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
}
_KALIBR_MODELS: dict[str, LensModel] = {"radtan": "pinhole", "equidistant": "fisheye", "none": "pinhole"}


class _Loader(yaml.SafeLoader):
    """Plain data and OpenCV's matrices. No aliases: a few of them in each other make gigabytes of a short file."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name) is not expected in a camera file")
        return super().compose_node(parent, index)


def _opencv_matrix(loader: _Loader, kind: str, node: yaml.MappingNode) -> dict[Any, Any]:
    return {**loader.construct_mapping(node, deep=True), "type_id": f"opencv-{kind}"}


_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _opencv_matrix)


def from_yaml(source: object, text: str) -> Camera | MatrixOnly:
    """The camera of a YAML file's first document; `source` is the file, which errors name."""
    content = _content(source, text)
    if not isinstance(content, dict):
        raise GknetError(f"{source}: expected YAML with names and values, got {type(content).__name__}")
    if any(re.fullmatch(r"cam\d+", str(key)) for key in content):
        return _from_kalibr(source, content)
    if not is_storage(content) and ("distortion_model" in content or {"K", "k"} & set(content)):
        return _from_ros(source, content)
    return from_storage(source, content)


def _content(source: object, text: str) -> object:
    if text.count("[") + text.count("{") > MOST_BRACKETS:  # parsing takes the square of the nesting
        raise GknetError(f"{source}: expected a camera file, got YAML of more than {MOST_BRACKETS} lists")
    body = re.sub(r"\A%YAML[^\n]*\n", "", text)  # OpenCV 3 and 4 write "%YAML:1.0", which is no YAML
    try:
        return next(iter(yaml.load_all(body, _Loader)), None)
    except yaml.MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise GknetError(f"{source}: not valid YAML{line}: {quoted(error.problem or error.context)[1:-1]}") from error
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else quoted(str(error))[1:-1]
        raise GknetError(f"{source}: not valid YAML: {reason}") from error


def _from_ros(source: object, content: dict[Any, Any]) -> Camera | MatrixOnly:
    """A calibration file of ROS (camera_matrix, image_width) or the message itself (K or k, width)."""
    matrix = next((content[key] for key in ("camera_matrix", "K", "k") if key in content), None)
    distortion = next((content[key] for key in ("distortion_coefficients", "D", "d") if key in content), None)
    if matrix is None:
        raise GknetError(f"{source}: missing camera_matrix; expected ROS's camera_info")
    keys = ("image_width", "image_height") if "image_width" in content else ("width", "height")
    width, height = required(source, content, *keys)
    coefficients = numbers(source, "distortion_coefficients", _data(distortion), None)
    model = _ros_model(source, content.get("distortion_model"), len(coefficients))
    nine = numbers(source, "camera_matrix", _data(matrix), None)
    if len(nine) != 9:
        raise GknetError(f"{source}: camera_matrix: expected 9 numbers, got {len(nine)}")
    return camera_from_values(source, nine.reshape(3, 3), coefficients, (width, height), model, CENTRE_AT_INTEGER)


def _data(value: object) -> object:
    """The numbers of a ROS matrix, which has rows and cols beside its data in a calibration file."""
    return [] if value is None else value.get("data") if isinstance(value, dict) else value


def _ros_model(source: object, name: object, count: int) -> LensModel:
    """The lens model of a distortion_model; without coefficients the image is rectified, whatever the name."""
    if count == 0 and name in (None, "", *_ROS_MODELS):
        return "pinhole"
    if name not in _ROS_MODELS:
        raise GknetError(f"{source}: distortion_model: expected {', '.join(_ROS_MODELS)}, got {quoted(name)}")
    model, counts = _ROS_MODELS[str(name)]
    if count not in counts:
        expected = " or ".join(map(str, counts))
        raise GknetError(f"{source}: distortion_model {name} has {expected} coefficients, got {count}")
    return model


def _from_kalibr(source: object, content: dict[Any, Any]) -> Camera | MatrixOnly:
    names = [str(key) for key in content if re.fullmatch(r"cam\d+", str(key))]
    if len(names) > 1:
        raise GknetError(f"{source}: a camchain of {', '.join(names[:9])}; keep the one that took the images")
    camera = content[names[0]]
    if not isinstance(camera, dict):
        raise GknetError(f"{source}: {names[0]}: expected names and values, got {quoted(camera)}")
    kind, intrinsics, size = required(source, camera, "camera_model", "intrinsics", "resolution")
    distortion = camera.get("distortion_model", "none")
    if kind != "pinhole":
        raise GknetError(f"{source}: camera_model: expected pinhole, got {quoted(kind)}; calibrate with pinhole-equi")
    if distortion not in _KALIBR_MODELS:
        raise GknetError(f"{source}: distortion_model: expected {', '.join(_KALIBR_MODELS)}, got {quoted(distortion)}")
    width, height = (float(number) for number in numbers(source, "resolution", size, (2,)))
    matrix, coefficients = matrix_of(source, intrinsics), camera.get("distortion_coeffs")
    return camera_from_values(
        source, matrix, coefficients, (width, height), _KALIBR_MODELS[distortion], CENTRE_AT_INTEGER
    )
