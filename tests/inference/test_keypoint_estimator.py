"""Image to pose with a network that is perfect: what is left is the error of our own geometry."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import gknet.inference.keypoint_estimator as estimating
from gknet.errors import GknetError
from gknet.evaluation.metrics import compute_errors
from gknet.frame import Box, Failure, FailureKind, Frame
from gknet.geometry import Camera, Pose
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.crop_estimator import InferenceSettings
from gknet.inference.crop_pose import allocentric_wxyz
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.network_io import NetworkOutput
from gknet.inference.pnp import PnpResult, PnpSettings
from gknet.spacecraft import Spacecraft
from tests.inference.test_decode import gaussians
from tests.inference.test_locator import locator_output

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)
CRAFT = Spacecraft("probe", tuple(f"k{i}" for i in range(14)), POINTS, ((0, 1), (1, 2)), 6.5)
CAMERA = Camera.from_focal(1000, 800, 640)


class Chart:
    """An image whose red and green encode where each pixel is, and whose blue marks the image itself.

    Red and green rise from 0 to 1 over the square from `low` to `low + span`, dithered so that they err nowhere.
    """

    def __init__(self, camera: Camera, box: Box) -> None:
        self.camera = camera
        self.span = 2.6 * box.side
        self.low = np.array(box.centre) - self.span / 2

    def image(self) -> np.ndarray:
        height, width = self.camera.height, self.camera.width
        y, x = np.mgrid[:height, :width] + 0.5
        level = np.clip((np.stack([x, y], axis=2) - self.low) / self.span, 0, 1) * 255
        dithered = np.floor(level + np.random.default_rng(0).random(level.shape))
        return np.dstack([dithered, np.full((height, width), 255)]).astype(np.uint8)

    def read(self, crop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scale and offset of the crop, from nothing but its pixels: crop = scale * image + offset, per axis."""
        size = crop.shape[1]
        scale, offset = np.ones(2), np.zeros(2)
        for axis in range(2):
            use = (crop[2] > 0.999) & (crop[axis] > 0.02) & (crop[axis] < 0.98)
            use[:4], use[-4:], use[:, :4], use[:, -4:] = False, False, False, False
            out = np.mgrid[:size, :size][1 - axis][use] + 0.5
            slope, start = np.polyfit(out, crop[axis][use] * self.span + self.low[axis], 1)  # image = slope out + start
            scale[axis], offset[axis] = 1 / slope, -start / slope
        return scale, offset


class PerfectNetwork:
    """Reads from the chart where the crop lies and draws a Gaussian at each true keypoint."""

    def __init__(self, true_px: np.ndarray, chart: Chart, swapped: int = 0) -> None:
        self.true_px, self.chart, self.calls = true_px.copy(), chart, 0
        self.true_px[:swapped] = np.roll(self.true_px[:swapped], 1, axis=0)

    def truth_in(self, images: np.ndarray) -> np.ndarray:
        """The points in pixels of the crop."""
        self.calls += 1
        scale, offset = self.chart.read(images[0])
        return self.true_px * scale + offset

    def __call__(self, images: np.ndarray) -> NetworkOutput:
        return NetworkOutput(gaussians(self.truth_in(images) / 4)[None])


def perfect_locator(box: Box, chart: Chart) -> Callable[[np.ndarray], np.ndarray]:
    """Reads from the chart where the corners of the box are."""
    corners = PerfectNetwork(np.array([[box.x0, box.y0], [box.x1, box.y1]]), chart)

    def locate(images: np.ndarray) -> np.ndarray:
        (x0, y0), (x1, y1) = corners.truth_in(images)
        return locator_output((x0, y0, x1, y1))[None]

    return locate


@dataclass(frozen=True, eq=False)
class Scene:
    """An image with its truth, and an estimator whose network makes no error."""

    estimator: KeypointEstimator
    network: PerfectNetwork
    frame: Frame
    image: np.ndarray
    box: Box


def perfect(pose: Pose, swapped: int = 0, refine_crop: bool = True) -> Scene:
    blank = Frame("chart", None, CAMERA, pose)
    box = blank.true_box(POINTS)
    assert box is not None
    chart = Chart(CAMERA, box)
    network = PerfectNetwork(blank.keypoints_px(POINTS), chart, swapped)
    settings = InferenceSettings(refine_crop=refine_crop)
    estimator = KeypointEstimator(network, CRAFT, perfect_locator(box, chart), settings)
    image = chart.image()
    return Scene(estimator, network, replace(blank, image=image), image, box)


def with_attitude(network: PerfectNetwork, attitude: np.ndarray) -> Callable[[np.ndarray], NetworkOutput]:
    return lambda images: network(images)._replace(attitude=attitude)


