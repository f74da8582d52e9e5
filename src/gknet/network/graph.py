"""The graph decoder: a node is a keypoint, an edge is a pair of the spacecraft's skeleton."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor, nn
from torch.nn import functional

from gknet.errors import GknetError
from gknet.network.backbone import POSITION_WIDTH, Attention
from gknet.network.spec import Graph


def normalised_adjacency(adjacency: Bool[ndarray, "n n"], graph: Graph = "skeleton") -> Float[Tensor, "n n"]:
    """A~ = D^-1/2 A D^-1/2 of the binary, symmetric A with ones on its diagonal (eq. 3).

    Args:
        adjacency: (n, n), True where two keypoints share an edge, and on the diagonal.
        graph: Ablations of equal size: "identity" drops the edges, so nodes keep their layers and do not mix;
            "random" has as many edges as the skeleton, between pairs that are drawn once and for all.

    Raises:
        GknetError: The matrix is no adjacency.
    """
    matrix = np.asarray(adjacency, dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise GknetError(f"adjacency: expected a square matrix, got shape {matrix.shape}")
    if not (np.isin(matrix, (0, 1)).all() and (matrix == matrix.T).all() and (matrix.diagonal() == 1).all()):
        raise GknetError("adjacency: expected zeros and ones, symmetric, with ones on the diagonal")
    if graph == "identity":
        matrix = np.eye(len(matrix))
    elif graph == "random":
        matrix = _random_adjacency(len(matrix), int(np.triu(matrix, 1).sum()))
    root = 1 / np.sqrt(matrix.sum(axis=1))
    return torch.from_numpy(root[:, None] * matrix * root[None, :]).float()


def _random_adjacency(count: int, edges: int) -> Float[ndarray, "n n"]:
    """A function of its arguments alone, since a trained network's graph is rebuilt, not stored."""
    pairs = np.argwhere(np.triu(np.ones((count, count)), 1))
    chosen = pairs[np.random.default_rng((count, edges)).permutation(len(pairs))[:edges]]
    matrix = np.eye(count)
    matrix[chosen[:, 0], chosen[:, 1]] = matrix[chosen[:, 1], chosen[:, 0]] = 1
    return matrix


