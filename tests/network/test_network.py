"""Laws of the networks: shapes at every size and N, identity of channels and nodes, the constant graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.utils.flop_counter import FlopCounterMode  # noqa: E402

from gknet.direct import AttitudeBins  # noqa: E402
from gknet.errors import GknetError  # noqa: E402
from gknet.network.backbone import position_code  # noqa: E402
from gknet.network.build import (  # noqa: E402
    GRAPH_NETWORKS,
    build,
    configured,
    dmanet,
    dmanet_xs,
    gknet_paper,
    gknet_s,
    gknet_xs,
    hrnet,
    hrnet_xs,
    locator,
    resunet,
    resunet_xs,
)
from gknet.network.dmanet import DMANet, DMANetConfig, MultiScaleAttention  # noqa: E402
from gknet.network.gknet import GKNet, GKNetConfig  # noqa: E402
from gknet.network.graph import EdgeConvolution, Fusion, GraphConvolution, normalised_adjacency  # noqa: E402
from gknet.network.heatmap import SHARPNESS, SIGMA_CELLS, expected_heatmaps, log_belief  # noqa: E402
from gknet.network.hrnet import HRNet, HRNetConfig  # noqa: E402
from gknet.network.resunet import ResUNet, ResUNetConfig  # noqa: E402
from gknet.training.loss import gaussian_targets  # noqa: E402


def chain(count: int) -> np.ndarray:
    matrix = np.eye(count, dtype=bool)
    for i in range(count - 1):
        matrix[i, i + 1] = matrix[i + 1, i] = True
    return matrix


def tiny(count: int, graph: str = "skeleton") -> GKNet:
    torch.manual_seed(0)
    return GKNet(GKNetConfig(width=4, pyramid_width=8, node_width=8, node_layers=2, heads=2, graph=graph), chain(count))


def parameters(network: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


@pytest.mark.parametrize("count", [4, 13, 24])
@pytest.mark.parametrize("size", [128, 192, 256])
def test_any_number_of_keypoints_and_any_input_size(count: int, size: int) -> None:
    heatmaps = tiny(count)(torch.rand(2, 3, size, size))
    assert heatmaps.shape == (2, count, size // 4, size // 4)


@pytest.mark.parametrize("graph", ["skeleton", "identity", "none"])
def test_the_forward_pass_is_the_belief_of_the_fused_branches(graph: str) -> None:
    network = tiny(5, graph).eval()
    image = torch.rand(1, 3, 64, 64)
    branches = network.branches(image)
    torch.testing.assert_close(network(image), expected_heatmaps(branches.fused))
    assert (branches.nodes is None) == (graph == "none")


def test_a_belief_sums_to_one_and_certainty_is_the_target_gaussian() -> None:
    maps = torch.randn(2, 3, 16, 16)
    torch.testing.assert_close(log_belief(maps).exp().sum(dim=2), torch.ones(2, 3))
    target = gaussian_targets(torch.tensor([[[33.0, 30.5]]]), 4, 16, 16, SIGMA_CELLS)
    torch.testing.assert_close(expected_heatmaps(target.log() / SHARPNESS), target, atol=1e-4, rtol=0)
    twins = (target + target.flip(3)) / 2  # two places, equally likely: two peaks of half the height
    torch.testing.assert_close(expected_heatmaps(twins.log() / SHARPNESS), twins, atol=1e-4, rtol=0)


def test_without_edges_the_size_is_the_same() -> None:
    assert parameters(tiny(9, "identity")) == parameters(tiny(9, "skeleton")) == parameters(tiny(9, "random"))
    for network in (gknet_s, gknet_xs):
        whole, without = parameters(network(chain(16))), parameters(network(chain(16), "none"))
        assert abs(without / whole - 1) < 0.03


@pytest.mark.parametrize("name", GRAPH_NETWORKS)
def test_a_named_network_has_the_graph_that_was_asked_for(name: str) -> None:
    skeleton = chain(5)
    for graph in ("skeleton", "identity", "random"):
        network = build(name, skeleton, graph)
        found = [each for key, each in network.named_buffers() if key.endswith("adjacency")]
        assert found
        for each in found:
            torch.testing.assert_close(each, normalised_adjacency(skeleton, graph))  # type: ignore[arg-type]
    without = build(name, skeleton, "none")
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


def test_dmanet_tells_a_pose_at_any_input_size() -> None:
    network = small_dmanet()
    for size in (64, 128, 192):
        output = network(torch.rand(2, 3, size, size))
        assert output.shape == (2, 3 + AttitudeBins(4).count)
        assert (output[:, 3:] >= 0).all()
        torch.testing.assert_close(output[:, 3:].sum(dim=1), torch.ones(2))
    network.eval()
    images = torch.rand(3, 3, 64, 64)
    torch.testing.assert_close(network(images)[1:2], network(images[1:2]), atol=1e-5, rtol=1e-4)
    assert dmanet_xs()(torch.rand(2, 3, 64, 64)).shape == (2, 3 + AttitudeBins(dmanet_xs().config.bins).count)


def test_gradients_reach_every_parameter_of_dmanet() -> None:
    network = small_dmanet()
    offset, log_depth, attitude = network.branches(torch.rand(4, 3, 64, 64))
    (offset.square().sum() + log_depth.square().sum() + attitude.square().sum()).backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]


def test_a_block_is_dense_and_looks_at_three_scales() -> None:
    """What comes in goes out beside what is added; the convolutions of an MAB see 3, 5 and 7 cells across."""
    block = MultiScaleAttention(5, 4).eval()
    x = torch.randn(1, 5, 16, 16)
    out = block(x)
    assert out.shape == (1, 9, 16, 16)
    torch.testing.assert_close(out[:, :5], x)
    entered = torch.randn(1, 4, 16, 16)
    moved = entered.clone()
    moved[:, :, 8, 8] += 1
    changed = [(scale.conv(entered) != scale.conv(moved)).any(dim=1)[0] for scale in block.scales]
    assert [int(each.any(dim=0).sum()) for each in changed] == [3, 5, 7]


def test_votes_for_the_origin_are_counted_from_each_cell() -> None:
    """Sure cells decide; a vote of nothing is the cell's own centre, in sides of the crop from its middle."""
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
    ours = multiply_accumulates(gknet_xs(chain(16)))
    for other in (hrnet_xs(16), resunet_xs(16), dmanet_xs()):
        assert abs(multiply_accumulates(other) / ours - 1) < 0.05


