"""The locator finds the spacecraft in the whole image: a centre map and four distances (CenterNet, FCOS)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.errors import GknetError
from gknet.network.backbone import Encoder, Pyramid, check_input
from gknet.network.network import Network


@dataclass(frozen=True)
class LocatorConfig:
    """Sizes of the network.

    Attributes:
        width: Channels of the encoder's first stage.
        pyramid_width: Channels of the up-sampling branch.
    """

    width: int = 16
    pyramid_width: int = 32

    def __post_init__(self) -> None:
        if self.width < 1 or self.pyramid_width < 1:
            raise GknetError(f"locator: expected positive widths, got {self.width} and {self.pyramid_width}")


class Locator(Network):
    """Image -> the box of the spacecraft, from every cell."""

    stride = 4

    def __init__(self, config: LocatorConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.width)
        self.pyramid = Pyramid(self.encoder.widths, config.pyramid_width)
        self.head = nn.Conv2d(config.pyramid_width, 5, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor([-4.0, -1.5, -1.5, -1.5, -1.5]))  # type: ignore[union-attr]

    def predict(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b 5 h4 w4"], ...]:
        """The centre's heatmap and the box's distances.

        Args:
            image: (b, 3, h, w), RGB in 0 to 1.

        Returns:
            One tensor (b, 5, h/4, w/4): the centre's heatmap in 0 to 1, then the distances from a cell's centre to the
            left, top, right and bottom side of the box, in units of the input's size.
        """
        check_input(image)
        raw = self.head(self.pyramid(self.encoder(image))).float()
        return (torch.cat([torch.sigmoid(raw[:, :1]), functional.softplus(raw[:, 1:])], dim=1),)
