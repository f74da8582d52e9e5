"""Validation is the mean over every frame that can be used."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from gknet.dataset.skd import SkdDataset
from gknet.network.build import build
from gknet.network.heatmap import HeatmapNetwork
from gknet.training.validation import validate_keypoints, validate_locator
from tests.training.toy import write_toy

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> SkdDataset:
    root = tmp_path_factory.mktemp("toy")
    write_toy(root, 1, 5, 96)
    return SkdDataset(root, "val", "satellite_01")


class Middle(torch.nn.Module):
    """A locator that always finds the middle half of the image."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        output = torch.full((len(images), 5, 16, 16), 0.25)
        output[:, 0] = 0
        output[:, 0, 7:9, 7:9] = 1
        return output


def test_the_score_is_the_mean_over_all_rows(frames: SkdDataset) -> None:
    spacecraft = frames.spacecraft
    torch.manual_seed(0)
    network = build("gknet-s", spacecraft.adjacency, spacecraft.points_m)
    assert isinstance(network, HeatmapNetwork)

    def rmse_px(rows: list[int]) -> float:
        return validate_keypoints(network, CPU, frames, rows, spacecraft, 64).values["rmse_px"]

    def iou(rows: list[int]) -> float:
        return validate_locator(Middle(), CPU, frames, rows, spacecraft, 64).values["iou"]

    for measure in (rmse_px, iou):
        alone = [measure([row]) for row in range(5)]
        assert len(set(alone)) == 5
        assert measure(list(range(5))) == pytest.approx(np.mean(alone), rel=1e-6)
