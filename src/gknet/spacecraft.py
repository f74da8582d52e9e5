"""A known spacecraft: its mesh, named keypoints, skeleton and symmetries, and the .toml that keeps them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from gknet.errors import GknetError
from gknet.io.atomic import write_text
from gknet.io.text import parse_toml, read_text, validated

Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class Symmetry(BaseModel):
    """A turn of the body that leaves its look nearly (or exactly) unchanged."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    axis: Vector
    angle_deg: FiniteFloat
    exact: bool = False
    broken_by: str = ""


class _Keypoint(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str
    point_m: Vector


class _File(BaseModel):
    """The .toml file, as it is written."""

    model_config = ConfigDict(extra="forbid")

    name: str
    description: str = ""
    mesh: str | None = None
    diameter_m: Annotated[FiniteFloat, Field(gt=0)]
    keypoint: Annotated[list[_Keypoint], Field(min_length=4)]
    edges: list[tuple[str, str]]
    symmetry: list[Symmetry] = []


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
        GknetError: Shapes do not agree, names repeat, or an edge has no keypoint.
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
        points = np.array(self.points_m, dtype=np.float64)
        points.setflags(write=False)
        object.__setattr__(self, "points_m", points)
        count = len(self.keypoint_names)
        if points.shape != (count, 3) or not np.isfinite(points).all():
            raise GknetError(
                f"{self.name}: expected {count} finite keypoints of shape ({count}, 3), got {points.shape}"
            )
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
    """The largest distance between two of the points."""
    from scipy.spatial import ConvexHull

    hull = points_m[ConvexHull(points_m).vertices]
    return float(max(np.linalg.norm(a - b) for a, b in combinations(hull, 2)))


def load_spacecraft(path: str | Path) -> Spacecraft:
    """Read a spacecraft's .toml.

    Args:
        path: The file; the mesh that it names is expected beside it.

    Raises:
        GknetError: The file cannot be read, is no valid TOML, or describes no spacecraft.
    """
    path = Path(path)
    return spacecraft_from_toml(read_text(path), str(path), path.parent)


def spacecraft_from_toml(text: str, source: str, folder: Path | None = None) -> Spacecraft:
    """Parse the text of a spacecraft's .toml. Errors name `source`; without a mesh's `folder` there is no mesh."""
    file: _File = validated(_File, parse_toml(text, source), source)
    index = {keypoint.name: k for k, keypoint in enumerate(file.keypoint)}
    for edge in file.edges:
        for end in edge:
            if end not in index:
                raise GknetError(f"{source}: edges: '{end}' is no keypoint; expected one of {', '.join(index)}")
    try:
        return Spacecraft(
            name=file.name,
            keypoint_names=tuple(keypoint.name for keypoint in file.keypoint),
            points_m=np.array([keypoint.point_m for keypoint in file.keypoint]),
            edges=tuple((index[a], index[b]) for a, b in file.edges),
            diameter_m=file.diameter_m,
            symmetries=tuple(file.symmetry),
            mesh_path=folder / file.mesh if folder is not None and file.mesh else None,
            description=file.description,
        )
    except GknetError as error:
        raise GknetError(f"{source}: {error}") from error


def _quoted(text: str) -> str:
    """A TOML basic string: JSON's escapes are among TOML's, and the delete character must be escaped too."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def spacecraft_toml(spacecraft: Spacecraft) -> str:
    """The text of a spacecraft's .toml, keypoints to a tenth of a millimetre."""
    names = spacecraft.keypoint_names
    lines = [f"name = {_quoted(spacecraft.name)}", f"description = {_quoted(spacecraft.description)}"]
    if spacecraft.mesh_path is not None:
        lines.append(f"mesh = {_quoted(spacecraft.mesh_path.name)}")
    lines.append(f"diameter_m = {spacecraft.diameter_m:.4f}")
    lines.append("edges = [")
    lines += [f"  [{_quoted(names[i])}, {_quoted(names[j])}]," for i, j in spacecraft.edges]
    lines.append("]")
    for name, point in zip(names, spacecraft.points_m, strict=True):
        coordinates = ", ".join(f"{value + 0.0:.4f}" for value in np.round(point, 4) + 0.0)
        lines += ["", "[[keypoint]]", f"name = {_quoted(name)}", f"point_m = [{coordinates}]"]
    for symmetry in spacecraft.symmetries:
        axis = ", ".join(f"{value:g}" for value in symmetry.axis)
        lines += ["", "[[symmetry]]", f"axis = [{axis}]", f"angle_deg = {symmetry.angle_deg:g}"]
        lines += [f"exact = {str(symmetry.exact).lower()}", f"broken_by = {_quoted(symmetry.broken_by)}"]
    return "\n".join(lines) + "\n"


def save_spacecraft(spacecraft: Spacecraft, path: str | Path) -> None:
    write_text(path, spacecraft_toml(spacecraft))