POSES = {
    "middle": Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [0.3, -0.2, 12.0]),
    "half turn": Pose.from_quaternion([0, 1, 0, 0], [-0.5, 0.4, 15.0]),
    "beyond the border": Pose.from_quaternion([0.9, 0.1, -0.3, 0.2], [4.6, -1.0, 12.0]),
    "far": Pose.from_quaternion([0.1, 0.9, -0.3, 0.2], [3.0, 2.0, 60.0]),
    "close": Pose.from_quaternion([0.5, 0.5, -0.3, 0.1], [0.2, 0.1, 6.0]),
}


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("oracle", [True, False])
def test_image_to_pose(name: str, oracle: bool) -> None:
    scene = perfect(POSES[name])
    estimate = scene.estimator.estimate(scene.image, CAMERA, scene.box if oracle else None)
    assert estimate.failure is None
    found = compute_errors(scene.frame, estimate, CRAFT)
    assert found.e_t < 1e-3
    assert found.e_q_rad < 3e-3
    assert found.rmse_px is not None
    assert found.rmse_px < 0.5  # the rounding of 8 bits, magnified where the spacecraft is far
    assert found.locator_iou is not None
    assert found.locator_iou > (0.999 if oracle else 0.9)


def test_what_one_orientation_alone_shows_is_averaged_out() -> None:
    """A dot in the image, and a higher peak at one cell of every view, which is another place in each of them."""
    y, x = np.mgrid[:256, :256] + 0.5
    dot = np.exp(-((x - 170) ** 2 + (y - 80) ** 2) / (2 * 6**2))
    image = np.repeat((230 * dot).astype(np.uint8)[:, :, None], 3, axis=2)
    batches = []

    def network(images: np.ndarray) -> NetworkOutput:
        batches.append(len(images))
        maps = images[:, :1].reshape(len(images), 1, 64, 4, 64, 4).mean(axis=(3, 5))
        maps[:, :, 5, 7] = 1
        return NetworkOutput(np.repeat(maps, 14, axis=1).astype(np.float32))

    for tta_rotations, place in ((1, (30, 22)), (2, (170, 80)), (4, (170, 80))):
        estimator = KeypointEstimator(network, CRAFT, settings=InferenceSettings(tta_rotations=tta_rotations))
        found, _ = estimator.detect(image, Crop(0, 0, 256, 256))
        np.testing.assert_allclose(found.pixels, [place] * 14, atol=0.2)
        assert found.score.min() > 0.7  # every view agrees
    assert batches == [1, 2, 4]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"tta_rotations": 3}, "1, 2 or 4"),
        ({"input_size": 0}, "input_size"),
        ({"locator_size": 100_000}, "locator_size"),
        ({"min_located": math.nan}, "min_located"),
        ({"refine_iou": 1.5}, "refine_iou"),
    ],
)
def test_settings_out_of_range_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(GknetError, match=words):
        InferenceSettings(**wrong)


def test_a_box_that_the_keypoints_contradict_is_no_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = perfect(POSES["middle"])
    true_solve, boxes = estimating.solve_pnp, []

    def solve(*arguments: Any) -> PnpResult | Failure:
        boxes.append(arguments[5])
        return true_solve(*arguments)

    monkeypatch.setattr(estimating, "solve_pnp", solve)
    good = scene.box
    poor = Box(good.x0 + 0.35 * good.side, good.y0, good.x1 + 0.35 * good.side, good.y1)
    for box in (good, poor):
        scene.estimator.estimate(scene.image, CAMERA, box)
    assert boxes == [good, poor, None]


def test_swapped_keypoints_do_not_move_the_pose() -> None:
    scene = perfect(POSES["middle"], swapped=5)
    estimate = scene.estimator.estimate(scene.image, CAMERA)
    assert estimate.inliers is not None
    assert not estimate.inliers[:5].any()
    assert compute_errors(scene.frame, estimate, CRAFT).e_t < 1e-3


def test_a_poor_box_is_mended_by_crop_refinement() -> None:
    scene = perfect(POSES["middle"])
    good, shift = scene.box, 0.35 * scene.box.side
    poor = Box(good.x0 + shift, good.y0, good.x1 + shift, good.y1)
    estimate = scene.estimator.estimate(scene.image, CAMERA, poor)
    assert scene.network.calls == 2
    assert estimate.keypoints is not None
    assert estimate.box == poor
    assert estimate.keypoints.score.min() > 0.9
    once = perfect(POSES["middle"], refine_crop=False)
    first = once.estimator.estimate(scene.image, CAMERA, poor)
    assert once.network.calls == 1
    assert first.keypoints is not None
    assert first.keypoints.score.min() < 0.9


def test_a_box_far_larger_than_the_image_is_cut_to_it() -> None:
    scene = perfect(POSES["close"])
    estimate = scene.estimator.estimate(scene.image, CAMERA, Box(-1e9, -1e9, 1e9, 1e9))
    assert estimate.box == Box(0.0, 0.0, float(CAMERA.width), float(CAMERA.height))
    assert estimate.failure is None


def test_a_good_box_needs_one_run() -> None:
    scene = perfect(POSES["middle"])
    scene.estimator.estimate(scene.image, CAMERA, scene.box)
    assert scene.network.calls == 1