def test_named_sizes() -> None:
    assert 2e6 < parameters(gknet_s(chain(16))) < 3.5e6
    assert 0.8e6 < parameters(gknet_xs(chain(16))) < 1e6
    assert 80e6 < parameters(gknet_paper(chain(16))) < 100e6
    assert 28e6 < parameters(hrnet(16)) < 30e6
    assert 23e6 < parameters(resunet(16)) < 26e6
    assert 25e6 < parameters(dmanet()) < 30e6
    assert 0.5e6 < parameters(locator()) < 0.8e6


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
    assert network.decoder is not None
    assert not [name for name in network.state_dict() if "adjacency" in name]
    assert not [name for name, _ in network.named_parameters() if "adjacency" in name]
    before = network.decoder.layers[0].graph.adjacency.clone()
    network(torch.rand(2, 3, 64, 64)).sum().backward()
    assert torch.equal(before, network.decoder.layers[0].graph.adjacency)


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
    """Channel k, node k and row k of the adjacency are one keypoint: whoever moves one of them moves them all."""
    order = np.array([3, 0, 4, 1, 2])
    network = tiny(5).eval()
    other = GKNet(network.config, chain(5)[np.ix_(order, order)]).eval()
    weights = network.state_dict()
    torch.nn.init.normal_(weights["fusion.join.weight"])
    for name in ("pixel_head.weight", "pixel_head.bias", "decoder.queries", "fusion.join.bias"):
        weights[name] = weights[name][order]
    weights["fusion.join.weight"] = weights["fusion.join.weight"][order][:, [*order, *(order + 5)]]
    other.load_state_dict(weights)
    image = torch.rand(2, 3, 64, 64)
    torch.testing.assert_close(other(image), network(image)[:, order], atol=1e-4, rtol=1e-4)


def test_a_message_knows_both_of_its_ends() -> None:
    """What node 1 tells node 2 depends on node 2: under eq. 2 it would tell all its neighbours the same."""
    torch.manual_seed(4)
    layer = EdgeConvolution(normalised_adjacency(chain(3)), 8, 8)
    nodes = torch.randn(1, 3, 8)
    silent = nodes.clone()
    silent[0, 0] = torch.randn(8)
    told = (layer(nodes) - layer(silent))[0]  # by a change of node 0
    nodes[0, 1] += 1
    silent[0, 1] += 1
    told_anew = (layer(nodes) - layer(silent))[0]
    assert (told[1] - told_anew[1]).abs().max() > 1e-3
    assert not told[2].any()


