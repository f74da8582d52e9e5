"""The belief in the attitude of the whole spacecraft, and what it says of each keypoint's place."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.network.backbone import ConvNorm

OPEN_MIND = 0.02
"""Added to a prior whose mean over the cells is 1: what the attitude excludes is unlikely, not impossible."""


SIDE = 2
"""Power to which the belief is raised before ways are told: a mean of two attitudes is none."""


class AttitudeHead(nn.Module):
    """Coarse cells, which must know where they are, -> logits of the attitude's classes: each cell's say, averaged."""

    def __init__(self, inputs: int, width: int, classes: int) -> None:
        super().__init__()
        self.cells = ConvNorm(inputs, width, 1)
        self.classes = nn.Linear(width, classes)

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k"]:
        return self.classes(self.cells(features).mean(dim=(2, 3))).float()


class AttitudePrior(nn.Module):
    """Between the belief in the attitude and those in the keypoints' places: what each says of the other.

    A keypoint by itself may be in two minds about twin places; an attitude puts all keypoints on one side.

    places      given as (k, n, cells, cells), `AttitudeBins.keypoint_prior`; kept as (n, cells cells, k)
    keypoints   (k, n, 2) the same without the blur, `AttitudeBins.expected_keypoints`
    gain        of what the attitude says, learnt; trust in what keypoints say, likewise: they err alike, so below 1
    """

    places: Tensor
    keypoints: Tensor

    def __init__(self, places: Float[Tensor, "k n cells cells"], keypoints: Float[Tensor, "k n 2"]) -> None:
        super().__init__()
        self.cells = places.shape[-1]
        # Keypoint by keypoint, the classes last: read as it lies by both products. The spacecraft's, not the weights'.
        self.register_buffer("places", places.flatten(2).permute(1, 2, 0).contiguous(), persistent=False)
        self.register_buffer("keypoints", keypoints, persistent=False)
        self.gain = nn.Parameter(torch.ones(1))
        self.trust = nn.Parameter(torch.full((1,), 0.3))

    def forward(self, attitude: Float[Tensor, "b k"], height: int, width: int) -> Float[Tensor, "b n height width"]:
        """Logits of the attitude's classes -> the logarithm of where they expect each keypoint, about 0 in the mean."""
        expected = self.places.flatten(0, 1) @ attitude.float().softmax(dim=1).T  # (n cells cells, b)
        expected = expected.T.reshape(-1, len(self.places), self.cells, self.cells)
        log_prior = (self.cells**2 * expected + OPEN_MIND).log()
        return self.gain * functional.interpolate(log_prior, size=(height, width), mode="bilinear")

    def votes(self, attitude: Float[Tensor, "b k"], found: Float[Tensor, "b n 2"]) -> Float[Tensor, "b to from 2"]:
        """Where each keypoint must be by each other one: its place, and from there the way that the attitude tells.

        attitude   logits of its classes
        found      x and y of each keypoint's place, in fractions of the picture, as the votes are

        Ways are far surer than places: what is wrong with the crop, and much of what is with the attitude, is common to
        both ends of an edge.
        """
        side_taken = (SIDE * attitude.detach().float()).softmax(dim=1)
        expected = (side_taken @ self.keypoints.flatten(1)).reshape(found.shape)
        return expected[:, :, None] + (found - expected)[:, None]

    def evidence(self, belief: Float[Tensor, "b n h w"]) -> Float[Tensor, "b k"]:
        """Where each keypoint is believed to be, shares of 1 -> what all of them together say of each class, in logits.

        h and w are multiples of the cells. A class that suits all keypoints is far ahead of those that suit some.
        """
        height, width = belief.shape[2:]
        shares = functional.avg_pool2d(belief, (height // self.cells, width // self.cells)) * (height * width)
        agreement = shares.flatten(2).transpose(0, 1) @ self.places  # (n, b, k)
        return self.trust * (agreement + OPEN_MIND).log().sum(dim=0)
