"""Whatever estimates poses obeys one protocol. The type checker compares the signatures; this compares the rest."""

from __future__ import annotations

import numpy as np
import pytest

import gknet
from gknet.evaluation.paper_protocol import PaperEstimator
from gknet.inference.direct_estimator import DirectEstimator
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.network_io import NetworkOutput
from tests.cli.toy import ToyEstimator

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)
CRAFT = gknet.Spacecraft("probe", tuple(f"k{i}" for i in range(14)), POINTS, ((0, 1),), 6.5)
CAMERA = gknet.Camera.from_focal(1000, 800, 640)


def keypoint_network(images: np.ndarray) -> NetworkOutput:
    return NetworkOutput(np.zeros((1, 14, 64, 64), dtype=np.float32))


def direct_network(images: np.ndarray) -> np.ndarray:
    return np.full((1, 2051), np.nan, dtype=np.float32)


def locator(images: np.ndarray) -> np.ndarray:
    return np.zeros((1, 5, 64, 64), dtype=np.float32)


ESTIMATORS: list[tuple[gknet.PoseEstimator, bool]] = [
    (KeypointEstimator(keypoint_network, CRAFT), False),
    (KeypointEstimator(keypoint_network, CRAFT, locator), True),
    (DirectEstimator(direct_network, CRAFT), False),
    (DirectEstimator(direct_network, CRAFT, locator=locator), True),
    (PaperEstimator(keypoint_network, CRAFT), False),
    (ToyEstimator(spacecraft=CRAFT), True),
]


@pytest.mark.parametrize(("estimator", "has_locator"), ESTIMATORS, ids=lambda value: type(value).__name__)
def test_an_estimator_has_a_spacecraft_and_needs_a_box_or_a_locator(
    estimator: gknet.PoseEstimator, has_locator: bool
) -> None:
    image = np.zeros((640, 800, 3), dtype=np.uint8)
    assert estimator.spacecraft is CRAFT
    assert estimator.has_locator == has_locator
    estimate = estimator.estimate(image, CAMERA, gknet.Box(200, 200, 500, 400))
    assert (estimate.cam_from_body is None) == isinstance(estimate.failure, gknet.Failure)
    if not has_locator:
        with pytest.raises(gknet.GknetError, match="box"):
            estimator.estimate(image, CAMERA)
