"""GKNet: a residual encoder, an up-sampling branch and a graph decoder whose nodes are keypoints (decision 0012).

The flow of data, for b images of h x w with n keypoints. gknet-s has node width c = 128, pyramid width p = 48 and
k = 864 attitude classes. m = h/32 w/32 + h/16 w/16 cells, s = p + 16 channels of a sample.

    image (b, 3, h, w)
      |
    encode()
      |  Encoder        -> features at strides 4, 8, 16 and 32
      |  ContextBlock   -> cells of stride 32 that know each other, appended to the features of stride 32
      |  AttitudeHead   -> attitude (b, k)                  logits, from stride 32
      |  Pyramid        -> pyramid (b, p, h/4, w/4)         from all strides
      |  pixel_head     -> pixel_maps (b, n, h/4, w/4)      from the pyramid: eq. 1
      |  pixel features -> features (b, p, h/4, w/4), samples (b, h/4 w/4, s)
      |  memory         -> (b, m, c)                        cells of strides 32 and 16
      |
      |-- first_pass()
      |     prior of the attitude + pixel_maps              -> maps of the up-sampling branch
      |     GraphDecoder: memory, samples where the maps are high   -> nodes (b, n, c) -> node_maps
      |     evidence of the keypoints                       -> attitude (b, k), updated
      |
      |-- second_pass()
      |     prior of the updated attitude + pixel_maps      -> maps of the up-sampling branch
      |     positions of the first pass, or true ones of prompted keypoints
      |     GraphDecoder: memory, samples at the positions, position votes -> nodes -> node_maps
      |
    Fusion              -> fused maps (b, n, h/4, w/4)      -> heatmaps

Both passes use the same weights. The two maps of the first pass are simply added: a fusion of all maps would be a path
between keypoints beside the edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor, nn
from torch.nn import functional

from gknet.errors import GknetError
from gknet.inference.attitude import AttitudeBins
from gknet.network.attitude_prior import AttitudeHead, AttitudePrior
from gknet.network.backbone import (
    POSITION_WIDTH,
    ContextBlock,
    ConvNorm,
    Encoder,
    Pyramid,
    cell_centres,
    check_input,
    fourier_encoding,
    position_encoding,
)
from gknet.network.graph import Fusion, GraphDecoder, normalised_adjacency
from gknet.network.heatmap import SHARPNESS, HeatmapBranches, HeatmapNetwork, KeypointPrompts, log_probability
from gknet.network.spec import checked_graph

FIRST_PASS_INVERSE_TEMPERATURE = 4
"""Of the first pass's probability before the second pass: of two likely positions, the likelier one dominates."""

PRIOR_CELLS = 8
"""Side of the maps in which an attitude places keypoints."""

ATTITUDE_WIDTH = 128
"""Channels of the features that the attitude is classified from."""

TINY = 1e-12


@dataclass(frozen=True)
class GKNetConfig:
    """Sizes of the network.

    Attributes:
        width: Channels of the encoder's first stage (ResNet-18 has 64).
        pyramid_width: Channels p of the up-sampling branch.
        node_width: Channels c of a graph node and of the image cells that it attends to.
        node_layers: Layers of the graph decoder.
        heads: Attention heads.
        bins: Cells per turn of the attitude prior (decision 0016); 0 is none.
        graph: "skeleton", "identity" (no edges), "random" (as many edges, anywhere) or "none" (no graph branch).
    """

    width: int = 32
    pyramid_width: int = 48
    node_width: int = 128
    node_layers: int = 3
    heads: int = 4
    bins: int = 0
    graph: str = "skeleton"

    def __post_init__(self) -> None:
        checked_graph(self.graph)
        for name in ("width", "pyramid_width", "node_width", "node_layers", "heads"):
            if getattr(self, name) < 1:
                raise GknetError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.node_width % self.heads:
            raise GknetError(f"node_width: expected a multiple of heads ({self.heads}), got {self.node_width}")


