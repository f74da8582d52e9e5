"""GKNet, small: a residual encoder, an up-sampling branch and a graph decoder whose nodes are keypoints."""

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
from gknet.network.heatmap import SHARPNESS, Branches, HeatmapNetwork, KeypointPrompts, log_probability
from gknet.network.spec import checked_graph

CONVICTION = 4
"""Power to which the first look's belief is raised before the second: whoever is in two minds takes a side."""


@dataclass(frozen=True)
class GKNetConfig:
    """Sizes of the network.

    width          channels of the encoder's first stage (ResNet-18 has 64)
    pyramid_width  channels of the up-sampling branch
    node_width     channels of a graph node and of the image cells that it attends to
    node_layers    layers of the graph decoder
    heads          attention heads
    bins           cells to a turn of the attitude that keypoints are expected by (decision 0016); 0 expects nothing
    graph          "skeleton", "identity" (no edges), "random" (as many edges, anywhere) or "none" (no graph branch)
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


PRIOR_CELLS, ATTITUDE_WIDTH = 8, 128
"""Side of the maps in which an attitude puts keypoints; channels of what tells the attitude."""


class GKNet(HeatmapNetwork):
    """Image -> one heatmap per keypoint at a quarter of the input's resolution."""

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
            places, middles = bins.keypoint_prior(points_m, PRIOR_CELLS), bins.expected_keypoints(points_m)
            self.prior = AttitudePrior(torch.from_numpy(places).float(), torch.from_numpy(middles).float())
        self.decoder: GraphDecoder | None = None
        if config.graph != "none":
            self._build_graph_branch(adjacency)

    def _build_graph_branch(self, adjacency: Bool[ndarray, "n n"]) -> None:
        config = self.config
        edges = normalised_adjacency(adjacency, checked_graph(config.graph))
        self.fine_cells = nn.Conv2d(self.encoder.widths[2], config.node_width, 1)
        seen = config.pyramid_width + POSITION_WIDTH
        self.decoder = GraphDecoder(
            edges, config.node_width, config.node_width, config.heads, config.node_layers, seen, votes=config.bins > 0
        )
        self.pixel_position = nn.Linear(POSITION_WIDTH, config.pyramid_width)
        self.pixel_features = ConvNorm(config.pyramid_width, config.pyramid_width, 1, relu=False)
        self.node_filter = nn.Linear(config.node_width, config.pyramid_width + 1)
        nn.init.normal_(self.node_filter.weight, std=0.02)  # the graph's maps start near zero, yet learn at once
        nn.init.zeros_(self.node_filter.bias)
        self.fusion = Fusion(len(adjacency))

    def branches(self, image: Float[Tensor, "b 3 h w"], prompts: KeypointPrompts | None = None) -> Branches:
        """The maps of both branches; `prompts` are what some nodes are told before their second look."""
        check_input(image)
        features = self.encoder(image)
        coarse = features[3]
        cells = self.context(self._cells(self.coarse_cells(coarse)))  # (b, hw/1024, c)
        context = cells.transpose(1, 2).reshape(coarse.shape[0], -1, coarse.shape[2], coarse.shape[3])
        known = torch.cat([coarse, context.to(coarse.dtype)], dim=1)
        up = self.pyramid([*features[:3], known])
        alone = self.pixel_head(up)  # eq. 1
        attitude = self.attitude(known) if self.config.bins else None
        pixels = self._expected(alone, attitude)
        if self.decoder is None:
            attitude = self._agreed(attitude, pixels)
            pixels = self._expected(alone, attitude)
            return Branches(pixels, pixels, None, attitude=attitude)
        memory = torch.cat([cells, self._cells(self.fine_cells(features[2]))], dim=1)
        places, seen = self._sight(up)

        def glance(nodes: Float[Tensor, "b n c"]) -> Float[Tensor, "b n s"]:
            # A plain sum: the fusion would be a way from node to node beside the edges.
            return log_probability(pixels + self._node_maps(nodes, places)).exp() @ seen

        nodes = self._node_maps(self.decoder(memory, glance), places)
        first = pixels + nodes
        attitude = self._agreed(attitude, first)
        settled = self._expected(alone, attitude)
        convinced = self._convinced(settled + nodes, prompts)
        found, votes = convinced @ seen, self._votes(attitude, convinced, *alone.shape[2:])
        nodes = self._node_maps(self.decoder(memory, lambda nodes: found, votes), places)
        return Branches(self.fusion(settled, nodes), settled, nodes, first, attitude)

    def _expected(self, maps: Float[Tensor, "b n h w"], attitude: Float[Tensor, "b k"] | None) -> Tensor:
        """Maps (b, n, h, w) with what the attitude says of each keypoint's place (decision 0016)."""
        return maps if attitude is None else maps + self.prior(attitude, *maps.shape[2:]) / SHARPNESS

    def _agreed(self, attitude: Float[Tensor, "b k"] | None, maps: Float[Tensor, "b n h w"]) -> Tensor | None:
        """The belief in the attitude (b, k), after a look at where the keypoints seem to be."""
        if attitude is None:
            return None
        return attitude + self.prior.evidence(log_probability(maps.detach()).exp().reshape(maps.shape))

    def _votes(
        self, attitude: Float[Tensor, "b k"] | None, convinced: Float[Tensor, "b n hw"], height: int, width: int
    ) -> Float[Tensor, "b to from p"] | None:
        """The codes of where each keypoint must be by what the others are convinced of (decision 0016)."""
        if attitude is None:
            return None
        found = convinced.float() @ cell_centres(height, width, convinced).flatten(0, 1)
        return fourier_encoding(self.prior.votes(attitude, found))

    def _cells(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b m c"]:
        """A map as a list of cells that know where they are."""
        code = position_encoding(features.shape[2], features.shape[3], features).flatten(1).T
        return features.permute(0, 2, 3, 1).flatten(1, 2) + self.position(code)

    def _sight(self, up: Float[Tensor, "b p h w"]) -> tuple[Float[Tensor, "b p h w"], Float[Tensor, "b hw s"]]:
        """Pixels that know where they are, and what a node sees of each at a glance.

        Each node is a 1x1 filter over these pixels: it says where its keypoint is. Between the layers of the decoder it
        sees what is where it believes its keypoint to be (decision 0012); in the second look, where the first one put
        it, and so do its neighbours by its messages (decision 0012).
        """
        code = position_encoding(up.shape[2], up.shape[3], up)
        along = self.pixel_position(code.flatten(1).T).T.reshape(-1, *up.shape[2:])
        places = functional.relu(self.pixel_features(up) + along)
        seen = torch.cat([places, code.expand(up.shape[0], -1, -1, -1)], dim=1).flatten(2).transpose(1, 2)
        return places, seen

    @staticmethod
    def _convinced(maps: Float[Tensor, "b n h w"], prompts: KeypointPrompts | None) -> Float[Tensor, "b n hw"]:
        """Where nodes look the second time: the sharpened belief of the maps, or what they are told."""
        belief = (CONVICTION * log_probability(maps.detach())).softmax(dim=2)
        if prompts is None:
            return belief
        truth = prompts.maps.flatten(2)
        truth = truth / truth.sum(dim=2, keepdim=True).clamp(min=1e-12)
        return torch.where(prompts.told[:, :, None], truth, belief)

    def _node_maps(self, nodes: Float[Tensor, "b n c"], places: Float[Tensor, "b p h w"]) -> Float[Tensor, "b n h w"]:
        # (b, n, p + 1), the last one a bias; scaled so that one step moves a map by little
        filters = self.node_filter(nodes) / self.node_filter.out_features
        maps = filters[:, :, :-1] @ places.flatten(2) + filters[:, :, -1:]
        return maps.reshape(*maps.shape[:2], *places.shape[2:])
