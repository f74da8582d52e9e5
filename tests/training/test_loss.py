"""Targets below the pixel, losses that mask, boxes that measure."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gknet.inference.decode import SPREAD_CELLS, decode_heatmaps
from gknet.inference.locator import decode_locator
from gknet.network.heatmap import SHARPNESS, SIGMA_CELLS
from gknet.training.loss import (
    box_iou,
    gaussian_targets,
    heatmap_loss,
    likelihood_loss,
    locator_loss,
)


def test_targets_are_gaussians_about_sub_pixel_centres() -> None:
    points = torch.tensor([[[101.3, 57.8], [3.0, 250.1]]])
    targets = gaussian_targets(points, 4, 64, 64, 1.5)
    assert targets.shape == (1, 2, 64, 64)
    i, j = 14, 25  # the cell about (101.3, 57.8)
    x, y = 4 * (j + 0.5), 4 * (i + 0.5)
    expected = np.exp(-((x - 101.3) ** 2 + (y - 57.8) ** 2) / (2 * 6.0**2))
    assert targets[0, 0, i, j].item() == pytest.approx(expected, abs=1e-6)
    assert targets[0, 0].argmax().item() == i * 64 + j
    half_a_pixel = gaussian_targets(points + 0.5, 4, 64, 64, 1.5)
    assert (targets - half_a_pixel).abs().max() > 0.01


class Counted(TorchDispatchMode):
    """How many operations torch was asked for."""

    operations = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations += 1
        return func(*args, **(kwargs or {}))


def test_targets_are_drawn_at_once_however_many_there_are() -> None:
    counts = []
    for batch, keypoints in ((1, 1), (8, 20)):
        with Counted() as counted:
            gaussian_targets(torch.rand(batch, keypoints, 2) * 64, 4, 16, 16, 1.5)
        counts.append(counted.operations)
    assert counts[0] == counts[1]


def test_the_decoder_expects_the_width_that_is_trained() -> None:
    assert SPREAD_CELLS == SIGMA_CELLS


@pytest.mark.parametrize(("stride", "cells"), [(4, 64), (4, 32), (8, 32)])
def test_decoding_a_target_gives_back_its_point(stride: int, cells: int) -> None:
    points = np.random.default_rng(0).uniform(12, stride * cells - 12, (20, 2))
    targets = gaussian_targets(torch.from_numpy(points).float()[None], stride, cells, cells, 1.5)
    found = decode_heatmaps(targets[0].numpy(), stride)
    np.testing.assert_allclose(found.pixels, points, atol=0.05)


def test_the_loss_is_zero_on_the_truth_and_blind_to_masked_keypoints() -> None:
    points = torch.rand(2, 5, 2) * 128
    targets = gaussian_targets(points, 4, 32, 32, 1.5)
    weight = torch.ones(2, 5)
    assert heatmap_loss(targets, targets, weight) == 0
    weight[0, 3] = 0
    wrong = targets.clone()
    wrong[0, 3] += 7
    assert heatmap_loss(wrong, targets, weight) == 0
    wrong[1, 2, 4, 4] += 2
    assert heatmap_loss(wrong, targets, weight).item() == pytest.approx(4 / 9, rel=1e-5)
    assert heatmap_loss(wrong, targets, torch.zeros(2, 5)) == 0


def test_the_likelihood_loss_is_zero_on_the_truth_and_blind_to_masked_keypoints() -> None:
    points = 16 + torch.rand(2, 5, 2) * 32  # far from their mirror images
    targets = gaussian_targets(points, 4, 32, 32, SIGMA_CELLS)
    maps = targets.clamp(min=1e-30).log() / SHARPNESS
    weight = torch.ones(2, 5)
    assert likelihood_loss(maps, targets, weight).item() == pytest.approx(0, abs=1e-5)
    assert likelihood_loss(maps + 3, targets, weight).item() == pytest.approx(0, abs=1e-5)  # no change of probability
    counterparts = torch.logaddexp(maps * SHARPNESS, maps.flip(3) * SHARPNESS) / SHARPNESS
    assert likelihood_loss(counterparts, targets, weight).item() == pytest.approx(np.log(2), rel=0.2)
    maps[0, 3] = torch.rand(32, 32)
    assert likelihood_loss(maps, targets, weight) > 0.1
    weight[0, 3] = 0
    assert likelihood_loss(maps, targets, weight).item() == pytest.approx(0, abs=1e-5)
    assert likelihood_loss(maps, targets, torch.zeros(2, 5)) == 0


def test_iou_of_boxes() -> None:
    a = torch.tensor([[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 1.0, 1.0]])
    b = torch.tensor([[1.0, 0.0, 3.0, 2.0], [2.0, 2.0, 3.0, 3.0]])
    torch.testing.assert_close(box_iou(a, b), torch.tensor([1 / 3, 0.0]))


def perfect_locator_output(corners: torch.Tensor, cells: int = 64, stride: int = 4) -> torch.Tensor:
    size = cells * stride
    heat = gaussian_targets(corners.mean(dim=1, keepdim=True), stride, cells, cells, 1.5)
    place = (torch.arange(cells) + 0.5) / cells
    x, y = place.expand(cells, -1), place[:, None].expand(-1, cells)
    boxes = [torch.stack([x - c[0, 0], y - c[0, 1], c[1, 0] - x, c[1, 1] - y]) for c in corners / size]
    return torch.cat([heat, torch.stack(boxes).clamp(min=0)], dim=1)


def test_the_locator_loss_has_its_least_at_the_truth_and_decodes_to_it() -> None:
    corners = torch.tensor([[[40.0, 61.0], [130.0, 200.0]], [[100.0, 20.0], [140.0, 60.0]]])
    weight = torch.ones(2, 2)
    truth = perfect_locator_output(corners)
    best = locator_loss(truth, corners, weight, 4, 1.5)
    for other in (corners + 6, corners * 1.1):
        assert locator_loss(perfect_locator_output(other), corners, weight, 4, 1.5) > best + 0.1
    found = decode_locator(truth[0].numpy(), 4, 256)
    assert found is not None
    box, score = found
    assert score > 0.9
    np.testing.assert_allclose([box.x0, box.y0, box.x1, box.y1], [40, 61, 130, 200], atol=0.5)


def test_a_picture_without_the_craft_asks_only_for_an_empty_map() -> None:
    corners, weight = torch.zeros(1, 2, 2), torch.zeros(1, 2)
    empty = torch.cat([torch.full((1, 1, 64, 64), 1e-6), torch.rand(1, 4, 64, 64)], dim=1)
    assert locator_loss(empty, corners, weight, 4, 1.5) < 0.1
