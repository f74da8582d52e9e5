"""A spacecraft's .toml: its keypoints, skeleton and symmetries as text, and the name of its mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from gknet.errors import GknetError
from gknet.io.atomic import write_text
from gknet.io.text import parse_toml, quoted, read_text, validated
from gknet.spacecraft import MAX_EXTENT_M, MAX_KEYPOINTS, Spacecraft, Symmetry, Vector


class _Keypoint(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str
    point_m: Vector


class _File(BaseModel):
    """The .toml file, as it is written."""

    model_config = ConfigDict(extra="forbid")

    name: str
    description: str = ""
    mesh: Annotated[str, Field(pattern=r"^[^/\\]+\.(glb|GLB)$")] | None = None
    diameter_m: Annotated[FiniteFloat, Field(gt=0, le=MAX_EXTENT_M)]
    keypoint: Annotated[list[_Keypoint], Field(min_length=4, max_length=MAX_KEYPOINTS)]
    edges: list[tuple[str, str]]
    symmetry: list[Symmetry] = []


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
    """Parse the text of a spacecraft's .toml.

    Args:
        text: The content of the file.
        source: What errors name: a path, or words.
        folder: Where the mesh is; None leaves the mesh out.

    Raises:
        GknetError: The text is no valid TOML, or describes no spacecraft.
    """
    file: _File = validated(_File, parse_toml(text, source), source)
    index = {keypoint.name: k for k, keypoint in enumerate(file.keypoint)}
    for edge in file.edges:
        for end in edge:
            if end not in index:
                known = ", ".join(quoted(name) for name in list(index)[:8])
                raise GknetError(f"{source}: edges: {quoted(end)} is no keypoint; expected one of {known}, ...")
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


def _basic_string(text: str) -> str:
    """A TOML basic string: JSON's escapes are among TOML's, and the delete character must be escaped too."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def spacecraft_toml(spacecraft: Spacecraft) -> str:
    """The text of a spacecraft's .toml, keypoints rounded to a tenth of a millimetre."""
    names = spacecraft.keypoint_names
    lines = [f"name = {_basic_string(spacecraft.name)}", f"description = {_basic_string(spacecraft.description)}"]
    if spacecraft.mesh_path is not None:
        lines.append(f"mesh = {_basic_string(spacecraft.mesh_path.name)}")
    lines.append(f"diameter_m = {spacecraft.diameter_m:.4f}")
    lines.append("edges = [")
    lines += [f"  [{_basic_string(names[i])}, {_basic_string(names[j])}]," for i, j in spacecraft.edges]
    lines.append("]")
    for name, point in zip(names, spacecraft.points_m, strict=True):
        coordinates = ", ".join(f"{value + 0.0:.4f}" for value in np.round(point, 4) + 0.0)
        lines += ["", "[[keypoint]]", f"name = {_basic_string(name)}", f"point_m = [{coordinates}]"]
    for symmetry in spacecraft.symmetries:
        axis = ", ".join(f"{value:g}" for value in symmetry.axis)
        lines += ["", "[[symmetry]]", f"axis = [{axis}]", f"angle_deg = {symmetry.angle_deg:g}"]
        lines += [f"exact = {str(symmetry.exact).lower()}", f"broken_by = {_basic_string(symmetry.broken_by)}"]
    return "\n".join(lines) + "\n"


def save_spacecraft(spacecraft: Spacecraft, path: str | Path) -> None:
    """Write a spacecraft's .toml; its mesh is named, not copied.

    Args:
        spacecraft: What is written.
        path: The file; one of that name is replaced.
    """
    write_text(path, spacecraft_toml(spacecraft))
