"""What describes a network before it is built. It loads no torch: the command line reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from jaxtyping import Bool, Float
from numpy import ndarray

from gknet.errors import GknetError

if TYPE_CHECKING:
    from gknet.network.network import Network

Graph = Literal["skeleton", "identity", "random", "none"]
"""The edges of the graph branch: the spacecraft's skeleton, none at all, as many between random pairs; or no branch."""

Loss = Literal["likelihood", "squared"]
"""The loss of a keypoint network: its maps are logits of the keypoint's position, or they are heatmaps."""

Kind = Literal["keypoints", "direct", "locator"]
"""What a network estimates, which is also the name of its exported file: heatmaps, a pose, or the spacecraft's box."""

LARGEST_INPUT, LARGEST_BATCH = 4096, 65_536


def checked_graph(graph: str) -> Graph:
    """`graph` itself.

    Raises:
        GknetError: It is no `Graph`.
    """
    if graph not in get_args(Graph):
        raise GknetError(f"graph: expected one of {', '.join(get_args(Graph))}, got '{graph}'")
    return graph  # type: ignore[return-value]


def checked_loss(loss: str) -> Loss:
    """`loss` itself.

    Raises:
        GknetError: It is no `Loss`.
    """
    if loss not in get_args(Loss):
        raise GknetError(f"loss: expected one of {', '.join(get_args(Loss))}, got '{loss}'")
    return loss  # type: ignore[return-value]


@dataclass(frozen=True)
class Stage:
    """A stretch of the training.

    Attributes:
        share: Of the budget, in (0, 1].
        input_size: Side of the network's input in pixels, a multiple of 32.
        batch: Samples in a step of one device.
    """

    share: float
    input_size: int
    batch: int

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise GknetError(f"stage: expected a share in (0, 1], got {self.share}")
        if not 32 <= self.input_size <= LARGEST_INPUT or self.input_size % 32:
            raise GknetError(
                f"stage: expected an input size that is a multiple of 32 up to {LARGEST_INPUT}, got {self.input_size}"
            )
        if not 1 <= self.batch <= LARGEST_BATCH:
            raise GknetError(f"stage: expected a batch of 1 to {LARGEST_BATCH}, got {self.batch}")
        if self.batch == 1 and self.input_size == 32:  # one cell of the coarsest map has no variance to normalise by
            raise GknetError("stage: expected a batch of 2 or more at an input size of 32, got 1")


@dataclass(frozen=True, eq=False)
class NetworkOptions:
    """What a builder may use. Each takes what it needs.

    Attributes:
        adjacency: (n, n), True where two keypoints share an edge of the skeleton, and on the diagonal.
        points_m: (n, 3) keypoints in metres, in the body frame.
        graph: Edges of the graph branch.
        loss: Of a keypoint network.
    """

    adjacency: Bool[ndarray, "n n"]
    points_m: Float[ndarray, "n 3"]
    graph: Graph = "skeleton"
    loss: Loss = "likelihood"

    @property
    def keypoint_count(self) -> int:
        return len(self.adjacency)


@dataclass(frozen=True)
class NetworkSpec:
    """One named network: all that the rest of the package must know to build, train, validate and export it.

    Attributes:
        kind: What it estimates.
        builder: Makes the network.
        stages: Of its training, unless the settings name others.
        loss: Its own choice of `Loss`; None where nothing can be chosen: the kind has a loss of its own.
        has_graph: Whether it has a graph branch, whose edges can be chosen.
    """

    kind: Kind
    builder: Callable[[NetworkOptions], Network]
    stages: tuple[Stage, ...]
    loss: Loss | None = None
    has_graph: bool = False

    def __post_init__(self) -> None:
        if (self.loss is None) == (self.kind == "keypoints"):
            raise GknetError(f"network: expected a loss of a keypoint network alone, got {self.loss} of {self.kind}")
