"""What the loss of a keypoint network counts: both looks, and no keypoint that was told."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from gknet.network.heatmap import SIGMA_CELLS, Branches, Hints  # noqa: E402
from gknet.training.batch import Batch  # noqa: E402
from gknet.training.loss import gaussian_targets, heatmap_loss  # noqa: E402
from gknet.training.tasks import FIRST_LOOK, KeypointTask  # noqa: E402
from tests.training.toy import toy_spacecraft  # noqa: E402

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


class Answers(torch.nn.Module):
    """A network that answers with given maps and keeps what it was told."""

    loss, stride = "squared", 4

    def __init__(self, branches: Branches) -> None:
        super().__init__()
        self.answer, self.looks_twice = branches, branches.first is not None
        self.hints: list[Hints] = []

    def branches(self, image: torch.Tensor, *hints: Hints) -> Branches:
        self.hints += hints
        return self.answer


def loss(branches: Branches, auxiliary: float = 0.0) -> float:
    task = KeypointTask(toy_spacecraft(), 64, auxiliary)
    return task.loss(Answers(branches), BATCH, CPU).item()


def wrong(picture: int, keypoint: int) -> torch.Tensor:
    maps = TRUTH.clone()
    maps[picture, keypoint] += 1
    return maps


def test_a_network_that_looks_twice_is_told_the_truth_of_the_told() -> None:
    network = Answers(Branches(TRUTH, TRUTH, TRUTH, TRUTH))
    assert KeypointTask(toy_spacecraft(), 64, 0.2).loss(network, BATCH, CPU) == 0
    (hints,) = network.hints
    assert torch.equal(hints.maps, TRUTH)
    assert torch.equal(hints.told, BATCH.told)


def test_the_told_keypoints_count_in_the_first_look_alone() -> None:
    told, untold = wrong(0, 2), wrong(0, 3)
    assert loss(Branches(told, TRUTH, told, TRUTH), 0.2) == 0
    assert loss(Branches(untold, TRUTH, TRUTH, TRUTH)) > 0
    for maps in (told, untold):
        expected = FIRST_LOOK * heatmap_loss(maps, TRUTH, BATCH.weight).item()
        assert loss(Branches(TRUTH, TRUTH, TRUTH, maps)) == pytest.approx(expected)


def test_a_network_that_looks_once_answers_for_every_keypoint_in_view() -> None:
    told, out_of_view = wrong(0, 2), wrong(0, 4)
    expected = heatmap_loss(told, TRUTH, BATCH.weight).item()
    assert expected > 0
    assert loss(Branches(told, TRUTH, TRUTH)) == pytest.approx(expected)
    assert loss(Branches(TRUTH, told, TRUTH), 0.2) == pytest.approx(0.2 * expected)
    assert loss(Branches(out_of_view, out_of_view, out_of_view), 0.2) == 0
