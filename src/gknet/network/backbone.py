"""What the networks share: a residual encoder, a feature pyramid, attention and the encoding of positions."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.errors import GknetError

MEAN, SPREAD = 0.25, 0.25
"""Centre and spread of the pixel values (0 to 1): space is dark, so both are low."""

COARSEST = 32
"""The encoders' last stride: an input side is a multiple of it."""

FREQUENCIES = (0.5, 1.0, 2.0, 4.0)
"""Of the Fourier encoding, in periods per image side."""

POSITION_WIDTH = 4 * len(FREQUENCIES)


def check_input(image: Tensor) -> None:
    """Refuse what is not (b, 3, h, w) with h and w multiples of the coarsest stride.

    Raises:
        GknetError: The shape is another one.
    """
    if image.ndim != 4 or image.shape[1] != 3 or image.shape[2] % COARSEST or image.shape[3] % COARSEST:
        raise GknetError(
            f"network input: expected (b, 3, h, w) with h and w multiples of {COARSEST}, got {tuple(image.shape)}"
        )


def normalised(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Pixel values of 0 to 1 with about zero mean and unit spread."""
    return (image - MEAN) / SPREAD


def cell_centres(height: int, width: int, like: Tensor) -> Float[Tensor, "height width 2"]:
    """(height, width, 2), x and y of the centres of a map's cells in fractions of the image; device of `like`."""
    y = (torch.arange(height, device=like.device, dtype=torch.float32) + 0.5) / height
    x = (torch.arange(width, device=like.device, dtype=torch.float32) + 0.5) / width
    return torch.stack([x.expand(height, -1), y[:, None].expand(-1, width)], dim=2)


def fourier_encoding(positions: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 16"]:
    """Sines and cosines of 2 pi f x and 2 pi f y at each of the FREQUENCIES f.

    The same position in the image has the same encoding at every resolution, so one network serves several input
    sizes.

    Args:
        positions: (..., 2) x and y in fractions of the image.

    Returns:
        (..., POSITION_WIDTH).
    """
    frequencies = 2 * math.pi * torch.tensor(FREQUENCIES, device=positions.device)
    phase = positions[..., None] * frequencies  # (..., xy, frequency)
    return torch.cat([phase.sin(), phase.cos()], dim=-1).flatten(-2)


def position_encoding(height: int, width: int, like: Tensor) -> Float[Tensor, "16 height width"]:
    """The Fourier encodings of the centres of a map's cells: (POSITION_WIDTH, height, width)."""
    return fourier_encoding(cell_centres(height, width, like)).permute(2, 0, 1)


class ConvNorm(nn.Module):
    """Convolution, batch normalisation and, unless `relu` is False, a ReLU. `groups` = `inputs` is depthwise.

    (b, inputs, h, w) -> (b, outputs, h / stride, w / stride)
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, relu: bool = True, groups: int = 1
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
        self.norm = nn.BatchNorm2d(outputs)
        self.relu = relu

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o hs ws"]:
        x = self.norm(self.conv(x))
        return functional.relu(x, inplace=True) if self.relu else x


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = ConvNorm(inputs, outputs, 3, stride)
        self.second = ConvNorm(outputs, outputs, 3, relu=False)
        same = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if same else ConvNorm(inputs, outputs, 1, stride, relu=False)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o hs ws"]:
        return functional.relu(self.second(self.first(x)) + self.shortcut(x), inplace=True)


class Encoder(nn.Module):
    """ResNet-18's shape at any width: five down-samplings, features at strides 4, 8, 16 and 32.

    Attributes:
        widths: Channels of the four feature maps.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.widths = (width, 2 * width, 4 * width, 8 * width)
        self.stem = ConvNorm(3, width, 7, 2)
        self.pool = nn.MaxPool2d(3, 2, 1)
        self.stages = nn.ModuleList()
        inputs = width
        for outputs in self.widths:
            stride = 1 if outputs == width else 2
            self.stages.append(
                nn.Sequential(ResidualBlock(inputs, outputs, stride), ResidualBlock(outputs, outputs, 1))
            )
            inputs = outputs

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> list[Tensor]:
        """Features (b, widths[i], h / s, w / s) at strides s of 4, 8, 16 and 32."""
        x = self.pool(self.stem(normalised(image)))
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


class Pyramid(nn.Module):
    """From the coarsest feature map up to stride 4, with the encoder's map added at each level."""

    def __init__(self, widths: tuple[int, ...], width: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList([nn.Conv2d(inputs, width, 1) for inputs in widths])
        self.smooth = nn.ModuleList([ConvNorm(width, width, 3) for _ in widths[:-1]])

    def forward(self, features: list[Tensor]) -> Float[Tensor, "b c h4 w4"]:
        x = self.lateral[-1](features[-1])
        for level in range(len(features) - 2, -1, -1):
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.smooth[level](x + self.lateral[level](features[level]))
        return x


class Attention(nn.Module):
    """Multi-head attention of `width` channels from queries to a memory: softmax(q k^T / sqrt(c / heads)) v."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, queries: Float[Tensor, "b q c"], memory: Float[Tensor, "b m c"]) -> Float[Tensor, "b q c"]:
        batch, count, width = queries.shape
        each = width // self.heads
        query = self.query(queries).reshape(batch, count, self.heads, each).transpose(1, 2)
        pair = self.key_value(memory).reshape(batch, memory.shape[1], 2, self.heads, each)
        key, value = pair[:, :, 0].transpose(1, 2), pair[:, :, 1].transpose(1, 2)  # (b, heads, m, c/heads)
        weight = (query @ key.transpose(2, 3) / math.sqrt(each)).softmax(dim=-1)
        return self.out((weight @ value).transpose(1, 2).reshape(batch, count, width))


class ContextBlock(nn.Module):
    """A transformer layer over the cells of the coarsest map: every part of the image reaches every other one."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.before_attention = nn.LayerNorm(width)
        self.attention = Attention(width, heads)
        self.before_linear = nn.LayerNorm(width)
        self.linear = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))

    def forward(self, cells: Float[Tensor, "b m c"]) -> Float[Tensor, "b m c"]:
        normal = self.before_attention(cells)
        cells = cells + self.attention(normal, normal)
        return cells + self.linear(self.before_linear(cells))
