"""Laws of the networks: shapes at every size and number of keypoints, names and sizes, probabilities."""

from __future__ import annotations

from collections.abc import Callable

import pytest

pytest.importorskip("torch")

import torch
from torch.utils.flop_counter import FlopCounterMode

from gknet.errors import GknetError
from gknet.inference.attitude import AttitudeBins
from gknet.network.backbone import ConvNorm, position_encoding
from gknet.network.build import NETWORKS, build
from gknet.network.dmanet import DMANet, DMANetConfig, MultiScaleAttention
from gknet.network.gknet import GKNetConfig
from gknet.network.graph import normalised_adjacency
from gknet.network.heatmap import SHARPNESS, SIGMA_CELLS, expected_heatmaps, log_probability
from gknet.network.hrnet import HRNet, HRNetConfig
from gknet.network.network import Network
from gknet.network.resunet import ResUNet, ResUNetConfig
from gknet.training.loss import gaussian_targets
from tests.network.tiny import chain, points, tiny


def parameters(network: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def named(name: str, graph: str = "skeleton") -> Network:
    return build(name, chain(16), points(16), graph)


@pytest.mark.parametrize("count", [4, 13, 24])
@pytest.mark.parametrize("size", [128, 192, 256])
def test_any_number_of_keypoints_and_any_input_size(count: int, size: int) -> None:
    heatmaps = tiny(count)(torch.rand(2, 3, size, size))
    assert heatmaps.shape == (2, count, size // 4, size // 4)


@pytest.mark.parametrize("graph", ["skeleton", "identity", "none"])
def test_the_heatmaps_are_those_of_the_fused_branches(graph: str) -> None:
    network = tiny(5, graph).eval()
    image = torch.rand(1, 3, 64, 64)
    branches = network.branches(image)
    torch.testing.assert_close(network(image), expected_heatmaps(branches.fused))
    assert (branches.nodes is None) == (graph == "none")


def test_a_probability_sums_to_one_and_certainty_is_the_target_gaussian() -> None:
    maps = torch.randn(2, 3, 16, 16)
    torch.testing.assert_close(log_probability(maps).exp().sum(dim=2), torch.ones(2, 3))
    target = gaussian_targets(torch.tensor([[[33.0, 30.5]]]), 4, 16, 16, SIGMA_CELLS)
    torch.testing.assert_close(expected_heatmaps(target.log() / SHARPNESS), target, atol=1e-4, rtol=0)
    both = (target + target.flip(3)) / 2  # two positions, equally likely: two peaks of half the height
    torch.testing.assert_close(expected_heatmaps(both.log() / SHARPNESS), both, atol=1e-4, rtol=0)


def test_without_edges_the_size_is_the_same() -> None:
    assert parameters(tiny(9, "identity")) == parameters(tiny(9, "skeleton")) == parameters(tiny(9, "random"))
    for name in ("gknet-s", "gknet-xs"):
        whole, without = (parameters(named(name, graph)) for graph in ("skeleton", "none"))
        assert abs(without / whole - 1) < 0.03


@pytest.mark.parametrize("name", [name for name, spec in NETWORKS.items() if spec.has_graph])
def test_a_named_network_has_the_graph_that_was_asked_for(name: str) -> None:
    skeleton = chain(5)
    for graph in ("skeleton", "identity", "random"):
        network = build(name, skeleton, points(5), graph)
        found = [each for key, each in network.named_buffers() if key.endswith("adjacency")]
        assert found
        for each in found:
            torch.testing.assert_close(each, normalised_adjacency(skeleton, graph))  # type: ignore[arg-type]
    without = build(name, skeleton, points(5), "none")
    assert not [key for key, _ in without.named_buffers() if key.endswith("adjacency")]


def test_the_random_graph_has_as_many_edges_and_is_always_the_same() -> None:
    skeleton = chain(12)
    drawn = normalised_adjacency(skeleton, "random").numpy() > 0
    assert drawn.sum() == skeleton.sum()
    assert (drawn == drawn.T).all()
    assert drawn.diagonal().all()
    assert (drawn != skeleton).sum() > skeleton.sum() / 2
    assert (drawn == (normalised_adjacency(skeleton, "random").numpy() > 0)).all()


def small_hrnet(keypoints: int, stride: int = 4) -> HRNet:
    config = HRNetConfig(width=3, stem_width=4, bottlenecks=1, modules=(1, 2, 1), blocks=1)
    return HRNet(config, keypoints, stride=stride)


def small_resunet(keypoints: int, stride: int = 4) -> ResUNet:
    return ResUNet(ResUNetConfig(width=4, blocks=(1, 2, 1, 1)), keypoints, stride=stride)


@pytest.mark.parametrize("make", [small_hrnet, small_resunet])
@pytest.mark.parametrize("stride", [4, 8])
def test_the_baselines_at_any_size_and_number_of_keypoints(make: Callable[[int, int], HRNet], stride: int) -> None:
    torch.manual_seed(0)
    for count, size in ((4, 128), (13, 192)):
        network = make(count, stride)
        assert network(torch.rand(2, 3, size, size)).shape == (2, count, size // stride, size // stride)
    network.eval()
    images = torch.rand(3, 3, 64, 64)
    torch.testing.assert_close(network(images)[1:2], network(images[1:2]), atol=1e-5, rtol=1e-4)
    network.train()
    (network.branches(images).fused - 1).square().sum().backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    with pytest.raises(GknetError, match="stride"):
        make(4, 16)


def small_dmanet() -> DMANet:
    torch.manual_seed(0)
    return DMANet(DMANetConfig((4, 6, 8, 10), (2, 4, 4, 6), (1, 2, 1, 2), head=12, bins=4))


def test_dmanet_has_a_pose_at_any_input_size() -> None:
    network = small_dmanet()
    for size in (64, 128, 192):
        output = network(torch.rand(2, 3, size, size))
        assert output.shape == (2, 3 + AttitudeBins(4).count)
        assert (output[:, 3:] >= 0).all()
        torch.testing.assert_close(output[:, 3:].sum(dim=1), torch.ones(2))
    network.eval()
    images = torch.rand(3, 3, 64, 64)
    torch.testing.assert_close(network(images)[1:2], network(images[1:2]), atol=1e-5, rtol=1e-4)
    named_one = named("dmanet-xs")
    assert named_one.attitude_bins is not None
    assert named_one(torch.rand(2, 3, 64, 64)).shape == (2, 3 + AttitudeBins(named_one.attitude_bins).count)


def test_gradients_reach_every_parameter_of_dmanet() -> None:
    network = small_dmanet()
    offset, log_depth, attitude = network.branches(torch.rand(4, 3, 64, 64))
    (offset.square().sum() + log_depth.square().sum() + attitude.square().sum()).backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]


def test_a_block_is_dense_and_has_three_scales() -> None:
    """What comes in goes out beside what is added; the convolutions of an MAB are 3, 5 and 7 cells wide."""
    block = MultiScaleAttention(5, 4).eval()
    x = torch.randn(1, 5, 16, 16)
    out = block(x)
    assert out.shape == (1, 9, 16, 16)
    torch.testing.assert_close(out[:, :5], x)
    entered = torch.randn(1, 4, 16, 16)
    moved = entered.clone()
    moved[:, :, 8, 8] += 1
    kernels = [scale.conv for scale in block.scales if isinstance(scale, ConvNorm)]
    changed = [(conv(entered) != conv(moved)).any(dim=1)[0] for conv in kernels]
    assert [int(each.any(dim=0).sum()) for each in changed] == [3, 5, 7]


def test_votes_for_the_origin_are_counted_from_each_cell() -> None:
    """Certain cells decide; a vote of nothing is the cell's own centre, in sides of the crop from its middle."""
    votes = torch.zeros(1, 3, 4, 8)
    votes[0, 0, 3, 0] = 50.0
    torch.testing.assert_close(DMANet._offset(votes), torch.tensor([[0.5 / 8 - 0.5, 3.5 / 4 - 0.5]]))
    votes[0, 1:, 3, 0] = torch.tensor([0.3, -0.2])
    torch.testing.assert_close(DMANet._offset(votes), torch.tensor([[0.5 / 8 - 0.2, 3.5 / 4 - 0.7]]))
    torch.testing.assert_close(DMANet._offset(torch.zeros(1, 3, 4, 8)), torch.zeros(1, 2))


def multiply_accumulates(network: torch.nn.Module) -> float:
    counter = FlopCounterMode(display=False)
    with counter:
        network.eval()(torch.rand(1, 3, 256, 256))
    return counter.get_total_flops() / 2


def test_the_methods_cost_the_same_to_run() -> None:
    ours = multiply_accumulates(named("gknet-xs"))
    for other in ("hrnet-xs", "resunet-xs", "dmanet-xs"):
        assert abs(multiply_accumulates(named(other)) / ours - 1) < 0.05


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("gknet-s", 2e6, 3.7e6),
        ("gknet-xs", 0.8e6, 1.1e6),
        ("gknet-paper", 80e6, 100e6),
        ("hrnet", 28e6, 30e6),
        ("resunet", 23e6, 26e6),
        ("dmanet", 25e6, 30e6),
        ("locator", 0.5e6, 0.8e6),
    ],
)
def test_named_sizes(name: str, low: float, high: float) -> None:
    assert low < parameters(named(name)) < high


