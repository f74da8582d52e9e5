"""Laws of the graph decoder: constant edges, paths between nodes, feature sampling, position votes, fusion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from gknet.errors import GknetError
from gknet.network.backbone import POSITION_WIDTH, fourier_encoding, position_encoding
from gknet.network.build import build
from gknet.network.gknet import GKNet
from gknet.network.graph import EdgeConvolution, Fusion, GraphConvolution, normalised_adjacency
from gknet.network.heatmap import SHARPNESS, KeypointPrompts
from tests.network.tiny import chain, layers_of, points, tiny


def test_adjacency_is_normalised_as_in_equation_3() -> None:
    matrix = chain(4)
    degree = matrix.sum(axis=1)
    expected = matrix / np.sqrt(degree[:, None] * degree[None, :])
    np.testing.assert_allclose(normalised_adjacency(matrix).numpy(), expected, atol=1e-7)
    np.testing.assert_array_equal(normalised_adjacency(matrix, "identity").numpy(), np.eye(4))


@pytest.mark.parametrize("bad", [np.ones((3, 4)), np.zeros((3, 3)), 2 * np.eye(3), np.array([[1, 1], [0, 1]])])
def test_a_matrix_that_is_no_adjacency_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(GknetError, match="adjacency"):
        normalised_adjacency(bad)


def test_the_graph_is_a_constant_of_the_spacecraft() -> None:
    network = tiny(6)
    assert not [name for name in network.state_dict() if "adjacency" in name]
    assert not [name for name, _ in network.named_parameters() if "adjacency" in name]
    before = layers_of(network)[0].graph.adjacency.clone()
    network(torch.rand(2, 3, 64, 64)).sum().backward()
    assert torch.equal(before, layers_of(network)[0].graph.adjacency)


@pytest.mark.parametrize("kind", [GraphConvolution, EdgeConvolution])
def test_nodes_mix_along_edges_only(kind: type[torch.nn.Module]) -> None:
    torch.manual_seed(1)
    layer = kind(normalised_adjacency(chain(5)), 8, 8)
    nodes = torch.randn(1, 5, 8)
    moved = nodes.clone()
    moved[0, 0] += 1
    changed = (layer(nodes) - layer(moved)).abs().amax(dim=2)[0] > 1e-7
    assert changed.tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("kind", [GraphConvolution, EdgeConvolution])
def test_renumbering_the_keypoints_renumbers_nodes_and_nothing_else(kind: type[torch.nn.Module]) -> None:
    order = torch.tensor([3, 0, 4, 1, 2])
    torch.manual_seed(2)
    layer = kind(normalised_adjacency(chain(5)), 8, 8)
    matrix = chain(5)[np.ix_(order.numpy(), order.numpy())]
    other = kind(normalised_adjacency(matrix), 8, 8)
    other.load_state_dict(layer.state_dict())
    nodes = torch.randn(2, 5, 8)
    torch.testing.assert_close(layer(nodes)[:, order], other(nodes[:, order]))


def test_renumbering_the_keypoints_of_a_network_renumbers_its_channels() -> None:
    """Channel k, node k and row k of the adjacency are one keypoint."""
    order = np.array([3, 0, 4, 1, 2])
    network = tiny(5).eval()
    other = GKNet(network.config, chain(5)[np.ix_(order, order)], points(5)[order]).eval()
    weights = network.state_dict()
    torch.nn.init.normal_(weights["fusion.join.weight"])
    for name in ("pixel_head.weight", "pixel_head.bias", "decoder.queries", "fusion.join.bias"):
        weights[name] = weights[name][order]
    weights["fusion.join.weight"] = weights["fusion.join.weight"][order][:, [*order, *(order + 5)]]
    other.load_state_dict(weights)
    image = torch.rand(2, 3, 64, 64)
    torch.testing.assert_close(other(image), network(image)[:, order], atol=1e-4, rtol=1e-4)


def test_a_message_depends_on_both_of_its_ends() -> None:
    """The message from node 0 to node 1 depends on node 1: under eq. 2 all neighbours would receive the same."""
    torch.manual_seed(4)
    layer = EdgeConvolution(normalised_adjacency(chain(3)), 8, 8)
    nodes = torch.randn(1, 3, 8)
    other = nodes.clone()
    other[0, 0] = torch.randn(8)
    received = (layer(nodes) - layer(other))[0]  # by a change of node 0
    nodes[0, 1] += 1
    other[0, 1] += 1
    received_anew = (layer(nodes) - layer(other))[0]
    assert (received[1] - received_anew[1]).abs().max() > 1e-3
    assert not received[2].any()


def test_a_vote_goes_along_its_edge_and_no_other() -> None:
    torch.manual_seed(5)
    layer = EdgeConvolution(normalised_adjacency(chain(4)), 8, 8, votes=True)
    nodes, votes = torch.randn(1, 4, 8), torch.randn(1, 4, 4, POSITION_WIDTH)
    before = layer(nodes, votes)
    for to, sender, reached in ((1, 0, True), (2, 3, True), (0, 3, False), (3, 1, False)):
        other = votes.clone()
        other[0, to, sender] += 1
        changed = (layer(nodes, other) - before).abs().amax(dim=(0, 2)) > 1e-6
        assert changed.tolist() == [reached and k == to for k in range(4)]


def test_position_votes_enter_the_second_pass_alone_and_start_from_prompted_positions() -> None:
    """A prompted keypoint places its neighbour at the attitude's offset from there."""
    network = tiny(5).eval()
    votes: list[torch.Tensor | None] = []
    for layer in layers_of(network):
        layer.graph.register_forward_hook(lambda module, given, out: votes.append(given[1]))
    network.attitude.classes.weight.data.zero_()
    network.attitude.classes.bias.data = torch.full_like(network.attitude.classes.bias, -400)
    network.attitude.classes.bias.data[7] = 0
    truth = torch.zeros(1, 5, 16, 16)
    truth[0, 1, 3, 9] = 1
    network.branches(
        torch.rand(1, 3, 64, 64), KeypointPrompts(truth, torch.tensor([[False, True, False, False, False]]))
    )
    assert votes[:2] == [None, None]
    assert votes[2] is votes[3]
    expected = network.prior.expected_keypoints[7]
    position = torch.tensor([9.5, 3.5]) / 16 + expected[2] - expected[1]
    assert votes[2] is not None
    torch.testing.assert_close(votes[2][0, 2, 1], fourier_encoding(position), atol=1e-4, rtol=1e-4)