def test_a_glance_is_what_is_seen_where_a_node_believes_its_keypoint_to_be() -> None:
    """Certain maps of the other branch: each node sees the code of the one place, nothing else."""
    network = tiny(5).eval()
    assert network.decoder is not None
    with torch.no_grad():
        network.node_filter.weight.zero_()
        network.pixel_head.weight.zero_()
    glances: list[torch.Tensor] = []
    for layer in network.decoder.layers:
        layer.seen.register_forward_hook(lambda module, given, out: glances.append(given[0]))
    up, memory = torch.randn(1, 8, 16, 16), torch.randn(1, 6, 8)
    pixels = torch.zeros(1, 5, 16, 16)
    for k in range(5):
        pixels[0, k, 2 * k, 4] = 10
    network._graph_maps(memory, up, pixels)
    assert len(glances) == 2
    for seen in glances:
        torch.testing.assert_close(seen[0, :, 8:], position_code(16, 16, up)[:, :10:2, 4].T, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("glances", [True, False])
def test_without_edges_no_node_hears_of_another(glances: bool) -> None:
    """Otherwise the ablation of the edges would not be one of the graph."""
    for graph, heard in (("identity", False), ("skeleton", True)):
        network = GKNet(replace(tiny(5, graph).config, glances=glances), chain(5)).eval()
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
        assert changed[[1, 3]].all() == heard
        assert changed[[0, 1, 3, 4]].any() == heard


def test_without_glances_the_decoder_is_the_one_of_equation_2() -> None:
    network = GKNet(replace(tiny(4).config, glances=False), chain(4))
    assert network.decoder is not None
    assert all(isinstance(layer.graph, GraphConvolution) for layer in network.decoder.layers)
    assert not [name for name in network.state_dict() if "seen" in name]


def test_every_picture_of_a_batch_is_mixed_by_the_same_matrix() -> None:
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


@pytest.mark.parametrize("make", [gknet_s, gknet_xs])
def test_at_the_start_the_graph_does_not_drown_the_other_branch(make: Callable[[np.ndarray], GKNet]) -> None:
    branches = make(chain(16)).branches(torch.rand(2, 3, 128, 128))
    assert branches.nodes is not None
    assert branches.fused.abs().max() < 1
    assert branches.nodes.abs().mean() < 0.1


def test_gradients_reach_every_parameter() -> None:
    network = tiny(5)
    (network.branches(torch.rand(2, 3, 64, 64)).fused - 1).square().sum().backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]


def test_the_code_of_a_place_is_the_same_at_every_resolution() -> None:
    fine, coarse = position_code(30, 30, torch.zeros(1)), position_code(10, 10, torch.zeros(1))
    torch.testing.assert_close(fine[:, 1::3, 1::3], coarse, atol=1e-5, rtol=0)


def test_the_locator_speaks_of_probabilities_and_lengths() -> None:
    output = locator()(torch.rand(2, 3, 256, 256))
    assert output.shape == (2, 5, 64, 64)
    assert (output >= 0).all()
    assert (output[:, 0] <= 1).all()


def test_an_image_alone_does_not_depend_on_its_batch() -> None:
    network = tiny(5).eval()
    images = torch.rand(3, 3, 64, 64)
    torch.testing.assert_close(network(images)[1:2], network(images[1:2]), atol=1e-5, rtol=1e-4)


def test_bad_choices_are_named() -> None:
    with pytest.raises(GknetError, match="unknown key 'widht'"):
        configured(GKNetConfig, {"widht": 3})
    assert configured(GKNetConfig, {"width": 16}).width == 16
    for sizes in ({"width": 0}, {"modules": (1, 0, 3)}):
        with pytest.raises(GknetError, match="hrnet"):
            configured(HRNetConfig, sizes)
    with pytest.raises(GknetError, match="resunet"):
        ResUNetConfig(blocks=(0, 1, 1, 1))
    for sizes in ({"head": 0}, {"bins": 7}):
        with pytest.raises(GknetError, match="dmanet"):
            DMANetConfig(**{"width": (4,) * 4, "growth": (4,) * 4, "blocks": (1,) * 4, "head": 4} | sizes)
    with pytest.raises(GknetError, match="loss"):
        build("gknet-s", chain(5), loss="hinge")
    with pytest.raises(GknetError, match="graph"):
        GKNetConfig(graph="full")
    with pytest.raises(GknetError, match="network"):
        build("hourglass", chain(5))
    with pytest.raises(GknetError, match="multiples of 32"):
        tiny(5)(torch.rand(1, 3, 100, 100))
