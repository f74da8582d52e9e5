"""Camera files as neighbouring tools write them, and damaged ones, which are one line."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.io.camera_file import read_camera
from gknet.io.lens import FieldOfView, MatrixOnly, ScaledCamera, camera_for, sized_lens

K = np.array([[500.0, 0, 311], [0, 510, 242], [0, 0, 1]])
OURS = K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
"""K of a tool whose pixel centres are integers, in our pixels."""
BENT = [-0.2, 0.1, 0.001, -0.002, 0.05]

OPENCV_SAMPLE = """%YAML:1.0
---
calibration_time: "Sat 28 Nov 2026 09:00:00 AM UTC"
nr_of_frames: 25
image_width: 640
image_height: 480
board_width: 9
flags: 6
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.0000000000000000e+02, 0., 3.1100000000000000e+02, 0.,
       5.1000000000000000e+02, 2.4200000000000000e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.0000000000000001e-01, 1.0000000000000001e-01,
       1.0000000000000000e-03, -2.0000000000000000e-03,
       5.0000000000000003e-02 ]
avg_reprojection_error: 2.0138365402832690e-01
"""

ROS_CALIBRATION = """image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0.0, 311.0, 0.0, 510.0, 242.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 0.1, 0.001, -0.002, 0.05]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
projection_matrix:
  rows: 3
  cols: 4
  data: [490.0, 0.0, 311.0, 0.0, 0.0, 500.0, 242.0, 0.0, 0.0, 0.0, 1.0, 0.0]
"""

ROS_MESSAGE = """header:
  seq: 1
  stamp:
    secs: 1600000000
    nsecs: 1000
  frame_id: "camera"
