"""A spacecraft's GLB: its triangles in the body frame, in metres, and their glTF materials.

Parts that share a material become one: Mitsuba traces the code of every shape and material for every frame.
"""

from __future__ import annotations

import io
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from gknet.errors import GknetError, MissingExtraError
from gknet.spacecraft import Spacecraft, diameter

LIMIT_BYTES = 512 << 20
"""A larger GLB is refused before it is read."""

SCALE_TOLERANCE = 0.01
"""The mesh's diameter may differ from `diameter_m` by this part of it."""

KEYPOINT_MARGIN = 0.05
"""A keypoint may lie outside of the mesh's bounding box by this part of the diameter."""

UNITS_PER_METRE = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 1 / 0.0254, "feet": 1 / 0.3048}

SMALLEST_ROUGHNESS = 0.1
"""A mirror shows the sun's half-degree disc; under a directional sun this roughness spreads the glint as much."""

BARE_COLOUR = (0.55, 0.55, 0.55)
"""Linear base colour of a mesh that comes without any material: grey paint."""


@dataclass(frozen=True, eq=False)
class GltfMaterial:
    """glTF's metallic-roughness material. Textures are float32 arrays of linear values, row 0 on top.

    Attributes:
        base_colour: (3,), or a texture (h, w, 3); None when the colour is on the vertices.
        metallic: A number, or a texture (h, w, 1).
        roughness: A number, or a texture (h, w, 1).
        normal: A tangent-space normal map (h, w, 3) in 0..1; None when the part is smooth.
    """

    base_colour: Float[ndarray, "..."] | None
    metallic: float | Float[ndarray, "h w 1"]
    roughness: float | Float[ndarray, "h w 1"]
    normal: Float[ndarray, "h w 3"] | None = None


@dataclass(frozen=True, eq=False)
class MeshPart:
    """The triangles of one material.

    Attributes:
        vertices_m: (v, 3) in the body frame, in m.
        faces: (f, 3) indices of vertices, counter-clockwise from outside.
        normals: (v, 3) unit vectors in the body frame; None for flat shading.
        uv: (v, 2) texture coordinates with the origin at the texture's top left, as in glTF; None without textures.
        colours: (v, 3) linear RGB of the vertices; None when the material has the colour.
        material: Shared by all triangles.
    """

    vertices_m: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]
    normals: Float[ndarray, "v 3"] | None
    uv: Float[ndarray, "v 2"] | None
    colours: Float[ndarray, "v 3"] | None
    material: GltfMaterial


def load_mesh(spacecraft: Spacecraft) -> list[MeshPart]:
    """The mesh of a spacecraft, in metres in the body frame, one part for each material.

    Raises:
        GknetError: There is no mesh, it cannot be read (see `read_glb`), or its scale is wrong (see `check_scale`).
    """
    if spacecraft.mesh_path is None:
        raise GknetError(f"{spacecraft.name}: it has no mesh to render; build one with `gknet fleet FOLDER`")
    parts = read_glb(spacecraft.mesh_path)
    check_scale(spacecraft, parts)
    return parts


