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
    """D^-1/2 A D^-1/2 of the binary, symmetric A with ones on its diagonal (eq. 3).

    The ablations at equal size: `identity` forgets the edges, so nodes keep their layers and do not mix; `random` has
    as many edges as the skeleton, between pairs drawn once and for all.
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
    """sigma(W F A~) of eq. 2 and the linear layer behind it that keeps nodes apart (GraphCape)."""

    adjacency: Tensor

    def __init__(self, adjacency: Float[Tensor, "n n"], width: int, hidden: int) -> None:
        super().__init__()
        self.mix = nn.Linear(width, hidden)
        self.linear = nn.Linear(hidden, width)
        # The skeleton belongs to the spacecraft, not to the weights: it is rebuilt, never loaded.
        self.register_buffer("adjacency", adjacency, persistent=False)

    def forward(self, nodes: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        mixed = self.mix(nodes)
        return self.linear(functional.relu(self.adjacency.to(mixed.dtype) @ mixed))  # eq. 2, nodes as rows


class EdgeConvolution(nn.Module):
    """Messages along the edges that know both of their ends (EdgeConv, Wang et al. 2019), summed as A~ weighs them.

    Under eq. 2 a node tells all its neighbours the same; here it can tell each where that one must be. `votes` are the
    codes of such places (decision 0016), of POSITION_WIDTH; a decoder without them says nothing of places.
    """

    adjacency: Tensor

    def __init__(self, adjacency: Float[Tensor, "n n"], width: int, hidden: int, votes: bool = False) -> None:
        super().__init__()
        self.receive = nn.Linear(width, hidden)
        self.send = nn.Linear(width, hidden)
        self.place = nn.Linear(POSITION_WIDTH, hidden, bias=False) if votes else None
        self.linear = nn.Linear(hidden, width)
        self.register_buffer("adjacency", adjacency, persistent=False)

    def forward(
        self, nodes: Float[Tensor, "b n c"], votes: Float[Tensor, "b to from p"] | None = None
    ) -> Float[Tensor, "b n c"]:
        said = self.receive(nodes)[:, :, None] + self.send(nodes)[:, None]  # (b, to, from, c)
        if votes is not None and self.place is not None:
            said = said + self.place(votes)
        messages = functional.relu(said)
        return self.linear((self.adjacency.to(messages.dtype)[:, :, None] * messages).sum(dim=2))


Glance = Callable[[Tensor], Tensor]
"""Nodes (b, n, c) -> what is seen where each of them believes its keypoint to be (b, n, p)."""


class GraphLayer(nn.Module):
    """Nodes look at the picture, then talk along the edges; each with a residual and a LayerNorm.

    The edges are the only way from node to node, so that an ablation of the edges is one of the graph.
    With a width of glances, nodes say in between where they believe their keypoints to be and see what is there, and
    messages know both ends; without one (0) messages are those of eq. 2.
    """

    def __init__(
        self, adjacency: Float[Tensor, "n n"], width: int, hidden: int, heads: int, glance: int, votes: bool
    ) -> None:
        super().__init__()
        self.look = Attention(width, heads)
        self.after_look = nn.LayerNorm(width)
        if glance:
            self.seen = nn.Linear(glance, width)
            self.after_seen = nn.LayerNorm(width)
        self.graph: EdgeConvolution | GraphConvolution
        if glance:
            self.graph = EdgeConvolution(adjacency, width, hidden, votes)
        else:
            self.graph = GraphConvolution(adjacency, width, hidden)
        self.after_graph = nn.LayerNorm(width)

    def forward(
        self,
        nodes: Float[Tensor, "b n c"],
        memory: Float[Tensor, "b m c"],
        glance: Glance | None,
        votes: Float[Tensor, "b to from p"] | None,
    ) -> Float[Tensor, "b n c"]:
        nodes = self.after_look(nodes + self.look(nodes, memory))
        if glance is not None:
            nodes = self.after_seen(nodes + self.seen(glance(nodes)))
        told = self.graph(nodes, votes) if isinstance(self.graph, EdgeConvolution) else self.graph(nodes)
        return self.after_graph(nodes + told)


class GraphDecoder(nn.Module):
    """One learned query per keypoint becomes that keypoint's node; any number of keypoints.

    glance  channels of what a node sees at a glance; 0 where it is given none
    votes   whether nodes that glance tell each other places as well
    """

    def __init__(
        self,
        adjacency: Float[Tensor, "n n"],
        width: int,
        hidden: int,
        heads: int,
        layers: int,
        glance: int = 0,
        votes: bool = False,
    ) -> None:
        super().__init__()
        self.queries = nn.Parameter(torch.randn(len(adjacency), width) * 0.5)
        self.layers = nn.ModuleList([GraphLayer(adjacency, width, hidden, heads, glance, votes) for _ in range(layers)])

    def forward(
        self,
        memory: Float[Tensor, "b m c"],
        glance: Glance | None = None,
        votes: Float[Tensor, "b to from p"] | None = None,
    ) -> Float[Tensor, "b n c"]:
        nodes = self.queries.expand(memory.shape[0], -1, -1)
        for layer in self.layers:
            nodes = layer(nodes, memory, glance, votes)
        return nodes


class Fusion(nn.Module):
    """The maps of both branches, joined by a 1x1 convolution.

    At the start the output is the up-sampling branch's map plus the node's map, keypoint by keypoint: neither branch
    starves the other, and where the maps are logits a node can veto a twin's peak.
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
