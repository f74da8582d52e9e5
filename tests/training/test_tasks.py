"""What the loss of a keypoint network counts: both passes, and no prompted keypoint in the second."""

from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip("torch")

import torch

from gknet.inference.attitude import AttitudeBins
from gknet.network.heatmap import SIGMA_CELLS, HeatmapBranches, KeypointPrompts
from gknet.training.batch import Batch
from gknet.training.loss import gaussian_targets, heatmap_loss
from gknet.training.tasks import ATTITUDE_WEIGHT, FIRST_PASS_WEIGHT, KeypointTask
from tests.training.toy import toy_spacecraft

CPU = torch.device("cpu")
BATCH = Batch(
    torch.zeros((2, 64, 64, 3), dtype=torch.uint8),
    16 + torch.rand(2, 5, 2) * 32,
    torch.tensor([[1.0, 1, 1, 1, 0], [1, 1, 1, 1, 1]]),
    torch.tensor([[True, False, True, False, False], [False] * 5]),
    torch.zeros(2, 7),
    2,
)
TRUTH = gaussian_targets(BATCH.points_px, 4, 16, 16, SIGMA_CELLS)


class Fixed(torch.nn.Module):
    """A network with given maps that keeps its prompts."""

    loss, stride = "squared", 4

    def __init__(self, branches: HeatmapBranches) -> None:
        super().__init__()
        self.fixed, self.two_pass = branches, branches.first_pass is not None
        self.prompts: list[KeypointPrompts] = []

    def branches(self, image: torch.Tensor, *prompts: KeypointPrompts) -> HeatmapBranches:
        self.prompts += prompts
        return self.fixed


def loss(branches: HeatmapBranches, auxiliary: float = 0.0) -> float:
    task = KeypointTask(toy_spacecraft(), 64, auxiliary)
    return task.loss(Fixed(branches), BATCH, CPU).item()


def wrong(picture: int, keypoint: int) -> torch.Tensor:
    maps = TRUTH.clone()
    maps[picture, keypoint] += 1
    return maps


def test_a_two_pass_network_receives_the_truth_of_prompted_keypoints() -> None:
    network = Fixed(HeatmapBranches(TRUTH, TRUTH, TRUTH, TRUTH))
    assert KeypointTask(toy_spacecraft(), 64, 0.2).loss(network, BATCH, CPU) == 0
    (prompts,) = network.prompts
    assert torch.equal(prompts.maps, TRUTH)
    assert torch.equal(prompts.prompted, BATCH.prompted)


def test_prompted_keypoints_count_in_the_first_pass_alone() -> None:
    prompted, other = wrong(0, 2), wrong(0, 3)
    assert loss(HeatmapBranches(prompted, TRUTH, prompted, TRUTH), 0.2) == 0
    assert loss(HeatmapBranches(other, TRUTH, TRUTH, TRUTH)) > 0
    for maps in (prompted, other):
        expected = FIRST_PASS_WEIGHT * heatmap_loss(maps, TRUTH, BATCH.weight).item()
        assert loss(HeatmapBranches(TRUTH, TRUTH, TRUTH, maps)) == pytest.approx(expected)


def test_a_network_with_one_pass_has_a_loss_on_every_keypoint_in_view() -> None:
    in_view, out_of_view = wrong(0, 2), wrong(0, 4)
    expected = heatmap_loss(in_view, TRUTH, BATCH.weight).item()
    assert expected > 0
    assert loss(HeatmapBranches(in_view, TRUTH, TRUTH)) == pytest.approx(expected)
    assert loss(HeatmapBranches(TRUTH, in_view, TRUTH), 0.2) == pytest.approx(0.2 * expected)
    assert loss(HeatmapBranches(out_of_view, out_of_view, out_of_view), 0.2) == 0


def test_the_attitude_has_a_loss_where_a_pose_is_known() -> None:
    bins = AttitudeBins(4)
    quaternions = torch.nn.functional.normalize(torch.randn(2, 4), dim=1)
    label = torch.from_numpy(bins.soft_label(quaternions.numpy())).float()
    pose = torch.cat([torch.zeros(2, 3), quaternions], dim=1)

    def counted(attitude: torch.Tensor, known: torch.Tensor, auxiliary: float = 0.2) -> float:
        task = KeypointTask(toy_spacecraft(), 64, auxiliary, bins)
        batch = replace(BATCH, pose=torch.where(known[:, None], pose, torch.nan))
        return task.loss(Fixed(HeatmapBranches(TRUTH, TRUTH, None, None, attitude)), batch, CPU).item()

    both, first, neither = torch.tensor([[True, True], [True, False], [False, False]])
    right, mixed = label.clamp(min=1e-12).log(), torch.zeros_like(label)
    assert counted(right, both) == pytest.approx(0, abs=1e-5)
    divergence = (label * (label.clamp(min=1e-12) * len(label[0])).log()).sum(dim=1)  # from equal probabilities
    assert counted(mixed, both) == pytest.approx(ATTITUDE_WEIGHT * divergence.mean().item(), rel=1e-4)
    assert counted(mixed, first) == pytest.approx(ATTITUDE_WEIGHT * divergence[0].item(), rel=1e-4)
    assert counted(mixed, neither) == 0
