"""Laws of the prior: it follows the attitude, excludes nothing outright, and reaches the heatmaps."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from gknet.inference.attitude import AttitudeBins
from gknet.network.attitude_prior import PRIOR_FLOOR, PRIOR_SIGMA, AttitudePrior
from tests.network.tiny import points, tiny

BINS = AttitudeBins(6)
EXPECTED = torch.from_numpy(BINS.expected_keypoints(points(5))).float()


def gaussians() -> torch.Tensor:
    """(k, n, 8, 8), each map summing to 1: how likely a keypoint lies in a cell under a class."""
    y, x = np.mgrid[0:8, 0:8] / 8 + 1 / 16
    away = np.stack([x, y], axis=-1) - EXPECTED.numpy().astype(np.float64)[:, :, None, None]
    density = np.exp(-(away**2).sum(axis=-1) / (2 * PRIOR_SIGMA**2))
    return torch.from_numpy(density / density.sum(axis=(2, 3), keepdims=True)).float()


PRIOR = gaussians()


def certain(*classes: int) -> torch.Tensor:
    """Logits of one probability, spread evenly over `classes`."""
    logits = torch.full((1, BINS.count), -40.0)
    logits[0, list(classes)] = 0
    return logits


def test_a_prior_is_where_the_attitude_places_each_keypoint() -> None:
    prior = AttitudePrior(EXPECTED, 8)
    for chosen in (0, 17, 80):
        found = prior(certain(chosen), 8, 8)[0]
        torch.testing.assert_close(found, (64 * PRIOR[chosen] + PRIOR_FLOOR).log())
    both = prior(certain(3, 50), 8, 8)[0]  # ambiguous: the mean of two densities, not of their logarithms
    torch.testing.assert_close(both, (32 * (PRIOR[3] + PRIOR[50]) + PRIOR_FLOOR).log())


def test_a_prior_excludes_nothing_outright_and_has_any_size() -> None:
    found = AttitudePrior(EXPECTED, 8)(certain(9).expand(2, -1), 16, 24)
    assert found.shape == (2, 5, 16, 24)
    assert found.min() >= np.log(PRIOR_FLOOR) - 1e-6
    assert found.max() > 1


def test_the_prior_is_a_gaussian_about_the_expected_position() -> None:
    found = AttitudePrior(EXPECTED, 8).keypoint_prior()
    torch.testing.assert_close(found, PRIOR.flatten(2).permute(1, 2, 0))
    torch.testing.assert_close(found.sum(dim=1), torch.ones(5, BINS.count))


def test_keypoint_priors_belong_to_the_spacecraft_and_not_to_the_weights() -> None:
    assert set(AttitudePrior(EXPECTED, 8).state_dict()) == {"gain", "trust"}


def test_ambiguous_keypoints_agree_on_the_attitude_that_explains_them_all() -> None:
    """Each keypoint alone finds the symmetric counterpart likelier, or knows nothing, but for two that exclude it."""
    prior = AttitudePrior(EXPECTED, 8)
    true, counterpart = 30, 47
    probability = (0.4 * PRIOR[true] + 0.6 * PRIOR[counterpart])[None]
    probability[0, 4] = 1 / 64
    assert prior.evidence(probability)[0].argmax() == counterpart
    probability[0, :2] = PRIOR[true, :2]
    evidence = prior.evidence(probability)[0]
    assert evidence.argmax() == true
    expected = prior.trust * (64 * (probability[0] * PRIOR[true]).sum(dim=(1, 2)) + PRIOR_FLOOR).log().sum()
    assert evidence[true].item() == pytest.approx(expected.item(), rel=1e-5)


def test_evidence_is_the_same_at_any_resolution() -> None:
    prior = AttitudePrior(EXPECTED, 8)
    fine = PRIOR[:1].repeat_interleave(3, dim=2).repeat_interleave(3, dim=3) / 9
    torch.testing.assert_close(prior.evidence(fine), prior.evidence(PRIOR[:1]))


def test_votes_place_each_keypoint_by_the_others() -> None:
    """In a shifted crop all votes agree. The votes of a wrong keypoint are as wrong; the others correct it."""
    prior = AttitudePrior(EXPECTED, 8)
    for chosen in (5, 66):
        found = EXPECTED[chosen] + torch.tensor([0.08, -0.05])
        votes = prior.position_votes(certain(chosen), found[None])[0]
        torch.testing.assert_close(votes, found[:, None].expand(-1, 5, -1))
        wrong = found.clone()
        wrong[2] += torch.tensor([0.3, 0.1])
        votes = prior.position_votes(certain(chosen), wrong[None])[0]
        torch.testing.assert_close(votes[2, [0, 1, 3, 4]], found[2].expand(4, -1))
        torch.testing.assert_close(votes[:, 2] - found, torch.tensor([0.3, 0.1]).expand(5, -1))
    sharpened = prior.position_votes(certain(5, 66) + torch.eye(BINS.count)[5], EXPECTED[None, 5])[
        0
    ]  # .73 and .27, squared
    share = 1 / (1 + np.exp(-2))
    expected = share * EXPECTED[5] + (1 - share) * EXPECTED[66]
    torch.testing.assert_close(sharpened[3, 1], expected[3] + EXPECTED[5, 1] - expected[1])


@pytest.mark.parametrize("graph", ["skeleton", "none"])
def test_the_attitude_moves_the_maps_and_is_moved_by_them(graph: str) -> None:
    """Without information in the features, keypoints lie where the attitude places them; certain ones overrule it."""
    network = tiny(5, graph, bins=6).eval()
    network.attitude.classes.weight.data.zero_()
    if graph != "none":
        torch.nn.init.zeros_(network.node_filter.weight)
        torch.nn.init.zeros_(network.node_filter.bias)
    pixel_maps = torch.zeros(1, 5, 32, 32)
    network.pixel_head.register_forward_hook(lambda module, given, out: pixel_maps)
    image = torch.rand(1, 3, 128, 128)
    for chosen in (4, 60):
        pixel_maps = torch.zeros(1, 5, 32, 32)
        network.attitude.classes.bias.data = certain(chosen)[0]
        branches = network.branches(image)
        assert branches.attitude is not None
        assert branches.attitude[0].argmax() == chosen
        highest = branches.pixels.flatten(2).argmax(dim=2)[0]
        cells = torch.stack([highest // 32, highest % 32]) // 4
        expected = PRIOR[chosen].flatten(1).argmax(dim=1)
        assert (cells - torch.stack([expected // 8, expected % 8])).abs().max() <= 1
        other = 80
        network.attitude.classes.bias.data = certain(chosen, other)[0] + torch.eye(BINS.count)[chosen]
        pixel_maps = PRIOR[other][None].clamp(min=1e-6).log() / 10
        pixel_maps = torch.nn.functional.interpolate(pixel_maps, size=(32, 32))
        attitude = network.branches(image).attitude
        assert attitude is not None
        assert attitude[0].argmax() == other


def test_a_network_without_bins_expects_nothing() -> None:
    network = tiny(5, bins=0)
    assert network.branches(torch.rand(1, 3, 64, 64)).attitude is None
    assert not [name for name in network.state_dict() if "attitude" in name or "prior" in name]
