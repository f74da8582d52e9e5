"""The probability of the attitude, and what it and the keypoints imply about each other (decision 0016)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.network.backbone import ConvNorm

PRIOR_SIGMA = 0.07
"""Standard deviation, in sides of the crop, of a keypoint about its expected position: crops are cut loosely."""

PRIOR_FLOOR = 0.02
"""Added to a prior whose mean over the cells is 1: what the attitude excludes is unlikely, not impossible."""

ATTITUDE_INVERSE_TEMPERATURE = 2
"""Of the softmax over the classes that position votes use: the mean of two attitudes is no attitude."""


class AttitudeHead(nn.Module):
    """The coarsest feature map -> logits of the attitude classes, from the mean over its cells.

    The features must contain the position of their cell, which the mean would lose otherwise.
    """

    def __init__(self, inputs: int, width: int, classes: int) -> None:
        super().__init__()
        self.cells = ConvNorm(inputs, width, 1)
        self.classes = nn.Linear(width, classes)

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k"]:
        return self.classes(self.cells(features).mean(dim=(2, 3))).float()


class AttitudePrior(nn.Module):
    """From the attitude to the positions of keypoints and back.

    A single keypoint may be equally likely at two symmetric positions; an attitude places all keypoints consistently.

    Attributes:
        expected_keypoints: (k, n, 2), x and y of each keypoint under each class, in fractions of the crop. They belong
            to the spacecraft, not to the weights: they are computed, never loaded.
        cells: Side of the maps in which a class places keypoints.
        gain: Learnt weight of the log prior.
        trust: Learnt weight of the evidence of the keypoints. It starts below 1, since their errors are correlated.
    """

    expected_keypoints: Tensor

    def __init__(self, expected_keypoints: Float[Tensor, "k n 2"], cells: int) -> None:
        super().__init__()
        self.cells = cells
        self.register_buffer("expected_keypoints", expected_keypoints, persistent=False)
        self.gain = nn.Parameter(torch.ones(1))
        self.trust = nn.Parameter(torch.full((1,), 0.3))

    def keypoint_prior(self) -> Float[Tensor, "n cells2 k"]:
        """The distribution of each keypoint's position under each class: a Gaussian of PRIOR_SIGMA.

        It is a product of a factor along x and one along y, and cheaper to compute than to store: onnxruntime does it
        once, when it loads the file.

        Returns:
            (n, cells * cells, k), row by row, summing to 1 over the cells; the classes last, as both products read it.
        """
        expected = self.expected_keypoints.permute(2, 1, 0).contiguous()[:, :, None]  # (xy, n, 1, k)
        centres = (torch.arange(self.cells, device=expected.device, dtype=expected.dtype) + 0.5) / self.cells
        along = torch.exp(-((expected - centres[:, None]) ** 2) / (2 * PRIOR_SIGMA**2))  # (xy, n, cells, k)
        along = along / along.sum(dim=2, keepdim=True)
        return (along[1][:, :, None] * along[0][:, None]).flatten(1, 2)

    def forward(self, attitude: Float[Tensor, "b k"], height: int, width: int) -> Float[Tensor, "b n height width"]:
        """The log prior of each keypoint's position.

        Args:
            attitude: (b, k) logits of the classes.
            height: Of the result, in cells.
            width: Of the result, in cells.

        Returns:
            (b, n, height, width) logarithms of a density whose mean over the cells is about 1.
        """
        prior = self.keypoint_prior()
        expected = prior.flatten(0, 1) @ attitude.float().softmax(dim=1).T  # (n cells cells, b)
        expected = expected.T.reshape(-1, len(prior), self.cells, self.cells)
        log_prior = (self.cells**2 * expected + PRIOR_FLOOR).log()
        return self.gain * functional.interpolate(log_prior, size=(height, width), mode="bilinear")

    def position_votes(
        self, attitude: Float[Tensor, "b k"], positions: Float[Tensor, "b n 2"]
    ) -> Float[Tensor, "b to from 2"]:
        """The position of each keypoint according to each other one: that one's position plus the offset between them.

        The offset is the difference of the two expected positions under the attitude. It is far more accurate than
        the expected positions: errors of the crop, and many of those of the attitude, shift both ends of an edge alike.

        Args:
            attitude: (b, k) logits of the classes; no gradient flows back to them.
            positions: (b, n, 2) x and y at which the keypoints were found, in fractions of the crop.

        Returns:
            (b, n, n, 2) in fractions of the crop: [:, i, j] is the vote of keypoint j for keypoint i.
        """
        sharpened = (ATTITUDE_INVERSE_TEMPERATURE * attitude.detach().float()).softmax(dim=1)
        expected = (sharpened @ self.expected_keypoints.flatten(1)).reshape(positions.shape)
        return expected[:, :, None] + (positions - expected)[:, None]

    def evidence(self, probability: Float[Tensor, "b n h w"]) -> Float[Tensor, "b k"]:
        """How well each class explains the positions of all keypoints together.

        Args:
            probability: (b, n, h, w), summing to 1 over the cells of a map; h and w are multiples of `cells`.

        Returns:
            (b, k) terms to be added to the logits: the sum over the keypoints of the logarithm of the mean prior
            density under the class, times `trust`. A class that places all keypoints well is far ahead of one that
            places some.
        """
        height, width = probability.shape[2:]
        shares = functional.avg_pool2d(probability, (height // self.cells, width // self.cells)) * (height * width)
        agreement = shares.flatten(2).transpose(0, 1) @ self.keypoint_prior()  # (n, b, k)
        return self.trust * (agreement + PRIOR_FLOOR).log().sum(dim=0)
