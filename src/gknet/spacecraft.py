"""A known spacecraft: its mesh, named keypoints, skeleton and symmetries."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from gknet.errors import GknetError

MAX_KEYPOINTS = 1000
"""A heatmap belongs to each keypoint, and a square of this number to the graph: more would not fit into memory."""

MAX_EXTENT_M = 1e5
"""Larger coordinates and diameters are a slip of the unit, and their squares would lose precision."""

Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class Symmetry(BaseModel):
    """A rotation of the body that leaves its appearance nearly (or exactly) unchanged.

    Attributes:
        axis: (3,) the axis of rotation in the body frame, of any length.
        angle_deg: The angle in degrees.
        exact: Whether the two attitudes cannot be distinguished at all.
        broken_by: What distinguishes them, for people.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    axis: Vector
    angle_deg: FiniteFloat
    exact: bool = False
    broken_by: str = ""


@dataclass(frozen=True, eq=False)
class Spacecraft:
    """A known spacecraft: its keypoints, skeleton and mesh.

    Row k of the keypoints, channel k of a heatmap and node k of the graph are all keypoint k.

    Attributes:
        name: Such as satellite_01.
        keypoint_names: A different name for each of the n keypoints.
        points_m: (n, 3) keypoints in the body frame in m, read-only.
        edges: Pairs of keypoint indices, i < j: the skeleton, by meaning and nearness.
        diameter_m: The largest distance between two points of the mesh in m.
        symmetries: Rotations that leave the spacecraft's appearance nearly unchanged.
        mesh_path: A GLB with PBR materials in metres; None when only the keypoints are known.
        description: One sentence for people.

    Raises:
        GknetError: Shapes do not agree, there are more than 1,000 keypoints, a length is not finite or beyond 100 km,
            names repeat, or an edge has no keypoint.
    """

    name: str
    keypoint_names: tuple[str, ...]
    points_m: Float[ndarray, "n 3"]
    edges: tuple[tuple[int, int], ...]
    diameter_m: float
    symmetries: tuple[Symmetry, ...] = ()
    mesh_path: Path | None = None
    description: str = ""

    def __post_init__(self) -> None:
        count = len(self.keypoint_names)
        object.__setattr__(self, "points_m", _checked_points(self.name, self.points_m, count))
        if not 0 < self.diameter_m <= MAX_EXTENT_M:
            raise GknetError(f"{self.name}: expected a diameter of 0 to {MAX_EXTENT_M:g} m, got {self.diameter_m}")
        if len(set(self.keypoint_names)) != count:
            raise GknetError(f"{self.name}: keypoint names must differ from each other")
        for i, j in self.edges:
            if not (0 <= i < count and 0 <= j < count and i != j):
                raise GknetError(f"{self.name}: edge ({i}, {j}) is no pair of the keypoints 0 to {count - 1}")
        ordered = tuple(sorted({(min(i, j), max(i, j)) for i, j in self.edges}))
        object.__setattr__(self, "edges", ordered)

    @property
    def keypoint_count(self) -> int:
        """n, the number of keypoints."""
        return len(self.keypoint_names)

    @cached_property
    def adjacency(self) -> Bool[ndarray, "n n"]:
        """(n, n) bool, symmetric and true on the diagonal; A in eq. 3 of the paper."""
        matrix = np.eye(self.keypoint_count, dtype=bool)
        for i, j in self.edges:
            matrix[i, j] = matrix[j, i] = True
        return matrix


def diameter(points_m: Float[ndarray, "n 3"]) -> float:
    """The largest distance between two of the points, in m."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = points_m[ConvexHull(points_m).vertices]
    except QhullError:  # points of one plane have no hull
        hull = np.unique(points_m, axis=0)
    return float(max(np.linalg.norm(hull - point, axis=1).max() for point in hull))


def _checked_points(name: str, points_m: object, count: int) -> Float[ndarray, "n 3"]:
    """A read-only copy of the keypoints, or a GknetError."""
    points = np.array(points_m, dtype=np.float64)
    if count > MAX_KEYPOINTS:
        raise GknetError(f"{name}: expected at most {MAX_KEYPOINTS} keypoints, got {count}")
    if points.shape != (count, 3) or not np.isfinite(points).all():
        raise GknetError(f"{name}: expected {count} finite keypoints of shape ({count}, 3), got {points.shape}")
    if count and np.abs(points).max() > MAX_EXTENT_M:
        largest = np.abs(points).max()
        raise GknetError(f"{name}: expected keypoints within {MAX_EXTENT_M:g} m of the origin, got {largest:g} m")
    points.setflags(write=False)
    return points
