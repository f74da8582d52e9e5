"""What every network has in common."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn


class Network(nn.Module, ABC):
    """An RGB image in, the outputs of the exported file out.

    Attributes:
        stride: Input pixels per cell of the output's maps; None where the output is no map.
        attitude_bins: Cells per turn of the attitude (`gknet.inference.attitude.AttitudeBins`) where the network
            estimates one; else None.
    """

    stride: int | None = None
    attitude_bins: int | None = None

    @abstractmethod
    def predict(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        """All outputs.

        Args:
            image: (b, 3, h, w), RGB in 0 to 1; h and w are multiples of 32.
        """

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Tensor:
        """The first output of `predict`."""
        return self.predict(image)[0]