class GraphConvolution(nn.Module):
    """sigma(W F A~) of eq. 2, followed by the linear layer that keeps nodes apart (GraphCape).

    Attributes:
        adjacency: (n, n) A~. It belongs to the spacecraft, not to the weights: it is rebuilt, never loaded.
    """

    adjacency: Tensor

    def __init__(self, adjacency: Float[Tensor, "n n"], width: int, hidden: int) -> None:
        super().__init__()
        self.mix = nn.Linear(width, hidden)
        self.linear = nn.Linear(hidden, width)
        self.register_buffer("adjacency", adjacency, persistent=False)

    def forward(self, nodes: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        mixed = self.mix(nodes)
        return self.linear(functional.relu(self.adjacency.to(mixed.dtype) @ mixed))  # eq. 2, nodes as rows


class EdgeConvolution(nn.Module):
    """Messages that depend on both ends of their edge (EdgeConv, Wang et al. 2019), summed with the weights of A~.

    Under eq. 2, a node sends the same message to all of its neighbours; here each neighbour receives its own. With
    position votes, a message also contains the receiver's position according to the sender (decision 0016).
    """

    adjacency: Tensor

    def __init__(self, adjacency: Float[Tensor, "n n"], width: int, hidden: int, votes: bool = False) -> None:
        super().__init__()
        self.receive = nn.Linear(width, hidden)
        self.send = nn.Linear(width, hidden)
        self.position = nn.Linear(POSITION_WIDTH, hidden, bias=False) if votes else None
        self.linear = nn.Linear(hidden, width)
        self.register_buffer("adjacency", adjacency, persistent=False)

    def forward(
        self, nodes: Float[Tensor, "b n c"], position_votes: Float[Tensor, "b to from p"] | None = None
    ) -> Float[Tensor, "b n c"]:
        """The sum of the messages that each node receives.

        Args:
            nodes: (b, n, c).
            position_votes: (b, n, n, 16) Fourier encodings of the positions that senders vote for; None in a first
                pass.
        """
        messages = self.receive(nodes)[:, :, None] + self.send(nodes)[:, None]  # (b, to, from, c)
        if position_votes is not None and self.position is not None:
            messages = messages + self.position(position_votes)
        messages = functional.relu(messages)
        return self.linear((self.adjacency.to(messages.dtype)[:, :, None] * messages).sum(dim=2))


SampleFeatures = Callable[[Tensor], Tensor]
"""Nodes (b, n, c) -> pixel features at the position of each node's keypoint (b, n, s)."""


class GraphLayer(nn.Module):
    """Nodes attend to the image, sample pixel features and exchange messages.

    Each of the three steps has a residual and a LayerNorm. The edges are the only path between nodes, so that an
    ablation of the edges is one of the graph. Without feature sampling (`sample_width` 0), messages are those of eq. 2.
    """

    def __init__(
        self, adjacency: Float[Tensor, "n n"], width: int, hidden: int, heads: int, sample_width: int, votes: bool
    ) -> None:
        super().__init__()
        self.attention = Attention(width, heads)
        self.attention_norm = nn.LayerNorm(width)
        if sample_width:
            self.sample = nn.Linear(sample_width, width)
            self.sample_norm = nn.LayerNorm(width)
        self.graph: EdgeConvolution | GraphConvolution
        if sample_width:
            self.graph = EdgeConvolution(adjacency, width, hidden, votes)
        else:
            self.graph = GraphConvolution(adjacency, width, hidden)
        self.graph_norm = nn.LayerNorm(width)

    def forward(
        self,
        nodes: Float[Tensor, "b n c"],
        memory: Float[Tensor, "b m c"],
        sample_features: SampleFeatures | None,
        position_votes: Float[Tensor, "b to from p"] | None,
    ) -> Float[Tensor, "b n c"]:
        nodes = self.attention_norm(nodes + self.attention(nodes, memory))
        if sample_features is not None:
            nodes = self.sample_norm(nodes + self.sample(sample_features(nodes)))
        votes = (position_votes,) if isinstance(self.graph, EdgeConvolution) else ()
        return self.graph_norm(nodes + self.graph(nodes, *votes))


class GraphDecoder(nn.Module):
    """One learnt query per keypoint becomes that keypoint's node; any number of keypoints.

    Args:
        adjacency: (n, n) A~ of eq. 3.
        width: Channels c of a node.
        hidden: Channels of a message.
        heads: Of the attention to the image.
        layers: How many.
        sample_width: Channels of a feature sample; 0 without feature sampling.
        votes: Whether messages contain position votes; only with feature sampling.
    """

    def __init__(
        self,
        adjacency: Float[Tensor, "n n"],
        width: int,
        hidden: int,
        heads: int,
        layers: int,
        sample_width: int = 0,
        votes: bool = False,
    ) -> None:
        super().__init__()
        self.queries = nn.Parameter(torch.randn(len(adjacency), width) * 0.5)
        self.layers = nn.ModuleList(
            [GraphLayer(adjacency, width, hidden, heads, sample_width, votes) for _ in range(layers)]
        )

    def forward(
        self,
        memory: Float[Tensor, "b m c"],
        sample_features: SampleFeatures | None = None,
        position_votes: Float[Tensor, "b to from p"] | None = None,
    ) -> Float[Tensor, "b n c"]:
        """One pass of the decoder.

        Args:
            memory: (b, m, c) cells of the image.
            sample_features: Called between attention and messages of each layer, with the nodes.
            position_votes: (b, n, n, 16) Fourier encodings, the same in each layer.

        Returns:
            (b, n, c) nodes.
        """
        nodes = self.queries.expand(memory.shape[0], -1, -1)
        for layer in self.layers:
            nodes = layer(nodes, memory, sample_features, position_votes)
        return nodes


class Fusion(nn.Module):
    """The maps of both branches, joined by a 1x1 convolution.

    At the start of a training the output is the sum of the two maps of each keypoint: neither branch starves the
    other, and where the maps are logits a node can veto the peak at a symmetric counterpart.
    """

    def __init__(self, keypoints: int) -> None:
        super().__init__()
        self.join = nn.Conv2d(2 * keypoints, keypoints, 1)
        one = torch.eye(keypoints)
        with torch.no_grad():
            self.join.weight.copy_(torch.cat([one, one], dim=1)[:, :, None, None])
            nn.init.zeros_(self.join.bias)  # type: ignore[arg-type]

    def forward(self, pixels: Float[Tensor, "b n h w"], nodes: Float[Tensor, "b n h w"]) -> Float[Tensor, "b n h w"]:
        return self.join(torch.cat([pixels, nodes], dim=1))
