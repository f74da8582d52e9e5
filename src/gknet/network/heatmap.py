"""What every keypoint network returns: maps that a loss is computed on, and the heatmaps that are decoded from them."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

from gknet.errors import GknetError
from gknet.network.network import Network
from gknet.network.spec import checked_loss

SIGMA_CELLS = 1.5
"""Standard deviation of the target Gaussians, in heatmap cells."""

SHARPNESS = 10.0
"""From maps, which rise by about 1 at a keypoint, to logits: e^10 outweighs the cells of a 64x64 map."""

STRIDES = (4, 8)
"""Input pixels per cell: 64x64 or, as in the paper, 32x32 heatmaps of a 256x256 input."""


def log_probability(maps: Float[Tensor, "b n h w"]) -> Float[Tensor, "b n hw"]:
    """Logarithm of the probability that a keypoint lies in a cell, in float32.

    Args:
        maps: (b, n, h, w), one map per keypoint.

    Returns:
        (b, n, h w); its exponential sums to 1 over the cells.
    """
    return (SHARPNESS * maps.float()).flatten(2).log_softmax(dim=2)


def expected_heatmaps(maps: Float[Tensor, "b n h w"]) -> Float[Tensor, "b n h w"]:
    """The probability of each cell times 2 pi sigma^2.

    This is the target Gaussian of peak 1, averaged over the possible positions of the keypoint. A training with the
    squared error tends to the same average, so the heatmaps of both losses are decoded alike.

    Args:
        maps: (b, n, h, w), one map per keypoint.
    """
    return (2 * math.pi * SIGMA_CELLS**2 * log_probability(maps).exp()).reshape(maps.shape)


class HeatmapBranches(NamedTuple):
    """The maps of a keypoint network, as the loss sees them: (b, n, h, w) each.

    Attributes:
        fused: Both branches, joined: the network's result.
        pixels: Of the up-sampling branch.
        nodes: Of the graph branch; None without one.
        first_pass: Of the first decoder pass of a two-pass network; else None.
        attitude: (b, k) logits of the attitude classes of a network with an attitude prior; else None.
    """

    fused: Tensor
    pixels: Tensor
    nodes: Tensor | None
    first_pass: Tensor | None = None
    attitude: Tensor | None = None


class KeypointPrompts(NamedTuple):
    """Teacher-forced keypoints: a two-pass network receives their true positions before its second pass.

    Attributes:
        maps: (b, n, h, w) target Gaussians of all keypoints.
        prompted: (b, n), True where the network receives the position.
    """

    maps: Float[Tensor, "b n h w"]
    prompted: Bool[Tensor, "b n"]


class HeatmapNetwork(Network):
    """Image -> one heatmap per keypoint, with a peak near 1; channel k is keypoint k.

    Attributes:
        loss: "likelihood": the maps are logits of the keypoint's position (decision 0007); "squared": they are
            heatmaps.
        stride: Input pixels per cell.
        two_pass: Whether `branches` takes `KeypointPrompts`, as GKNet's does.
    """

    stride: int
    two_pass = False

    def __init__(self, loss: str, stride: int) -> None:
        super().__init__()
        if stride not in STRIDES:
            raise GknetError(f"network: expected a stride of {STRIDES[0]} or {STRIDES[1]}, got {stride}")
        self.loss, self.stride = checked_loss(loss), stride

    @abstractmethod
    def branches(self, image: Float[Tensor, "b 3 h w"]) -> HeatmapBranches:
        """The maps of all branches.

        Args:
            image: (b, 3, h, w), RGB in 0 to 1.
        """

    def predict(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        """The heatmaps and, with an attitude prior, the probabilities of the attitude classes.

        Args:
            image: (b, 3, h, w), RGB in 0 to 1.

        Returns:
            (b, n, h / stride, w / stride) heatmaps, and (b, k) probabilities that sum to 1.
        """
        branches = self.branches(image)
        heatmaps = expected_heatmaps(branches.fused) if self.loss == "likelihood" else branches.fused
        return (heatmaps,) if branches.attitude is None else (heatmaps, branches.attitude.softmax(dim=1))
