"""Laws of the prior: it says what the attitude says, excludes nothing outright, and reaches the heatmaps."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from gknet.inference.attitude import AttitudeBins  # noqa: E402
from gknet.network.attitude_prior import OPEN_MIND, AttitudePrior  # noqa: E402
from tests.network.tiny import points, tiny  # noqa: E402

BINS = AttitudeBins(6)
PLACES = torch.from_numpy(BINS.keypoint_prior(points(5), 8)).float()
KEYPOINTS = torch.from_numpy(BINS.expected_keypoints(points(5))).float()


def sure_of(*classes: int) -> torch.Tensor:
    """Logits of one belief, spread evenly over `classes`."""
    logits = torch.full((1, BINS.count), -40.0)
    logits[0, list(classes)] = 0
    return logits


def test_a_prior_says_where_the_attitude_puts_each_keypoint() -> None:
    prior = AttitudePrior(PLACES, KEYPOINTS)
    for chosen in (0, 17, 80):
        found = prior(sure_of(chosen), 8, 8)[0]
        torch.testing.assert_close(found, (64 * PLACES[chosen] + OPEN_MIND).log())
    both = prior(sure_of(3, 50), 8, 8)[0]  # in two minds: the mean of two likelihoods, not of their logarithms
    torch.testing.assert_close(both, (32 * (PLACES[3] + PLACES[50]) + OPEN_MIND).log())


def test_a_prior_excludes_nothing_outright_and_has_any_size() -> None:
    found = AttitudePrior(PLACES, KEYPOINTS)(sure_of(9).expand(2, -1), 16, 24)
    assert found.shape == (2, 5, 16, 24)
    assert found.min() >= np.log(OPEN_MIND) - 1e-6
    assert found.max() > 1


def test_places_belong_to_the_spacecraft_and_not_to_the_weights() -> None:
    assert set(AttitudePrior(PLACES, KEYPOINTS).state_dict()) == {"gain", "trust"}


def test_keypoints_in_two_minds_agree_on_the_attitude_that_suits_them_all() -> None:
    """Each keypoint alone deems the twin likelier, or knows nothing, but for two that cannot be at the twin's."""
    prior = AttitudePrior(PLACES, KEYPOINTS)
    true, twin = 30, 47
    belief = (0.4 * PLACES[true] + 0.6 * PLACES[twin])[None]
    belief[0, 4] = 1 / 64
    assert prior.evidence(belief)[0].argmax() == twin
    belief[0, :2] = PLACES[true, :2]
    evidence = prior.evidence(belief)[0]
    assert evidence.argmax() == true
    expected = prior.trust * (64 * (belief[0] * PLACES[true]).sum(dim=(1, 2)) + OPEN_MIND).log().sum()
    assert evidence[true].item() == pytest.approx(expected.item(), rel=1e-5)


def test_evidence_is_the_same_at_any_resolution() -> None:
    prior = AttitudePrior(PLACES, KEYPOINTS)
    fine = PLACES[:1].repeat_interleave(3, dim=2).repeat_interleave(3, dim=3) / 9
    torch.testing.assert_close(prior.evidence(fine), prior.evidence(PLACES[:1]))


def test_votes_put_each_keypoint_where_the_others_say() -> None:
    """In a crop that is off all votes agree. A wrong keypoint's votes are as wrong; the others put it right."""
    prior = AttitudePrior(PLACES, KEYPOINTS)
    for chosen in (5, 66):
        found = KEYPOINTS[chosen] + torch.tensor([0.08, -0.05])
        votes = prior.votes(sure_of(chosen), found[None])[0]
        torch.testing.assert_close(votes, found[:, None].expand(-1, 5, -1))
        wrong = found.clone()
        wrong[2] += torch.tensor([0.3, 0.1])
        votes = prior.votes(sure_of(chosen), wrong[None])[0]
        torch.testing.assert_close(votes[2, [0, 1, 3, 4]], found[2].expand(4, -1))
        torch.testing.assert_close(votes[:, 2] - found, torch.tensor([0.3, 0.1]).expand(5, -1))
    sided = prior.votes(sure_of(5, 66) + torch.eye(BINS.count)[5], KEYPOINTS[None, 5])[0]  # .73 and .27, squared
    share = 1 / (1 + np.exp(-2))
    expected = share * KEYPOINTS[5] + (1 - share) * KEYPOINTS[66]
    torch.testing.assert_close(sided[3, 1], expected[3] + KEYPOINTS[5, 1] - expected[1])


@pytest.mark.parametrize("graph", ["skeleton", "none"])
def test_the_belief_in_the_attitude_moves_the_maps_and_is_moved_by_them(graph: str) -> None:
    """With features that say nothing, keypoints are where the attitude puts them; sure keypoints overrule it."""
    network = tiny(5, graph, bins=6).eval()
    network.attitude.classes.weight.data.zero_()
    if graph != "none":
        torch.nn.init.zeros_(network.node_filter.weight)
        torch.nn.init.zeros_(network.node_filter.bias)
    seen = torch.zeros(1, 5, 32, 32)
    network.pixel_head.register_forward_hook(lambda module, given, out: seen)
    image = torch.rand(1, 3, 128, 128)
    for chosen in (4, 60):
        seen = torch.zeros(1, 5, 32, 32)
        network.attitude.classes.bias.data = sure_of(chosen)[0]
        branches = network.branches(image)
        assert branches.attitude is not None
        assert branches.attitude[0].argmax() == chosen
        highest = branches.pixels.flatten(2).argmax(dim=2)[0]
        cells = torch.stack([highest // 32, highest % 32]) // 4
        expected = PLACES[chosen].flatten(1).argmax(dim=1)
        assert (cells - torch.stack([expected // 8, expected % 8])).abs().max() <= 1
        other = 80
        network.attitude.classes.bias.data = sure_of(chosen, other)[0] + torch.eye(BINS.count)[chosen]
        seen = PLACES[other][None].clamp(min=1e-6).log() / 10
        seen = torch.nn.functional.interpolate(seen, size=(32, 32))
        assert network.branches(image).attitude[0].argmax() == other


def test_a_network_without_bins_expects_nothing() -> None:
    network = tiny(5, bins=0)
    assert network.branches(torch.rand(1, 3, 64, 64)).attitude is None
    assert not [name for name in network.state_dict() if "attitude" in name or "prior" in name]