def sampled(pixels: torch.Tensor, prompts: KeypointPrompts | None = None) -> list[torch.Tensor]:
    """Encodings of the positions (n, 16) that nodes sample, layer by layer, where the other branch has given maps."""
    network = tiny(pixels.shape[1], bins=0).eval()
    assert network.decoder is not None
    network.pixel_head.register_forward_hook(lambda module, given, out: pixels)
    with torch.no_grad():
        network.node_filter.weight.zero_()
        network.node_filter.bias.zero_()
    samples: list[torch.Tensor] = []
    for layer in layers_of(network):
        layer.sample.register_forward_hook(lambda module, given, out: samples.append(given[0][0, :, 8:]))
    network.branches(torch.rand(1, 3, 64, 64), prompts)
    assert len(samples) == 4  # two layers, two passes
    return samples


def encoding(rows: Sequence[int], columns: Sequence[int]) -> torch.Tensor:
    return position_encoding(16, 16, torch.zeros(1))[:, rows, columns].T


def test_a_node_samples_at_the_soft_argmax_of_its_keypoint() -> None:
    """Certain maps of the other branch: each node samples the one cell, nothing else."""
    pixels = torch.zeros(1, 5, 16, 16)
    for k in range(5):
        pixels[0, k, 2 * k, 4] = 10
    for sample in sampled(pixels):
        torch.testing.assert_close(sample, encoding([0, 2, 4, 6, 8], [4] * 5), atol=1e-5, rtol=1e-4)