@dataclass(frozen=True, eq=False)
class Encoded:
    """What the image gives, before any keypoint knows of another.

    Attributes:
        pixel_maps: (b, n, h/4, w/4) of the up-sampling branch, without the attitude prior.
        attitude: (b, k) logits of the attitude classes; None without a prior.
        pyramid: (b, p, h/4, w/4).
        coarse_cells: (b, h/32 w/32, c).
        middle: (b, 4 width, h/16, w/16), the encoder's features of stride 16.
    """

    pixel_maps: Float[Tensor, "b n h4 w4"]
    attitude: Float[Tensor, "b k"] | None
    pyramid: Float[Tensor, "b p h4 w4"]
    coarse_cells: Float[Tensor, "b m c"]
    middle: Float[Tensor, "b d h16 w16"]


@dataclass(frozen=True, eq=False)
class GraphInput:
    """What the graph decoder reads, in both passes.

    Attributes:
        memory: (b, m, c) cells that nodes attend to.
        features: (b, p, h/4, w/4) pixel features with the position encoded; a node is a 1x1 filter over them.
        samples: (b, h/4 w/4, s) the same features and the plain position encoding, row by row, for feature sampling.
    """

    memory: Float[Tensor, "b m c"]
    features: Float[Tensor, "b p h4 w4"]
    samples: Float[Tensor, "b hw s"]


@dataclass(frozen=True, eq=False)
class FirstPass:
    """Result of the first pass.

    Attributes:
        maps: (b, n, h/4, w/4) sum of both branches.
        node_maps: (b, n, h/4, w/4) of the graph branch.
        attitude: (b, k) logits, updated by the evidence of the keypoints; None without a prior.
    """

    maps: Float[Tensor, "b n h4 w4"]
    node_maps: Float[Tensor, "b n h4 w4"]
    attitude: Float[Tensor, "b k"] | None


@dataclass(frozen=True, eq=False)
class SecondPass:
    """Result of the second pass: (b, n, h/4, w/4) maps of the up-sampling branch and of the graph branch."""

    pixel_maps: Float[Tensor, "b n h4 w4"]
    node_maps: Float[Tensor, "b n h4 w4"]


