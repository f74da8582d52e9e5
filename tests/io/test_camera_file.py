"""Camera files of the three formats give the cameras they describe."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from gknet.dataset.skd_write import write_camera_matrix
from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.io.camera_file import read_camera
from gknet.io.lens import FieldOfView, MatrixOnly, camera_for

K = np.array([[500.0, 0, 311], [0, 510, 242], [0, 0, 1]])
BENT = [-0.2, 0.1, 0.001, -0.002, 0.05]


def same(a: Camera, b: Camera) -> bool:
    sizes = (a.width, a.height) == (b.width, b.height)
    return sizes and np.allclose(a.matrix, b.matrix) and np.allclose(a.distortion, b.distortion)


def test_own_json(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"matrix": K.tolist(), "width": 640, "height": 480, "distortion": BENT}))
    camera = read_camera(path)
    assert isinstance(camera, Camera)
    assert same(camera, Camera(K, 640, 480, np.array(BENT)))


def test_speed_plus_json(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    other = {"ppx": 5.86e-6, "fx": 0.0176, "ccx": 960}
    path.write_text(json.dumps({"Nu": 1920, "Nv": 1200, "cameraMatrix": K.tolist(), "distCoeffs": BENT, **other}))
    camera = read_camera(path)
    assert isinstance(camera, Camera)
    assert same(camera, Camera(K, 1920, 1200, np.array(BENT)))


def test_skd_text_is_turned_into_our_axes(tmp_path: Path) -> None:
    path = tmp_path / "camera_matrix.txt"
    write_camera_matrix(path, Camera(K, 640, 480))
    assert "311, 500, 0" in path.read_text()
    lens = read_camera(path)
    assert isinstance(lens, MatrixOnly)
    assert same(camera_for(lens, 640, 480), Camera(K, 640, 480))


def test_opencv_text_is_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "k.txt"
    np.savetxt(path, K)
    assert same(camera_for(read_camera(path), 640, 480), Camera(K, 640, 480))


def test_focal_length_and_field_of_view_agree() -> None:
    by_focal = camera_for(FieldOfView(focal_px=500.0), 640, 480)
    by_angle = camera_for(FieldOfView(horizontal_rad=2 * math.atan(320 / 500)), 640, 480)
    assert same(by_focal, by_angle)
    assert same(by_focal, Camera.from_focal(500, 640, 480))


def test_a_camera_of_another_size_is_refused() -> None:
    with pytest.raises(GknetError, match="640 x 480 pixels, the image has 320 x 240"):
        camera_for(Camera(K, 640, 480), 320, 240)


@pytest.mark.parametrize(("focal", "angle"), [(None, None), (500.0, 1.0), (0.0, None), (None, 4.0), (math.inf, None)])
def test_bad_fields_of_view(focal: float | None, angle: float | None) -> None:
    with pytest.raises(GknetError):
        FieldOfView(focal, angle)


@pytest.mark.parametrize("missing", ["Nu", "Nv", "distCoeffs"])
def test_speed_plus_with_a_hole(missing: str, tmp_path: Path) -> None:
    content = {"Nu": 1920, "Nv": 1200, "cameraMatrix": K.tolist(), "distCoeffs": BENT}
    del content[missing]
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    with pytest.raises(GknetError, match=missing):
        read_camera(path)


def test_text_of_neither_kind_of_axes(tmp_path: Path) -> None:
    path = tmp_path / "k.txt"
    path.write_text("500, 0, 311\n0, 510, 242\n0, 1, 0\n")
    with pytest.raises(GknetError, match="order of axes"):
        read_camera(path)