def test_in_the_second_pass_the_likelier_position_dominates() -> None:
    """Of two positions at .6 and .4 it samples their mean first, then .84 of the likelier: .6^4 / (.6^4 + .4^4)."""
    pixels = torch.full((1, 2, 16, 16), -10.0)
    pixels[0, :, 3, 2] = np.log(0.6) / SHARPNESS
    pixels[0, :, 12, 9] = np.log(0.4) / SHARPNESS
    likelier, other = encoding([3], [2]), encoding([12], [9])
    share = 0.6**4 / (0.6**4 + 0.4**4)
    first, second = sampled(pixels)[1:3]
    torch.testing.assert_close(first, (0.6 * likelier + 0.4 * other).expand(2, -1), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(second, (share * likelier + (1 - share) * other).expand(2, -1), atol=1e-5, rtol=1e-4)


def test_a_prompted_node_samples_at_the_truth_in_the_second_pass_alone() -> None:
    pixels, truth = torch.zeros(1, 3, 16, 16), torch.zeros(1, 3, 16, 16)
    pixels[0, :, 5, 5] = 10
    truth[0, :, 11, 7] = 0.25  # maps of any sum
    samples = sampled(pixels, KeypointPrompts(truth, torch.tensor([[True, False, True]])))
    for sample in samples[:2]:
        torch.testing.assert_close(sample, encoding([5, 5, 5], [5, 5, 5]), atol=1e-5, rtol=1e-4)
    for sample in samples[2:]:
        torch.testing.assert_close(sample, encoding([11, 5, 11], [7, 5, 7]), atol=1e-5, rtol=1e-4)


def test_a_prompt_reaches_the_neighbours_in_the_second_pass() -> None:
    for graph, reached in (("identity", False), ("skeleton", True)):
        network = tiny(5, graph).eval()
        torch.nn.init.normal_(network.node_filter.weight)
        image, truth = torch.rand(1, 3, 64, 64), torch.zeros(1, 5, 16, 16)
        truth[0, 0, 2, 3] = 1
        prompted = torch.zeros(1, 5, dtype=torch.bool)
        before = network.branches(image, KeypointPrompts(truth, prompted))
        prompted[0, 0] = True
        after = network.branches(image, KeypointPrompts(truth, prompted))
        assert before.nodes is not None
        assert after.nodes is not None
        changed = (before.nodes - after.nodes).abs().amax(dim=(0, 2, 3)) > 1e-5
        assert changed.tolist() == [True, reached, reached, False, False]  # two layers, two edges far
        torch.testing.assert_close(before.first_pass, after.first_pass)


def test_a_network_with_one_pass_takes_no_prompts() -> None:
    assert tiny(4).two_pass
    network = tiny(4, "none")
    assert not network.two_pass
    assert network.branches(torch.rand(1, 3, 64, 64)).first_pass is None


def test_without_edges_no_node_reaches_another() -> None:
    """Otherwise the ablation of the edges would not be one of the graph. Only the attitude depends on all keypoints."""
    for graph, reached in (("identity", False), ("skeleton", True)):
        network = tiny(5, graph, bins=0).eval()
        torch.nn.init.normal_(network.fusion.join.weight)
        torch.nn.init.normal_(network.node_filter.weight)
        assert network.decoder is not None
        image = torch.rand(1, 3, 64, 64)
        before = network.branches(image).nodes
        with torch.no_grad():
            network.decoder.queries[2] += 1
        after = network.branches(image).nodes
        assert before is not None
        assert after is not None
        changed = (before - after).abs().amax(dim=(0, 2, 3)) > 1e-5
        assert changed[2]
        assert changed[[1, 3]].all() == reached
        assert changed[[0, 1, 3, 4]].any() == reached


def test_every_image_of_a_batch_is_mixed_by_the_same_matrix() -> None:
    torch.manual_seed(3)
    adjacency = normalised_adjacency(chain(5))
    layer = GraphConvolution(adjacency, 8, 8)
    for nodes in (torch.randn(3, 5, 8), torch.randn(3, 5, 8) - 2, torch.zeros(1, 5, 8)):
        mixed = torch.einsum("nm,bmc->bnc", adjacency, layer.mix(nodes))
        torch.testing.assert_close(layer(nodes), layer.linear(mixed.relu()))  # eq. 2


def test_at_the_start_both_branches_reach_the_output_channel_by_channel() -> None:
    fusion = Fusion(3)
    pixels, nodes = torch.randn(1, 3, 4, 4), torch.randn(1, 3, 4, 4)
    torch.testing.assert_close(fusion(pixels, nodes), pixels + nodes)


@pytest.mark.parametrize("name", ["gknet-s", "gknet-xs"])
def test_at_the_start_the_graph_does_not_drown_the_other_branch(name: str) -> None:
    branches = cast(GKNet, build(name, chain(16), points(16))).branches(torch.rand(2, 3, 128, 128))
    assert branches.nodes is not None
    assert branches.fused.abs().max() < 1
    assert branches.nodes.abs().mean() < 0.1


def test_gradients_reach_every_parameter() -> None:
    network = tiny(5)
    (network.branches(torch.rand(2, 3, 64, 64)).fused - 1).square().sum().backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
