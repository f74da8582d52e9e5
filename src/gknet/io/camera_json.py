"""Cameras in JSON: ours, SPEED+'s camera.json and BOP's camera.json.

Ours has the keys matrix, width, height and perhaps distortion and model, in our pixels. SPEED+ puts its principal point
at half the image's size, which is the image's centre in our pixels too, so it is kept. BOP's pixel centres are
integers, so 0.5 is added to its principal point.
"""

from __future__ import annotations

from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.io.camera_opencv import from_storage, is_storage
from gknet.io.camera_values import CENTRE_AT_INTEGER, camera_from_values, matrix_of, required
from gknet.io.lens import MatrixOnly
from gknet.io.text import quoted

_OURS = {"matrix", "width", "height", "distortion", "model"}
_BOP = ("fx", "fy", "cx", "cy", "width", "height")


def from_json(source: object, content: object) -> Camera | MatrixOnly:
    """The camera of a JSON file's content; `source` is the file, which errors name."""
    if not isinstance(content, dict):
        raise GknetError(f"{source}: expected a JSON object with a camera, got {type(content).__name__}")
    if is_storage(content):
        return from_storage(source, content)
    if "cameraMatrix" in content:
        return _from_speed_plus(source, content)
    if "fx" in content:
        *focal_and_centre, width, height = required(source, content, *_BOP)
        matrix = matrix_of(source, focal_and_centre)
        return camera_from_values(source, matrix, None, (width, height), centre_shift_px=CENTRE_AT_INTEGER)
    return _from_ours(source, content)


def _from_ours(source: object, content: dict[str, object]) -> Camera | MatrixOnly:
    missing, unknown = {"matrix", "width", "height"} - set(content), set(content) - _OURS
    if missing or unknown:
        problem = "missing" if missing else "unknown key"
        names = ", ".join(quoted(name)[1:-1] for name in sorted(missing or unknown)[:5])
        raise GknetError(f"{source}: {problem} {names}; expected matrix, width, height and perhaps distortion, model")
    model = content.get("model", "pinhole")
    if model not in ("pinhole", "fisheye"):
        raise GknetError(f"{source}: model: expected 'pinhole' or 'fisheye', got {quoted(model)}")
    size = content["width"], content["height"]
    return camera_from_values(source, content["matrix"], content.get("distortion"), size, model)


def _from_speed_plus(source: object, content: dict[str, object]) -> Camera | MatrixOnly:
    missing = {"Nu", "Nv", "distCoeffs"} - set(content)
    if missing:
        raise GknetError(f"{source}: missing {', '.join(sorted(missing))} beside cameraMatrix")
    return camera_from_values(source, content["cameraMatrix"], content["distCoeffs"], (content["Nu"], content["Nv"]))
