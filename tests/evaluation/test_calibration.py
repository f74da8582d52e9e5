"""A calibration finds how large the errors are, whatever the network estimated, and swaps do not mislead it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.evaluation.calibration import UNCALIBRATED, CalibrationSample, calibrated, collect_sample, fit_decoding
from gknet.evaluation.metrics import nees
from gknet.frame import Frame, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.inference.crop_estimator import InferenceSettings
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.network_io import NetworkOutput
from gknet.spacecraft import Spacecraft

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)
CRAFT = Spacecraft("probe", tuple(f"k{i}" for i in range(14)), POINTS, ((0, 1),), 6.5)
CAMERA = Camera.from_focal(1000, 800, 640)
STRIDE = 4


def spreads(count: int, rng: np.random.Generator) -> np.ndarray:
    turn = Rotation.from_euler("z", rng.uniform(0, np.pi, (count, 1))).as_matrix()[:, :2, :2]
    axes = rng.exponential(0.5, (count, 2))
    return np.einsum("kij,kj,klj->kil", turn, axes, turn)


@pytest.mark.parametrize(("floor", "scale", "swapped"), [(0.3, 0.5, 0.0), (0.1, 2.0, 0.0), (0.3, 0.5, 0.05)])
def test_floor_and_scale_are_found(floor: float, scale: float, swapped: float) -> None:
    rng = np.random.default_rng(0)
    spread = spreads(4000, rng)
    covariance = scale * spread + floor**2 * np.eye(2)
    error = np.einsum("kij,kj->ki", np.linalg.cholesky(covariance), rng.normal(size=(4000, 2)))
    error[rng.random(4000) < swapped] += 15
    found = fit_decoding(error, spread)
    assert found.floor_cells == pytest.approx(floor, rel=0.2)
    assert found.spread_scale == pytest.approx(scale, rel=0.35)


def samples(common_px: float, own_px: float, rng: np.random.Generator, count: int = 150) -> list[CalibrationSample]:
    """Keypoints off by an error of their own, and by a growth about the centre that all of an image share."""
    made = []
    for k in range(count):
        pose = Pose(Rotation.random(random_state=k).as_matrix(), np.array([0.2, -0.3, 14.0]))
        frame = Frame(f"{k}", None, CAMERA, pose)
        box = frame.true_box(POINTS)
        assert box is not None
        crop = Crop.around(box, 192)
        true_px = frame.keypoints_px(POINTS)
        away = (true_px - true_px.mean(axis=0)) / np.ptp(true_px)
        pixels = true_px + rng.normal(0, own_px, true_px.shape) + away * rng.normal(0, common_px)
        keypoints = Keypoints(pixels, np.full(14, 0.9), np.tile(1e-6 * np.eye(2), (14, 1, 1)))
        made.append(CalibrationSample(frame, box, crop, keypoints, crop.scale / STRIDE))
    return made


def median_nees(estimator: KeypointEstimator, seen: list[CalibrationSample]) -> float:
    found = [nees(s.frame.cam_from_body, s.estimate(estimator)) for s in seen if s.frame.cam_from_body is not None]
    return float(np.median([value for value in found if value is not None]))


@pytest.mark.parametrize("common_px", [0.0, 8.0])
def test_a_calibrated_covariance_fits_on_other_frames(common_px: float) -> None:
    rng = np.random.default_rng(1)
    bare = KeypointEstimator(NetworkOutput, CRAFT, settings=InferenceSettings(input_size=192), decoding=UNCALIBRATED)
    estimator = calibrated(bare, samples(common_px, 1.0, rng))
    assert (estimator.pnp.covariance_scale > 1.5) == (common_px > 0)
    assert median_nees(estimator, samples(common_px, 1.0, rng)) == pytest.approx(5.35, rel=0.3)
    independent = replace(estimator, pnp=replace(estimator.pnp, covariance_scale=1.0))
    if common_px > 0:
        assert median_nees(independent, samples(common_px, 1.0, rng)) > 8


def test_too_few_keypoints_are_refused() -> None:
    bare = KeypointEstimator(NetworkOutput, CRAFT, decoding=UNCALIBRATED)
    with pytest.raises(GknetError, match="at least 30"):
        calibrated(bare, samples(0, 1.0, np.random.default_rng(2), count=2))


def test_a_sight_decodes_as_the_estimator_does() -> None:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 12.0]))
    frame = Frame("f", np.zeros((640, 800, 3), np.uint8), CAMERA, pose)
    cells = np.random.default_rng(3).uniform(8, 40, (14, 2))
    y, x = np.mgrid[:48, :48] + 0.5
    squared = (x - cells[:, :1, None]) ** 2 + (y - cells[:, 1:, None]) ** 2
    heatmaps = (0.7 * np.exp(-squared / (2 * 1.5**2))).astype(np.float32)[None]
    bare = KeypointEstimator(
        lambda images: NetworkOutput(heatmaps), CRAFT, settings=InferenceSettings(input_size=192), decoding=UNCALIBRATED
    )
    seen = collect_sample(frame, bare, STRIDE)
    assert frame.image is not None
    assert seen.frame.image is None
    wanted = replace(bare, decoding=replace(UNCALIBRATED, floor_cells=0.4, spread_scale=0.6))
    np.testing.assert_allclose(
        seen.decoded(wanted.decoding).covariance_px2, wanted.detect(frame.image, seen.crop)[0].covariance_px2, rtol=1e-4
    )