def test_same_image_same_estimate() -> None:
    scene = perfect(POSES["middle"])
    first, second = (scene.estimator.estimate(scene.image, CAMERA) for _ in range(2))
    assert first.covariance is not None
    assert second.covariance is not None
    assert np.array_equal(first.covariance, second.covariance)


def test_attitude_confidence_is_high_for_the_pose_and_low_for_a_symmetric_counterpart() -> None:
    """The counterpart is half a turn away about the body's z axis."""
    bins, pose = AttitudeBins(12), POSES["beyond the border"]
    scene = perfect(pose)
    box = scene.box
    assert scene.estimator.estimate(scene.image, CAMERA, box).attitude_confidence is None
    counterpart = pose @ Pose.from_rotation_vector([0, 0, math.pi], [0, 0, 0])
    for probable, low, high in ((pose, 0.95, 1.0), (counterpart, 0.0, 0.05)):
        label = bins.soft_label(allocentric_wxyz(probable))[None].astype(np.float32)
        certain = replace(scene.estimator, keypoint_network=with_attitude(scene.network, label), bins=bins)
        estimate = certain.estimate(scene.image, CAMERA, box)
        assert estimate.cam_from_body is not None
        assert estimate.cam_from_body.angle_to(pose) < 0.01
        assert estimate.attitude_confidence is not None
        assert low <= estimate.attitude_confidence <= high


def test_failures_are_values_with_reasons() -> None:
    scene = perfect(POSES["middle"])
    outside = scene.estimator.estimate(scene.image, CAMERA, Box(900, 0, 950, 50))
    assert outside.failure == Failure(FailureKind.BOX_OUTSIDE_IMAGE, "the box lies outside the image")
    blind = KeypointEstimator(lambda images: NetworkOutput(np.zeros((1, 14, 64, 64), dtype=np.float32)), CRAFT)
    estimate = blind.estimate(scene.image, CAMERA, scene.box)
    assert estimate.failure is not None
    assert estimate.failure.kind == FailureKind.TOO_FEW_KEYPOINTS
    assert "0 keypoints" in str(estimate.failure)
    assert estimate.keypoints is not None
    lost = KeypointEstimator(scene.network, CRAFT, lambda images: np.zeros((1, 5, 64, 64), dtype=np.float32))
    not_found = lost.estimate(scene.image, CAMERA)
    assert not_found.failure == Failure(FailureKind.NO_SPACECRAFT, "the locator finds no spacecraft")


@pytest.mark.parametrize("range_factor", [0.02, 100.0])
def test_a_pose_of_another_size_than_the_crop_is_refused(range_factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = perfect(POSES["middle"])
    true_solve = estimating.solve_pnp

    def solve(*arguments: Any) -> PnpResult:
        result = true_solve(*arguments)
        assert isinstance(result, PnpResult)
        pose = result.cam_from_body
        return replace(result, cam_from_body=Pose(pose.rotation, pose.translation_m * range_factor))

    monkeypatch.setattr(estimating, "solve_pnp", solve)
    estimate = scene.estimator.estimate(scene.image, CAMERA, scene.box)
    assert estimate.cam_from_body is None
    assert estimate.failure is not None
    assert estimate.failure.kind == FailureKind.IMPLAUSIBLE_SIZE


def test_thresholds_are_in_pixels_of_the_input() -> None:
    """A large crop is resized coarsely: 2 px in the input are many in the image, and still no outliers."""
    scene = perfect(POSES["close"])
    network = scene.network
    jitter = np.random.default_rng(1).normal(0, 2.0, POINTS.shape[:1] + (2,))

    def jittered(images: np.ndarray) -> NetworkOutput:
        return NetworkOutput(gaussians((network.truth_in(images) + jitter) / 4)[None])

    strict = PnpSettings(threshold_px=(6.0,), min_inlier_fraction=0.9)
    estimate = KeypointEstimator(jittered, CRAFT, pnp=strict).estimate(scene.image, CAMERA, scene.box)
    assert estimate.failure is None
    assert estimate.reprojection_rms_px is not None
    assert estimate.reprojection_rms_px > 3


def test_bad_use_is_refused() -> None:
    scene = perfect(POSES["middle"])
    with pytest.raises(GknetError, match="800 x 640"):
        scene.estimator.estimate(np.zeros((100, 100, 3), dtype=np.uint8), CAMERA)
    with pytest.raises(GknetError, match="give a box"):
        KeypointEstimator(scene.network, CRAFT).estimate(scene.image, CAMERA)
    few = replace(scene.estimator, keypoint_network=with_attitude(scene.network, np.ones((1, 4), np.float32)))
    with pytest.raises(GknetError, match="864 classes of attitude, got 4"):
        replace(few, bins=AttitudeBins(12)).estimate(scene.image, CAMERA, scene.box)
    wrong = KeypointEstimator(lambda images: NetworkOutput(np.zeros((1, 3, 64, 64), dtype=np.float32)), CRAFT)
    with pytest.raises(GknetError, match="14 heatmaps"):
        wrong.estimate(scene.image, CAMERA, scene.box)