height: 480
width: 640
distortion_model: "{model}"
D: {coefficients}
K: [500.0, 0.0, 311.0, 0.0, 510.0, 242.0, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [500.0, 0.0, 311.0, 0.0, 0.0, 510.0, 242.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
---
"""

KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.003, -0.0004]
  distortion_model: {distortion}
  intrinsics: [500.0, 510.0, 311.0, 242.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""

COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
1 {line}
"""


OURS_JSON = {"matrix": K.tolist(), "width": 640, "height": 480, "distortion": BENT}
XML = """<?xml version="1.0"?>
<opencv_storage>
<image_width>640</image_width>
<image_height>480</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>5. 0. 3. 0. 5. 2. 0. 0. 1.</data></camera_matrix>
</opencv_storage>
"""


def written(folder: Path, text: str, name: str = "file.any") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def same(lens: object, matrix: np.ndarray, distortion: list[float], model: str = "pinhole") -> bool:
    assert isinstance(lens, Camera)
    assert (lens.width, lens.height, lens.model) == (640, 480, model)
    np.testing.assert_allclose(lens.matrix, matrix)
    np.testing.assert_allclose(lens.distortion, distortion)
    return True


@pytest.mark.parametrize("name", ["cv.yml", "cv.xml", "cv.json"])
@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_opencv_as_opencv_writes_it(tmp_path: Path, name: str, count: int) -> None:
    coefficients = np.linspace(-0.1, 0.1, count)
    storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", coefficients[None])
    storage.release()
    assert same(read_camera(tmp_path / name), OURS, coefficients.tolist())


@pytest.mark.parametrize("name", ["cv.yml", "cv.xml"])
def test_opencv_under_other_names_and_without_a_size(tmp_path: Path, name: str) -> None:
    storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
    storage.write("K", K)
    storage.write("D", np.array(BENT))
    storage.release()
    lens = read_camera(tmp_path / name)
    assert isinstance(lens, MatrixOnly)
    assert same(camera_for(lens, 640, 480), OURS, BENT)


def test_opencv_of_the_calibration_sample(tmp_path: Path) -> None:
    """OpenCV 3 and 4 write a first line that is no YAML."""
    assert same(read_camera(written(tmp_path, OPENCV_SAMPLE)), OURS, BENT)
    fisheye = OPENCV_SAMPLE.replace("fisheye_model: 0", "fisheye_model: 1").replace(
        ",\n       5.0000000000000003e-02 ]", " ]"
    )
    assert same(read_camera(written(tmp_path, fisheye)), OURS, BENT[:4], "fisheye")


def test_ros_calibration_file(tmp_path: Path) -> None:
    assert same(read_camera(written(tmp_path, ROS_CALIBRATION)), OURS, BENT)


@pytest.mark.parametrize(
    ("name", "count", "model"),
    [("plumb_bob", 5, "pinhole"), ("rational_polynomial", 8, "pinhole"), ("equidistant", 4, "fisheye")],
)
@pytest.mark.parametrize("small", [False, True])
def test_ros_message(tmp_path: Path, name: str, count: int, model: str, small: bool) -> None:
    """ROS 2 writes its fields in small letters."""
    coefficients = np.linspace(-0.1, 0.1, count).tolist()
    text = ROS_MESSAGE.format(model=name, coefficients=coefficients)
    for letter in "DKRP" if small else "":
        text = text.replace(f"\n{letter}:", f"\n{letter.lower()}:")
    assert same(read_camera(written(tmp_path, text)), OURS, coefficients, model)


def test_ros_rectified(tmp_path: Path) -> None:
    text = ROS_MESSAGE.format(model="plumb_bob", coefficients="[]")
    assert same(read_camera(written(tmp_path, text)), OURS, [0.0] * 5)


@pytest.mark.parametrize(("distortion", "model"), [("radtan", "pinhole"), ("equidistant", "fisheye")])
def test_kalibr(tmp_path: Path, distortion: str, model: str) -> None:
    lens = read_camera(written(tmp_path, KALIBR.format(distortion=distortion)))
    assert same(lens, OURS, [0.01, -0.02, 0.003, -0.0004], model)


SQUARE = np.array([[500.0, 0, 311], [0, 500, 242], [0, 0, 1]])


@pytest.mark.parametrize(
    ("line", "matrix", "distortion", "model"),
    [
        ("SIMPLE_PINHOLE 640 480 500 311 242", SQUARE, [0, 0, 0, 0], "pinhole"),
        ("PINHOLE 640 480 500 510 311 242", K, [0, 0, 0, 0], "pinhole"),
        ("SIMPLE_RADIAL 640 480 500 311 242 -0.1", SQUARE, [-0.1, 0, 0, 0], "pinhole"),
        ("RADIAL 640 480 500 311 242 -0.1 0.02", SQUARE, [-0.1, 0.02, 0, 0], "pinhole"),
        ("OPENCV 640 480 500 510 311 242 -0.1 0.02 0.001 0.002", K, [-0.1, 0.02, 0.001, 0.002], "pinhole"),
        ("FULL_OPENCV 640 480 500 510 311 242 .1 .2 .3 .4 .5 .6 .7 .8", K, np.arange(1, 9) / 10, "pinhole"),
        ("OPENCV_FISHEYE 640 480 500 510 311 242 .1 .2 .3 .4", K, [0.1, 0.2, 0.3, 0.4], "fisheye"),
        ("SIMPLE_RADIAL_FISHEYE 640 480 500 311 242 .1", SQUARE, [0.1, 0, 0, 0], "fisheye"),
        ("RADIAL_FISHEYE 640 480 500 311 242 .1 .2", SQUARE, [0.1, 0.2, 0, 0], "fisheye"),
    ],
)
def test_colmap(tmp_path: Path, line: str, matrix: np.ndarray, distortion: list[float], model: str) -> None:
    """COLMAP's pixels are ours: nothing is added."""
    assert same(read_camera(written(tmp_path, COLMAP.format(line=line), "cameras.txt")), matrix, distortion, model)


def test_bop(tmp_path: Path) -> None:
    content = {"cx": 311.0, "cy": 242.0, "depth_scale": 0.1, "fx": 500.0, "fy": 510.0, "height": 480, "width": 640}
    assert same(read_camera(written(tmp_path, json.dumps(content, indent=2))), OURS, [0.0] * 5)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_own_json_with_every_number_of_coefficients(tmp_path: Path, count: int) -> None:
    bent = np.linspace(-0.1, 0.1, count).tolist()
    content = {"matrix": K.tolist(), "width": 640, "height": 480, "distortion": bent}
    assert same(read_camera(written(tmp_path, json.dumps(content))), K, bent)
    if count == 4:
        assert same(read_camera(written(tmp_path, json.dumps({**content, "model": "fisheye"}))), K, bent, "fisheye")


@pytest.mark.parametrize("text", [OPENCV_SAMPLE, ROS_CALIBRATION, KALIBR.format(distortion="radtan")])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_byte_order_marks_and_windows_lines(tmp_path: Path, text: str, end: str) -> None:
    plain = read_camera(written(tmp_path, text))
    (tmp_path / "marked").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", end).encode())
    marked = read_camera(tmp_path / "marked")
    assert isinstance(plain, Camera)
    assert same(marked, plain.matrix, plain.distortion.tolist(), plain.model)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("hello", "expected a camera file: gknet's JSON.*COLMAP"),
        ("", "expected a camera file"),
        ("[1, 2]", "expected a JSON object"),
        ('{"a": 1}', "missing height, matrix, width"),
        ('{"fx": 1}', "missing fy, cx, cy, width, height"),
        ('{"matrix": 1, "width": 5, "height": 5, "other": 1}', "unknown key other"),
        ('{"matrix": [[1e400]], "width": 5, "height": 5}', "camera matrix"),
        ("<html></html>", "expected <opencv_storage>"),
        ("<opencv_storage>", "not valid XML"),
        (XML.replace("640", "9" * 5000), "width: expected a whole number"),
        ("<opencv_storage><a>1</a></opencv_storage>", "expected camera_matrix.*got a"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "DOCTYPE"),
        ("a: &x [1]\nb: *x\n", "alias"),
        ("a: [1, 2\n", "not valid YAML in line"),
        ("a: !!python/object:os.system []\n", "not valid YAML"),
        ("- 1\n- 2\n", "expected a camera file|three numbers"),
        ("camera_matrix: 5\n", "expected 9 numbers, got 1"),
        ("a: " + "[" * 5000, "more than 500 lists"),
        ("a: " + "[" * 499, "not valid|too deeply"),
        ("K: [1, 2]\nD: []\nwidth: 5\nheight: 5\n", "camera_matrix: expected 9 numbers, got 2"),
        ("K: [1, 2]\nD: []\n", "missing width, height"),
        (ROS_CALIBRATION.replace("plumb_bob", "magic"), "distortion_model: expected plumb_bob.*got 'magic'"),
        (ROS_CALIBRATION.replace("plumb_bob", "equidistant"), "equidistant has 4 coefficients, got 5"),
        (ROS_CALIBRATION.replace("640", "640.5"), "width: expected a whole number"),
        (KALIBR.format(distortion="fov"), "distortion_model: expected radtan"),
        (KALIBR.format(distortion="radtan").replace("pinhole", "omni"), "camera_model: expected pinhole"),
        (KALIBR.format(distortion="radtan") + KALIBR.format(distortion="radtan").replace("cam0", "cam1"), "cam0, cam1"),
        (COLMAP.format(line="THIN_PRISM_FISHEYE 640 480 1 2 3"), "COLMAP's models"),
        (COLMAP.format(line="PINHOLE 640 480 500 510 311"), "PINHOLE: expected shape"),
        (COLMAP.format(line="PINHOLE 640 480 1 1 1 1\n2 PINHOLE 640 480 1 1 1 1"), "expected one camera, got 2"),
        ("500 0 311\n0 510 242\n", "3 x 3 camera matrix, got 2 rows"),
        ("1 " * 100000, "row 1: expected three finite numbers"),
    ],
)
def test_what_is_no_camera_is_one_line(tmp_path: Path, text: str, word: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(GknetError, match=word) as caught:
        read_camera(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


@given(st.data())
def test_a_mutated_file_is_a_camera_or_one_line(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    bodies = [OPENCV_SAMPLE, ROS_CALIBRATION, KALIBR.format(distortion="radtan"), COLMAP, XML, json.dumps(OURS_JSON)]
    body = bytearray(data.draw(st.sampled_from(bodies)).encode())
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(body) - 1))
        body[at : at + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=5) | st.sampled_from([b"9" * 500]))
    path = tmp_path_factory.mktemp("mutated") / "camera"
    path.write_bytes(body)
    try:
        assert isinstance(read_camera(path), Camera | MatrixOnly)
    except GknetError as error:
        assert str(path) in str(error)  # noqa: PT017  (both ends are right)