def test_the_encoding_of_a_position_is_the_same_at_every_resolution() -> None:
    fine, coarse = position_encoding(30, 30, torch.zeros(1)), position_encoding(10, 10, torch.zeros(1))
    torch.testing.assert_close(fine[:, 1::3, 1::3], coarse, atol=1e-5, rtol=0)


def test_the_locator_gives_probabilities_and_lengths() -> None:
    output = named("locator")(torch.rand(2, 3, 256, 256))
    assert output.shape == (2, 5, 64, 64)
    assert (output >= 0).all()
    assert (output[:, 0] <= 1).all()


def test_an_image_alone_does_not_depend_on_its_batch() -> None:
    network = tiny(5).eval()
    images = torch.rand(3, 3, 64, 64)
    torch.testing.assert_close(network(images)[1:2], network(images[1:2]), atol=1e-5, rtol=1e-4)


def test_bad_choices_are_named() -> None:
    for sizes in ({"width": 0}, {"modules": (1, 0, 3)}):
        with pytest.raises(GknetError, match="hrnet"):
            HRNetConfig(**sizes)
    with pytest.raises(GknetError, match="resunet"):
        ResUNetConfig(blocks=(0, 1, 1, 1))
    widths, blocks = (4, 4, 4, 4), (1, 1, 1, 1)
    for head, bins in ((0, 16), (4, 7)):
        with pytest.raises(GknetError, match="dmanet"):
            DMANetConfig(widths, widths, blocks, head, bins)
    with pytest.raises(GknetError, match="loss"):
        build("gknet-s", chain(5), points(5), loss="hinge")
    with pytest.raises(GknetError, match="graph"):
        GKNetConfig(graph="full")
    with pytest.raises(GknetError, match="network"):
        build("hourglass", chain(5), points(5))
    with pytest.raises(GknetError, match="multiples of 32"):
        tiny(5)(torch.rand(1, 3, 100, 100))
