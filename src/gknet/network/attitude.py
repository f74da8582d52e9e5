"""The belief in the attitude of the whole spacecraft, and what it says of each keypoint's place."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.network.backbone import ConvNorm

OPEN_MIND = 0.02
"""Added to a prior whose mean over the cells is 1: what the attitude excludes is unlikely, not impossible."""


class AttitudeHead(nn.Module):
    """Coarse cells, which must know where they are, -> logits of the attitude's classes: each cell's say, averaged."""

    def __init__(self, inputs: int, width: int, classes: int) -> None:
        super().__init__()
        self.cells = ConvNorm(inputs, width, 1)
        self.classes = nn.Linear(width, classes)

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k"]:
        return self.classes(self.cells(features).mean(dim=(2, 3))).float()


class AttitudePrior(nn.Module):
    """Logits of the attitude's classes -> the logarithm of where they expect each keypoint, about 0 in the mean.

    A keypoint by itself may be in two minds about twin places; an attitude puts all keypoints on one side.

    places   (k, n, cells, cells), `gknet.attitude.AttitudeBins.places`
    """

    places: Tensor

    def __init__(self, places: Float[Tensor, "k n cells cells"]) -> None:
        super().__init__()
        self.register_buffer("places", places, persistent=False)  # the spacecraft's, not the weights'
        self.gain = nn.Parameter(torch.ones(1))

    def forward(self, attitude: Float[Tensor, "b k"], height: int, width: int) -> Float[Tensor, "b n height width"]:
        cells = self.places.shape[-1]
        expected = attitude.float().softmax(dim=1) @ self.places.flatten(1)
        expected = expected.reshape(-1, *self.places.shape[1:])
        log_prior = (cells**2 * expected + OPEN_MIND).log()
        return self.gain * functional.interpolate(log_prior, size=(height, width), mode="bilinear")