def read_glb(path: Path) -> list[MeshPart]:
    """The parts of a GLB, node transforms applied.

    Args:
        path: A GLB file that holds its buffers and its images itself; links to other files are not followed.

    Returns:
        One part for each material, in metres, in the frame of the GLB's scene, which is the body frame.

    Raises:
        GknetError: The file is absent, is no GLB, is larger than `LIMIT_BYTES`, or holds no triangle.
        MissingExtraError: trimesh is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("render", "trimesh") from error
    data = _read(path)
    parts: dict[tuple[int, bool, bool, bool], list[MeshPart]] = defaultdict(list)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        for node in scene.graph.nodes_geometry:
            body_from_node, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                part = _part(mesh, np.asarray(body_from_node))
                source = getattr(mesh.visual, "material", None)
                key = (id(source), part.normals is None, part.uv is None, part.colours is None)
                parts[key].append(part)
    except Exception as error:  # trimesh, and the parsers below it, raise whatever they stumble on
        raise GknetError(f"{path}: not a readable mesh, expected a GLB ({type(error).__name__}: {error})") from error
    if not parts:
        raise GknetError(f"{path}: expected a mesh with triangles, found none")
    merged = [_merged(group) for group in parts.values()]
    if not all(np.isfinite(part.vertices_m).all() for part in merged):
        raise GknetError(f"{path}: the mesh has vertices that are NaN or infinite; export it again")
    return merged


def _read(path: Path) -> bytes:
    if path.suffix.lower() != ".glb":
        raise GknetError(f"{path}: expected a mesh as .glb; export it as binary glTF 2.0, in metres")
    if not path.is_file():
        raise GknetError(f"{path}: no such mesh; build it with `gknet fleet FOLDER` or correct the spacecraft's 'mesh'")
    try:
        size = path.stat().st_size
        if size > LIMIT_BYTES:
            raise GknetError(f"{path}: expected a mesh of {LIMIT_BYTES >> 20} MiB at most, got {size >> 20} MiB")
        return path.read_bytes()
    except OSError as error:
        raise GknetError(f"{path}: the mesh cannot be read ({error.strerror})") from error


def check_scale(spacecraft: Spacecraft, parts: list[MeshPart]) -> None:
    """Hold a mesh against the diameter and the keypoints of its spacecraft.

    Args:
        spacecraft: Its `diameter_m` and its keypoints are compared with the mesh.
        parts: The mesh.

    Raises:
        GknetError: The largest distance between two vertices is not `diameter_m`, or a keypoint lies far outside of
            the mesh's bounding box.
    """
    vertices = np.concatenate([part.vertices_m for part in parts])
    extent, declared = diameter(vertices), spacecraft.diameter_m
    if abs(extent / declared - 1) > SCALE_TOLERANCE:
        raise GknetError(
            f"{spacecraft.mesh_path}: the mesh is {extent:.6g} across, but {spacecraft.name} has diameter_m = "
            f"{declared:.6g}; {_remedy(extent / declared, extent)}"
        )
    outside = np.maximum(vertices.min(axis=0) - spacecraft.points_m, spacecraft.points_m - vertices.max(axis=0))
    distance = np.linalg.norm(np.maximum(outside, 0), axis=1)
    k = int(distance.argmax())
    if distance[k] > KEYPOINT_MARGIN * declared:
        raise GknetError(
            f"{spacecraft.mesh_path}: keypoint '{spacecraft.keypoint_names[k]}' of {spacecraft.name} lies "
            f"{distance[k]:.3g} m outside of the mesh; give the keypoints in metres in the mesh's own frame"
        )


def _remedy(ratio: float, extent: float) -> str:
    for unit, per_metre in UNITS_PER_METRE.items():
        if abs(ratio / per_metre - 1) <= SCALE_TOLERANCE:
            return f"is the mesh in {unit}? export it in metres"
        if abs(ratio * per_metre - 1) <= SCALE_TOLERANCE:
            return f"are diameter_m and the keypoints in {unit}? give them in metres"
    return f"export the mesh in metres, or give diameter_m = {extent:.4f}"


def _part(mesh: Any, body_from_node: Float[ndarray, "4 4"]) -> MeshPart:
    linear = body_from_node[:3, :3]
    faces = np.asarray(mesh.faces)
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    normals = None
    # glTF: a mesh without normals is flat-shaded; trimesh would answer with averaged ones of its own.
    if "vertex_normals" in mesh._cache.cache:
        normals = _unit(np.asarray(mesh.vertex_normals) @ np.linalg.inv(linear))
    uv = getattr(mesh.visual, "uv", None)
    if uv is not None:
        uv = np.asarray(uv, dtype=np.float64) * (1, -1) + (0, 1)  # trimesh puts the origin at the bottom
    colours = None
    if mesh.visual.kind in ("vertex", "face"):
        colours = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
    vertices = np.asarray(mesh.vertices) @ linear.T + body_from_node[:3, 3]
    return MeshPart(vertices, faces, normals, uv, colours, _material(mesh, colours is not None, uv is not None))


def _merged(parts: list[MeshPart]) -> MeshPart:
    first = parts[0]
    offsets = np.cumsum([0] + [len(part.vertices_m) for part in parts[:-1]])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])

    def joined(field: str) -> ndarray | None:
        arrays = [getattr(part, field) for part in parts]
        return None if arrays[0] is None else np.concatenate(arrays)

    vertices = np.concatenate([part.vertices_m for part in parts])
    return MeshPart(vertices, faces, joined("normals"), joined("uv"), joined("colours"), first.material)


def _material(mesh: Any, coloured: bool, mapped: bool) -> GltfMaterial:
    source = getattr(mesh.visual, "material", None)
    if source is None:
        return GltfMaterial(None if coloured else np.array(BARE_COLOUR), 0.0, 0.5)
    if not hasattr(source, "metallicFactor"):
        source = source.to_pbr()
    factor = np.ones(3) if source.baseColorFactor is None else np.asarray(source.baseColorFactor)[:3] / 255.0
    base_colour = factor
    if mapped and source.baseColorTexture is not None:
        base_colour = (linear_from_srgb(_pixels(source.baseColorTexture)) * factor).astype(np.float32)
    metallic: float | ndarray = 1.0 if source.metallicFactor is None else float(source.metallicFactor)
    roughness: float | ndarray = 1.0 if source.roughnessFactor is None else float(source.roughnessFactor)
    if mapped and source.metallicRoughnessTexture is not None:
        data = _pixels(source.metallicRoughnessTexture).astype(np.float32) / 255
        metallic, roughness = data[..., 2:3] * np.float32(metallic), data[..., 1:2] * np.float32(roughness)
    normal = None
    if mapped and source.normalTexture is not None:
        normal = _pixels(source.normalTexture).astype(np.float32) / 255
    return GltfMaterial(base_colour, metallic, np.maximum(roughness, SMALLEST_ROUGHNESS), normal)


def _pixels(image: Any) -> UInt8[ndarray, "h w 3"]:
    return np.asarray(image.convert("RGB"))


def _unit(vectors: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def linear_from_srgb(values: UInt8[ndarray, "*n"]) -> Float[ndarray, "*n"]:
    """Linear light, 0 to 1, of 8-bit sRGB values (IEC 61966-2-1)."""
    level = np.arange(256) / 255
    table = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[values]
