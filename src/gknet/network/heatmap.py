"""What every keypoint network answers with: maps that a loss sees, and the heatmaps that are decoded from them."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple

from jaxtyping import Float
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
    """Logarithm of the probability that a keypoint lies in a cell."""
    return (SHARPNESS * maps.float()).flatten(2).log_softmax(dim=2)


def expected_heatmaps(maps: Float[Tensor, "b n h w"]) -> Float[Tensor, "b n h w"]:
    """The belief times 2 pi sigma^2: the target Gaussian of peak 1, averaged over where the keypoint may be.

    That average is what a training by squared error tends to as well, so both are decoded alike.
    """
    return (2 * math.pi * SIGMA_CELLS**2 * log_probability(maps).exp()).reshape(maps.shape)


class Branches(NamedTuple):
    """The fused maps and their two parts, as the loss sees them. `nodes` is None without a graph branch.

    first     the maps of the first look of a network that looks twice, else None
    attitude  (b, k) logits of the attitude's classes of a network that has a belief in it, else None
    """

    fused: Tensor
    pixels: Tensor
    nodes: Tensor | None
    first: Tensor | None = None
    attitude: Tensor | None = None


class KeypointPrompts(NamedTuple):
    """Some keypoints' true places, told to a network in training before its second look.

    maps (b, n, h, w) the target Gaussians; told (b, n) bool, whose place is told
    """

    maps: Tensor
    told: Tensor


class HeatmapNetwork(Network):
    """Image -> one heatmap per keypoint, peak near 1; channel k is keypoint k.

    loss    "likelihood": the maps are logits of where the keypoint is (decision 0007); "squared": they are heatmaps
    stride  input pixels per cell
    """

    stride: int
    two_pass = False
    """Whether `branches` takes prompts, as GKNet's does."""

    def __init__(self, loss: str, stride: int) -> None:
        super().__init__()
        if stride not in STRIDES:
            raise GknetError(f"network: expected a stride of {STRIDES[0]} or {STRIDES[1]}, got {stride}")
        self.loss, self.stride = checked_loss(loss), stride

    @abstractmethod
    def branches(self, image: Float[Tensor, "b 3 h w"]) -> Branches:
        """The maps and what each branch contributed, for a loss on all of them."""

    def predict(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        """Heatmaps (b, n, hs, ws) and, of a network that has one, its belief in the attitude's classes (b, k)."""
        branches = self.branches(image)
        heatmaps = expected_heatmaps(branches.fused) if self.loss == "likelihood" else branches.fused
        return (heatmaps,) if branches.attitude is None else (heatmaps, branches.attitude.softmax(dim=1))
