"""The SKD layout's text: axes, rows of annotations.csv, camera matrices, skeletons. No other file knows its axes.

SKD's axes are Unreal's, camera and body alike: x forward, y right, z down; quaternions xyzw. Its loader turns a row
vector by v' = v P, a rotation by R' = P^T R P and the intrinsics by K' = K P; the primed ones are ours (OpenCV).
With v = P v' as columns, p_cam = R p_body + t becomes p_cam' = R' p_body' + t', where R is the ordinary matrix of the
stored quaternion; and K = K' P^T = [[cx, fx, 0], [cy, 0, fy], [1, 0, 0]] maps SKD's camera axes to pixels.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.io.text import quoted

P = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Row vectors: v_opencv = v_skd @ P."""

SPLITS = ("train", "val", "test")
AUTHORS_COLUMNS = ("category", "position", "orientation")
OUR_COLUMNS = ("frame", "time_s", "visible", "sun_direction", "earth", "camera", "recipe", "seed")


@dataclass(frozen=True, eq=False)
class Annotation:
    """One row of annotations.csv in our axes. None stands for a column that the file does not have.

    Attributes:
        category: The spacecraft as SKD spells it: Satellite_01.
        index: The frame's place in its sequence, from 0; its image is `index + 1`.
        cam_from_body: The pose, translation in m, in the OpenCV camera frame.
        time_s: Since the sequence's first frame, in s.
        visible: (n,) bool: keypoint in view and not hidden.
        sun_direction: (3,) unit vector to the sun in the camera frame.
        earth: Whether the Earth is in the image.
        camera: Of this image, which may be a part of the full image.
        recipe: Name of the recipe that the renderer made the frame from.
        seed: The renderer's.
    """

    category: str
    index: int
    cam_from_body: Pose
    time_s: float | None = None
    visible: Bool[ndarray, " n"] | None = None
    sun_direction: Float[ndarray, "3"] | None = None
    earth: bool | None = None
    camera: Camera | None = None
    recipe: str | None = None
    seed: int | None = None


def category_of(spacecraft_name: str) -> str:
    """A spacecraft's name as SKD spells it: satellite_01 -> Satellite_01."""
    return spacecraft_name[:1].upper() + spacecraft_name[1:]


def spelled_as(spacecraft_name: str, categories: Iterable[str]) -> str | None:
    """The one of `categories` that is this name: spelled so, or else with the other case of the first letter."""
    known = list(categories)
    if spacecraft_name in known:
        return spacecraft_name
    return next((each for each in known if category_of(each) == category_of(spacecraft_name)), None)


def sequence_name(sequence: int) -> str:
    """Sequence 0 is data/000001."""
    return f"data/{sequence + 1:06d}"


def frame_stem(index: int) -> str:
    """Frame 0 is 000001."""
    return f"{index + 1:06d}"


def to_skd_points(points_m: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """Points or directions in SKD's axes: the inverse of v' = v P."""
    return np.asarray(points_m) @ P.T


def from_skd_points(points: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """Points or directions in our axes: v' = v P."""
    return np.asarray(points) @ P


def to_skd_quaternion(rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "4"]:
    """xyzw of P R' P^T, with w >= 0."""
    return Rotation.from_matrix(P @ rotation @ P.T).as_quat(canonical=True)


def from_skd_quaternion(xyzw: Float[ndarray, "4"]) -> Float[ndarray, "3 3"]:
    """R' = P^T R P of SKD's quaternion."""
    return P.T @ Rotation.from_quat(xyzw).as_matrix() @ P


def to_skd_matrix(matrix: Float[ndarray, "3 3"]) -> Float[ndarray, "3 3"]:
    """K = K' P^T, which maps SKD's camera axes to pixels."""
    return matrix @ P.T


def _list_text(values: ndarray) -> str:
    return "[" + ", ".join(f"{value + 0.0:.9g}" for value in np.asarray(values, dtype=float)) + "]"


def row_of(annotation: Annotation) -> dict[str, str]:
    """The cells of a row.

    Raises:
        GknetError: The camera, `visible` or the sun's direction is missing.
    """
    pose, camera = annotation.cam_from_body, annotation.camera
    if camera is None or annotation.visible is None or annotation.sun_direction is None:
        raise GknetError(f"frame {annotation.index}: expected camera, visible and sun_direction before it is written")
    k = camera.matrix
    return {
        "category": annotation.category,
        "position": _list_text(to_skd_points(pose.translation_m)),
        "orientation": _list_text(to_skd_quaternion(pose.rotation)),
        "frame": str(annotation.index),
        "time_s": "" if annotation.time_s is None else f"{annotation.time_s:.9g}",
        "visible": _list_text(annotation.visible),
        "sun_direction": _list_text(to_skd_points(annotation.sun_direction)),
        "earth": "" if annotation.earth is None else str(int(annotation.earth)),
        "camera": _list_text(np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], camera.width, camera.height])),
        "recipe": annotation.recipe or "",
        "seed": "" if annotation.seed is None else str(annotation.seed),
    }


