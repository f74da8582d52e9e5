"""ResUNet: a U-Net whose encoder is ResNet-34 (Cosmas and Kenichi 2020), for spacecraft landmarks.

Their input size, loss and the width of the decoder could not be retrieved. Chosen: the decoder doubles the resolution
from stride 32 to the heatmaps' stride, each level an up-sampling, a skip joined on and two 3x3 convolutions as wide as
the skip.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.errors import GknetError
from gknet.network.backbone import ConvNorm, ResidualBlock, check_input, normalised
from gknet.network.heatmap import HeatmapBranches, HeatmapNetwork


@dataclass(frozen=True)
class ResUNetConfig:
    """Sizes of the network; the defaults are ResNet-34.

    Attributes:
        width: Channels of the encoder's first stage.
        blocks: Residual blocks of each of its four stages.
    """

    width: int = 64
    blocks: tuple[int, int, int, int] = (3, 4, 6, 3)

    def __post_init__(self) -> None:
        if min(self.width, *self.blocks) < 1:
            raise GknetError(f"resunet: expected sizes of at least 1, got {self}")


class ResUNet(HeatmapNetwork):
    """Image -> one heatmap per keypoint at a quarter or an eighth of the input's resolution."""

    def __init__(self, config: ResUNetConfig, keypoints: int, loss: str = "likelihood", stride: int = 4) -> None:
        super().__init__(loss, stride)
        self.config = config
        widths = [config.width * 2**level for level in range(4)]
        self.stem = nn.Sequential(ConvNorm(3, widths[0], 7, 2), nn.MaxPool2d(3, 2, 1))
        self.down = nn.ModuleList()
        inputs = widths[0]
        for level, (outputs, count) in enumerate(zip(widths, config.blocks, strict=True)):
            first = ResidualBlock(inputs, outputs, 2 if level else 1)
            self.down.append(nn.Sequential(first, *[ResidualBlock(outputs, outputs, 1) for _ in range(count - 1)]))
            inputs = outputs
        finest = 0 if stride == 4 else 1
        self.up = nn.ModuleList(
            [
                nn.Sequential(
                    ConvNorm(widths[level + 1] + widths[level], widths[level]), ConvNorm(widths[level], widths[level])
                )
                for level in range(2, finest - 1, -1)
            ]
        )
        self.head = nn.Conv2d(widths[finest], keypoints, 1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def branches(self, image: Float[Tensor, "b 3 h w"]) -> HeatmapBranches:
        check_input(image)
        x = self.stem(normalised(image))
        skips = []
        for stage in self.down:
            x = stage(x)
            skips.append(x)
        for block, skip in zip(self.up, skips[-2::-1], strict=False):
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0, mode="nearest"), skip], dim=1))
        maps = self.head(x)
        return HeatmapBranches(maps, maps, None)
