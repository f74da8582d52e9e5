"""Which keypoint a detection is taken for."""

from __future__ import annotations

import numpy as np

from gknet.crop import Crop
from gknet.evaluation import taken_for
from gknet.frame import Keypoints


def test_a_swap_is_near_another_keypoint_and_far_from_its_own() -> None:
    true_px = np.array([[100.0, 100], [140, 100], [148, 100], [300, 300], [500, 500]])
    found = np.array([[104.0, 100], [101, 101], [141, 100], [350, 300], [300, 300]])
    in_view = np.array([True, True, True, True, False])
    keypoints = Keypoints(found, np.ones(5), np.tile(np.eye(2), (5, 1, 1)))
    crop = Crop(0, 0, 256, 256)
    # right; at 0 instead of 1; within 10 px of its own, though nearer to another; nowhere; out of view
    assert taken_for(keypoints, true_px, in_view, crop).tolist() == [0, 0, 2, -1, -1]
    assert taken_for(None, true_px, in_view, crop).tolist() == [-1] * 5
    small = Crop(0, 0, 1024, 256)  # four image pixels are one of the crop: all is nearer
    assert taken_for(keypoints, true_px, in_view, small).tolist() == [0, 1, 2, -1, -1]