def _numbers(row: dict[str, str], column: str, count: int | None, place: str) -> Float[ndarray, " n"]:
    """The finite numbers of a cell such as "[1, 2, 3]"."""
    text = row[column]
    expected = f"{count} numbers" if count else "numbers"
    try:
        values = np.array(ast.literal_eval(text.strip()), dtype=float)
    except (ValueError, SyntaxError, TypeError, OverflowError, MemoryError, RecursionError) as error:
        raise GknetError(f"{place}: {column}: expected a list of {expected}, got {quoted(text)}") from error
    if values.ndim != 1 or (count is not None and len(values) != count) or not np.isfinite(values).all():
        raise GknetError(f"{place}: {column}: expected {expected}, all finite, got {quoted(text)}")
    return values


def _number(row: dict[str, str], column: str, place: str) -> float | None:
    text = (row.get(column) or "").strip()
    if not text:
        return None
    try:
        value = float(text)
    except ValueError as error:
        raise GknetError(f"{place}: {column}: expected a number, got {quoted(text)}") from error
    if not np.isfinite(value):
        raise GknetError(f"{place}: {column}: expected a finite number, got {quoted(text)}")
    return value


def _camera(row: dict[str, str], place: str) -> Camera:
    fx, fy, cx, cy, width, height = _numbers(row, "camera", 6, place)
    if width % 1 or height % 1:
        raise GknetError(f"{place}: camera: expected a width and height in whole pixels, got {quoted(row['camera'])}")
    try:
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), int(width), int(height))
    except GknetError as error:
        raise GknetError(f"{place}: camera: {error}") from error


def _pose(row: dict[str, str], place: str) -> Pose:
    orientation = _numbers(row, "orientation", 4, place)
    if abs(np.linalg.norm(orientation) - 1) > 1e-2:
        raise GknetError(f"{place}: orientation: expected a unit quaternion xyzw, got {quoted(row['orientation'])}")
    position = _numbers(row, "position", 3, place)
    return Pose(from_skd_quaternion(orientation), from_skd_points(position))


def annotation_from(row: dict[str, str], index: int, keypoint_count: int, place: str) -> Annotation:
    """A row in our axes.

    Args:
        row: The cells as text.
        index: The frame's place in its sequence, from 0.
        keypoint_count: What the column `visible` must agree with.
        place: File and row, which errors name.

    Raises:
        GknetError: A cell is not what its column holds.
    """
    visible = sun = seed = earth = None
    if row.get("visible"):
        visible = _numbers(row, "visible", None, place) > 0.5
        if len(visible) != keypoint_count:
            raise GknetError(
                f"{place}: visible: expected {keypoint_count} flags as in keypoints.txt, got {len(visible)}"
            )
    if row.get("sun_direction"):
        sun = from_skd_points(_numbers(row, "sun_direction", 3, place))
    if (number := _number(row, "seed", place)) is not None:
        seed = int(number)
    if (number := _number(row, "earth", place)) is not None:
        earth = number > 0.5
    return Annotation(
        category=row["category"],
        index=index,
        cam_from_body=_pose(row, place),
        time_s=_number(row, "time_s", place),
        visible=visible,
        sun_direction=sun,
        earth=earth,
        camera=_camera(row, place) if row.get("camera") else None,
        recipe=row.get("recipe") or None,
        seed=seed,
    )