def test_a_matrix_of_another_resolution_is_refused_with_both_sizes(tmp_path: Path) -> None:
    lens = read_camera(written(tmp_path, "1400 0 512\n0 1400 512\n0 0 1\n"))
    assert camera_for(lens, 1024, 1024).width == 1024
    assert camera_for(lens, 1000, 1100).width == 1000
    for size in (256, 512, 2048):
        with pytest.raises(GknetError, match=rf"about 1024x1024 pixels, the image has {size}x{size}.*--camera-size"):
            camera_for(lens, size, size)


def test_the_remedies_for_a_matrix_of_another_resolution(tmp_path: Path) -> None:
    lens = read_camera(written(tmp_path, "1400 0 512\n0 1400 512\n0 0 1\n"))
    scaled = sized_lens(lens, (1024, 1024), scale=True)
    assert isinstance(scaled, ScaledCamera)
    assert np.allclose(camera_for(scaled, 512, 512).matrix, [[700, 0, 256], [0, 700, 256], [0, 0, 1]])
    as_it_is = sized_lens(lens, (512, 512), scale=False)
    assert np.allclose(camera_for(as_it_is, 512, 512).matrix[:, 2], [512, 512, 1])
    with pytest.raises(GknetError, match="needs the size"):
        sized_lens(lens, None, scale=True)
    with pytest.raises(GknetError, match="aspect ratio"):
        camera_for(scaled, 512, 256)
    assert sized_lens(lens, None, scale=False) is lens


def test_a_camera_of_another_size_is_scaled_on_request() -> None:
    camera = Camera(K, 640, 480)
    assert camera_for(camera, 320, 240, scale=True).matrix[0, 0] == 250
    with pytest.raises(GknetError, match=r"640 x 480 pixels, the image has 320 x 240.*--scale-camera"):
        camera_for(camera, 320, 240)
    with pytest.raises(GknetError, match="states its own size, it is for 640x480"):
        sized_lens(camera, (320, 240), scale=False)
    assert sized_lens(camera, (640, 480), scale=False) is camera
    with pytest.raises(GknetError, match="it fits every size"):
        sized_lens(FieldOfView(focal_px=500.0), (320, 240), scale=False)
    assert sized_lens(FieldOfView(focal_px=500.0), None, scale=True) == FieldOfView(focal_px=500.0)


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(GknetError, match="regular file"):
        read_camera(tmp_path / "pipe.json")
