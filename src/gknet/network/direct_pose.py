"""What every network with direct pose regression returns: a pose relative to the crop, without keypoints."""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from gknet.network.network import Network


class PoseBranches(NamedTuple):
    """The outputs of the three branches, as the loss sees them.

    Attributes:
        offset: (b, 2) x and y of the body's origin from the crop's centre, in sides of the crop.
        log_depth: (b,), see `gknet.inference.direct_estimator.CropPose`.
        attitude: (b, k) logits of the attitude classes.
    """

    offset: Float[Tensor, "b 2"]
    log_depth: Float[Tensor, " b"]
    attitude: Float[Tensor, "b k"]


class DirectNetwork(Network):
    """Image -> pose. `attitude_bins` states the classes of the attitude."""

    attitude_bins: int

    @abstractmethod
    def branches(self, image: Float[Tensor, "b 3 h w"]) -> PoseBranches:
        """The outputs of the three branches.

        Args:
            image: (b, 3, h, w), RGB in 0 to 1.
        """

    def predict(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b c"], ...]:
        """What `gknet.inference.direct_estimator.decode_output` reads.

        Args:
            image: (b, 3, h, w), RGB in 0 to 1.

        Returns:
            One tensor (b, 3 + k): offset x and y, log_depth, and the probabilities of the attitude classes.
        """
        offset, log_depth, attitude = self.branches(image)
        return (torch.cat([offset, log_depth[:, None], functional.softmax(attitude, dim=1)], dim=1),)