class GKNet(HeatmapNetwork):
    """Image -> one heatmap per keypoint at a quarter of the input's resolution.

    Args:
        config: Sizes.
        adjacency: (n, n), True where two keypoints share an edge of the skeleton, and on the diagonal.
        points_m: (n, 3) keypoints in metres, in the body frame, for the attitude prior.
        loss: "likelihood" or "squared".
    """

    def __init__(
        self,
        config: GKNetConfig,
        adjacency: Bool[ndarray, "n n"],
        points_m: Float[ndarray, "n 3"],
        loss: str = "likelihood",
    ) -> None:
        super().__init__(loss, stride=4)
        self.config = config
        self.two_pass = config.graph != "none"
        self.attitude_bins = config.bins or None
        keypoints = len(adjacency)
        self.encoder = Encoder(config.width)
        widths = self.encoder.widths
        self.position = nn.Linear(POSITION_WIDTH, config.node_width)
        self.coarse_cells = nn.Conv2d(widths[3], config.node_width, 1)
        self.context = ContextBlock(config.node_width, config.heads)
        self.pyramid = Pyramid((*widths[:3], widths[3] + config.node_width), config.pyramid_width)
        self.pixel_head = nn.Conv2d(config.pyramid_width, keypoints, 1)
        nn.init.normal_(self.pixel_head.weight, std=0.01)
        nn.init.zeros_(self.pixel_head.bias)  # type: ignore[arg-type]
        if config.bins:
            bins = AttitudeBins(config.bins)
            self.attitude = AttitudeHead(widths[3] + config.node_width, ATTITUDE_WIDTH, bins.count)
            self.prior = AttitudePrior(torch.from_numpy(bins.expected_keypoints(points_m)).float(), PRIOR_CELLS)
        self.decoder: GraphDecoder | None = None
        if config.graph != "none":
            self._build_graph_branch(adjacency)

    def _build_graph_branch(self, adjacency: Bool[ndarray, "n n"]) -> None:
        config = self.config
        edges = normalised_adjacency(adjacency, checked_graph(config.graph))
        self.fine_cells = nn.Conv2d(self.encoder.widths[2], config.node_width, 1)
        self.decoder = GraphDecoder(
            edges,
            width=config.node_width,
            hidden=config.node_width,
            heads=config.heads,
            layers=config.node_layers,
            sample_width=config.pyramid_width + POSITION_WIDTH,
            votes=config.bins > 0,
        )
        self.pixel_position = nn.Linear(POSITION_WIDTH, config.pyramid_width)
        self.pixel_features = ConvNorm(config.pyramid_width, config.pyramid_width, 1, relu=False)
        self.node_filter = nn.Linear(config.node_width, config.pyramid_width + 1)
        nn.init.normal_(self.node_filter.weight, std=0.02)  # the graph's maps start near zero, yet learn at once
        nn.init.zeros_(self.node_filter.bias)
        self.fusion = Fusion(len(adjacency))

    def branches(self, image: Float[Tensor, "b 3 h w"], prompts: KeypointPrompts | None = None) -> HeatmapBranches:
        """The maps of both branches and of both passes.

        Args:
            image: (b, 3, h, w), RGB in 0 to 1.
            prompts: Keypoints whose true positions enter the second pass; in training only.
        """
        check_input(image)
        encoded = self.encode(image)
        if self.decoder is None:
            return self._without_graph(encoded)
        given = self.graph_input(encoded)
        first = self.first_pass(encoded, given)
        second = self.second_pass(encoded, given, first, prompts)
        fused = self.fusion(second.pixel_maps, second.node_maps)
        return HeatmapBranches(fused, second.pixel_maps, second.node_maps, first.maps, first.attitude)

    def encode(self, image: Float[Tensor, "b 3 h w"]) -> Encoded:
        """From the image to the maps of the up-sampling branch and the attitude."""
        features = self.encoder(image)
        coarse = features[3]
        cells = self.context(self._cells(self.coarse_cells(coarse)))  # (b, h/32 w/32, c)
        context = cells.transpose(1, 2).reshape(coarse.shape[0], -1, coarse.shape[2], coarse.shape[3])
        coarse = torch.cat([coarse, context.to(coarse.dtype)], dim=1)  # (b, 8 width + c, h/32, w/32)
        pyramid = self.pyramid([*features[:3], coarse])
        attitude = self.attitude(coarse) if self.config.bins else None
        return Encoded(self.pixel_head(pyramid), attitude, pyramid, cells, features[2])  # eq. 1

    def graph_input(self, encoded: Encoded) -> GraphInput:
        """Cells to attend to, and pixel features to sample and to filter."""
        memory = torch.cat([encoded.coarse_cells, self._cells(self.fine_cells(encoded.middle))], dim=1)
        height, width = encoded.pyramid.shape[2:]
        encoding = position_encoding(height, width, encoded.pyramid)  # (16, h/4, w/4)
        offset = self.pixel_position(encoding.flatten(1).T).T.reshape(-1, height, width)
        features = functional.relu(self.pixel_features(encoded.pyramid) + offset)
        with_position = torch.cat([features, encoding.expand(features.shape[0], -1, -1, -1)], dim=1)
        return GraphInput(memory, features, with_position.flatten(2).transpose(1, 2))

    def first_pass(self, encoded: Encoded, given: GraphInput) -> FirstPass:
        """Each node samples pixel features where both branches expect its keypoint, layer by layer."""
        assert self.decoder is not None
        pixel_maps = self._with_prior(encoded.pixel_maps, encoded.attitude)

        def sample_features(nodes: Float[Tensor, "b n c"]) -> Float[Tensor, "b n s"]:
            return log_probability(pixel_maps + self._node_maps(nodes, given.features)).exp() @ given.samples

        node_maps = self._node_maps(self.decoder(given.memory, sample_features), given.features)
        maps = pixel_maps + node_maps
        return FirstPass(maps, node_maps, self._updated_attitude(encoded.attitude, maps))

    def second_pass(
        self, encoded: Encoded, given: GraphInput, first: FirstPass, prompts: KeypointPrompts | None = None
    ) -> SecondPass:
        """Each node samples where the first pass found its keypoint, and neighbours vote for its position."""
        assert self.decoder is not None
        pixel_maps = self._with_prior(encoded.pixel_maps, first.attitude)
        probability = self._sharpened(pixel_maps + first.node_maps, prompts)
        samples = probability @ given.samples
        votes = self._position_votes(first.attitude, probability, *pixel_maps.shape[2:])
        nodes = self.decoder(given.memory, lambda nodes: samples, votes)
        return SecondPass(pixel_maps, self._node_maps(nodes, given.features))

    def _without_graph(self, encoded: Encoded) -> HeatmapBranches:
        """The up-sampling branch alone, with the prior of an attitude that its own maps have updated."""
        attitude = self._updated_attitude(encoded.attitude, self._with_prior(encoded.pixel_maps, encoded.attitude))
        maps = self._with_prior(encoded.pixel_maps, attitude)
        return HeatmapBranches(maps, maps, None, attitude=attitude)

    def _with_prior(self, maps: Float[Tensor, "b n h w"], attitude: Float[Tensor, "b k"] | None) -> Tensor:
        """Maps plus the log prior of each keypoint's position under the attitude (decision 0016)."""
        return maps if attitude is None else maps + self.prior(attitude, *maps.shape[2:]) / SHARPNESS

    def _updated_attitude(self, attitude: Float[Tensor, "b k"] | None, maps: Float[Tensor, "b n h w"]) -> Tensor | None:
        """Logits plus the evidence of the keypoints, of which the gradient is not followed."""
        if attitude is None:
            return None
        return attitude + self.prior.evidence(log_probability(maps.detach()).exp().reshape(maps.shape))

    def _position_votes(
        self, attitude: Float[Tensor, "b k"] | None, probability: Float[Tensor, "b n hw"], height: int, width: int
    ) -> Float[Tensor, "b to from 16"] | None:
        """The Fourier encodings of each keypoint's position according to each other one."""
        if attitude is None:
            return None
        positions = probability.float() @ cell_centres(height, width, probability).flatten(0, 1)  # soft-argmax
        return fourier_encoding(self.prior.position_votes(attitude, positions))

    @staticmethod
    def _sharpened(maps: Float[Tensor, "b n h w"], prompts: KeypointPrompts | None) -> Float[Tensor, "b n hw"]:
        """The sharpened probability of each keypoint's cell, or the truth of a prompted keypoint."""
        probability = (FIRST_PASS_INVERSE_TEMPERATURE * log_probability(maps.detach())).softmax(dim=2)
        if prompts is None:
            return probability
        truth = prompts.maps.flatten(2)
        truth = truth / truth.sum(dim=2, keepdim=True).clamp(min=TINY)
        return torch.where(prompts.prompted[:, :, None], truth, probability)

    def _cells(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b m c"]:
        """A feature map as a list of cells, with their position added."""
        encoding = position_encoding(features.shape[2], features.shape[3], features).flatten(1).T
        return features.permute(0, 2, 3, 1).flatten(1, 2) + self.position(encoding)

    def _node_maps(self, nodes: Float[Tensor, "b n c"], features: Float[Tensor, "b p h w"]) -> Float[Tensor, "b n h w"]:
        """Each node as a 1x1 filter over the pixel features, with a bias."""
        # (b, n, p + 1), the last one the bias; scaled so that one step of the training moves a map by little
        filters = self.node_filter(nodes) / self.node_filter.out_features
        maps = filters[:, :, :-1] @ features.flatten(2) + filters[:, :, -1:]
        return maps.reshape(*maps.shape[:2], *features.shape[2:])
