"""The paper's read-out is as the paper states it: whole cells, all keypoints, no covariance."""

from __future__ import annotations

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.evaluation.metrics import pose_errors
from gknet.evaluation.paper_protocol import PaperEstimator, highest_cells, plain_pnp
from gknet.frame import Box
from gknet.geometry import Camera, LensModel, Pose
from gknet.inference.network_io import NetworkOutput
from gknet.spacecraft import Spacecraft

POINTS = np.random.default_rng(3).uniform(-1, 1, (12, 3)) * (3, 1, 1)
CRAFT = Spacecraft("probe", tuple(f"k{i}" for i in range(12)), POINTS, ((0, 1),), 6.5)
CAMERA = Camera.from_focal(1000, 800, 640)
POSE = Pose.from_quaternion([0.4, 0.2, -0.6, 0.3], [0.5, -0.3, 14])


def test_the_highest_cell_of_fine_heatmaps_is_one_of_32() -> None:
    heatmaps = np.zeros((2, 64, 64))
    heatmaps[0, 10:12, 20:22] = 0.5  # fills one cell of 8 px
    heatmaps[0, 40, 41] = 1.0  # higher, yet less in the mean of its cell
    heatmaps[1, 63, 0] = 1.0
    np.testing.assert_array_equal(highest_cells(heatmaps, 256), [[84, 44], [4, 252]])
    with pytest.raises(GknetError, match="32 cells"):
        highest_cells(np.zeros((2, 48, 48)), 256)


def test_a_smaller_input_has_as_many_cells() -> None:
    """And heatmaps of fewer are read as they are."""
    heatmaps = np.zeros((1, 32, 32))
    heatmaps[0, 5, 7] = 1.0
    np.testing.assert_array_equal(highest_cells(heatmaps, 128), [[30, 22]])
    np.testing.assert_array_equal(highest_cells(heatmaps[:, :16, :16], 64), [[30, 22]])


def test_plain_pnp_is_exact_on_exact_points_and_has_no_defence() -> None:
    pixels = CAMERA.project(POSE.transform(POINTS))
    found = plain_pnp(pixels, CAMERA, POINTS)
    assert max(pose_errors(POSE, found)) < 1e-4
    pixels[4] += 150
    spoilt = plain_pnp(pixels, CAMERA, POINTS)
    assert max(pose_errors(POSE, spoilt)) > 0.02


@pytest.mark.parametrize(
    ("model", "distortion"), [("fisheye", (0.05, -0.02, 0.0, 0.0)), ("pinhole", (-0.3, 0.1, 0.0, 0.0, 0.0))]
)
def test_plain_pnp_is_exact_through_a_distorted_lens(model: LensModel, distortion: tuple[float, ...]) -> None:
    camera = Camera(np.array([[500.0, 0, 400], [0, 500, 320], [0, 0, 1]]), 800, 640, np.array(distortion), model)
    pose = Pose.from_quaternion([0.4, 0.2, -0.6, 0.3], [2.5, -1.3, 6])
    found = plain_pnp(camera.project(pose.transform(POINTS)), camera, POINTS)
    assert found is not None
    assert max(pose_errors(pose, found)) < 1e-4


def test_rays_that_no_pinhole_camera_has_are_left_out() -> None:
    camera = Camera(np.array([[200.0, 0, 400], [0, 200, 400], [0, 0, 1]]), 800, 800, np.zeros(4), "fisheye")
    pose = Pose.from_quaternion([0.4, 0.2, -0.6, 0.3], [0.5, -0.3, 8])
    pixels = camera.project(pose.transform(POINTS))
    pixels[3] = 740, 400  # 97 degrees from the axis
    found = plain_pnp(pixels, camera, POINTS)
    assert found is not None
    assert max(pose_errors(pose, found)) < 1e-4
    pixels[3:] = 740, 400
    assert plain_pnp(pixels, camera, POINTS) is None


def test_the_estimate_comes_from_the_given_crop() -> None:
    box = Box.around(CAMERA.project(POSE.transform(POINTS)))

    def network(images: np.ndarray) -> NetworkOutput:
        side = round(box.side * 1.25)
        corner = np.array([round(c - side / 2) for c in box.centre])
        inside = (CAMERA.project(POSE.transform(POINTS)) - corner) * 256 / side
        y, x = (np.mgrid[:64, :64] + 0.5) * 4
        return NetworkOutput(np.exp(-((x - inside[:, :1, None]) ** 2 + (y - inside[:, 1:, None]) ** 2) / 72)[None])

    estimator = PaperEstimator(network, CRAFT)
    image = np.zeros((640, 800, 3), np.uint8)
    estimate = estimator.estimate(image, CAMERA, box)
    assert estimate.cam_from_body is not None
    e_t, e_q = pose_errors(POSE, estimate.cam_from_body)
    assert e_t < 0.05
    assert 1e-3 < e_q < 0.1  # whole cells cost this
    with pytest.raises(GknetError, match="box"):
        estimator.estimate(image, CAMERA)
