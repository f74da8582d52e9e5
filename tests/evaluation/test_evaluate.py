"""Whose box an estimate is given, that every frame counts, and which keypoint a detection is taken for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gknet.dataset.skd import SkdDataset
from gknet.evaluation.evaluate import Protocol, evaluate, taken_for
from gknet.frame import Box, Keypoints
from gknet.inference.crop import Crop
from tests.cli.toy import Noting, ToyEstimator, write_toy_dataset


def test_the_truth_makes_the_oracles_crop_and_no_other(tmp_path: Path) -> None:
    dataset = SkdDataset(write_toy_dataset(tmp_path / "set", sequences=1, frames=3))
    truth = [dataset.frame(i, image=False).true_box(dataset.spacecraft.points_m) for i in range(3)]
    cases: list[tuple[Protocol, list[Box | None]]] = [("oracle", truth), ("detected", [None] * 3)]
    for protocol, boxes in cases:
        estimator = Noting()
        evaluate(dataset, estimator, (protocol,))
        assert estimator.given == boxes


def test_every_frame_counts_the_last_one_too(tmp_path: Path) -> None:
    """One failure, wherever it is, is one seventh of the mean."""
    dataset = SkdDataset(write_toy_dataset(tmp_path / "set", sequences=1, frames=7))
    for lost in (0, 6):
        (run,) = evaluate(dataset, ToyEstimator(blind=frozenset({lost})), ("detected",)).runs
        found = run.summary.metrics
        assert found["e_t"].frames == found["rmse_px"].frames == 7
        np.testing.assert_allclose(found["e_q_rad"].mean, np.pi / 7, rtol=1e-5)


def test_a_swap_is_near_another_keypoint_and_far_from_its_own() -> None:
    true_px = np.array([[100.0, 100], [140, 100], [148, 100], [300, 300], [500, 500]])
    found = np.array([[104.0, 100], [101, 101], [141, 100], [350, 300], [300, 300]])
    in_view = np.array([True, True, True, True, False])
    keypoints = Keypoints(found, np.ones(5), np.tile(np.eye(2), (5, 1, 1)))
    crop = Crop(0, 0, 256, 256)
    # right; at 0 instead of 1; within 10 px of its own, though nearer to another; nowhere; out of view
    assert taken_for(keypoints, true_px, in_view, crop).tolist() == [0, 0, 2, -1, -1]
    assert taken_for(None, true_px, in_view, crop).tolist() == [-1] * 5
    without_peak = replace(keypoints, score=np.array([1, 0, 1, 1, 1.0]))
    assert taken_for(without_peak, true_px, in_view, crop).tolist() == [0, -1, 2, -1, -1]
    small = Crop(0, 0, 1024, 256)  # four image pixels are one of the crop: all is nearer
    assert taken_for(keypoints, true_px, in_view, small).tolist() == [0, 1, 2, -1, -1]
