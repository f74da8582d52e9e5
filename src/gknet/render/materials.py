"""A GLB's geometry and glTF materials as Mitsuba shapes, in the body frame and in metres.

Parts that share a material become one shape: Mitsuba traces the code of every shape and material for every frame.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from gknet.errors import GknetError, MissingExtraError

SMALLEST_ROUGHNESS = 0.1
"""A mirror shows the sun's half-degree disc; under a directional sun this roughness spreads the glint as much."""

BARE_COLOUR = (0.55, 0.55, 0.55)
"""Linear base colour of a mesh that comes without any material: grey paint."""


@dataclass(frozen=True, eq=False)
class Material:
    """glTF's metallic-roughness material. Textures are (h, w, c) float32, row 0 on top, linear values.

    base_colour         (3,) or a texture (h, w, 3); None when the colour sits on the vertices
    metallic, roughness a number or a texture (h, w, 1)
    normal              a tangent-space map (h, w, 3) in 0..1, None when the surface is smooth
    """

    base_colour: Float[ndarray, "..."] | None
    metallic: float | Float[ndarray, "h w 1"]
    roughness: float | Float[ndarray, "h w 1"]
    normal: Float[ndarray, "h w 3"] | None = None


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one material in the body frame. `uv` has its origin at the top left of the texture, as in glTF."""

    vertices_m: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]
    normals: Float[ndarray, "v 3"] | None
    uv: Float[ndarray, "v 2"] | None
    colours: Float[ndarray, "v 3"] | None
    material: Material


def read_glb(path: Path) -> list[Surface]:
    """The surfaces of a GLB, node transforms applied, one for each material; GknetError when there are none."""
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("render", "trimesh") from error
    if not path.is_file():
        raise GknetError(f"{path}: no such mesh; build it with `gknet fleet FOLDER` or correct the spacecraft's 'mesh'")
    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh raises whatever its parsers stumble on
        raise GknetError(f"{path}: not a readable mesh, expected a GLB ({type(error).__name__}: {error})") from error
    parts: dict[tuple[int, bool, bool, bool], list[Surface]] = defaultdict(list)
    for node in scene.graph.nodes_geometry:
        body_from_node, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            part = _part(mesh, np.asarray(body_from_node))
            source = getattr(mesh.visual, "material", None)
            key = (id(source), part.normals is None, part.uv is None, part.colours is None)
            parts[key].append(part)
    if not parts:
        raise GknetError(f"{path}: expected a mesh with triangles, found none")
    surfaces = [_merged(group) for group in parts.values()]
    if not all(np.isfinite(surface.vertices_m).all() for surface in surfaces):
        raise GknetError(f"{path}: the mesh has vertices that are NaN or infinite; export it again")
    return surfaces


def _part(mesh: Any, body_from_node: Float[ndarray, "4 4"]) -> Surface:
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
    return Surface(vertices, faces, normals, uv, colours, _material(mesh, colours is not None, uv is not None))


def _merged(parts: list[Surface]) -> Surface:
    first = parts[0]
    offsets = np.cumsum([0] + [len(part.vertices_m) for part in parts[:-1]])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])

    def joined(field: str) -> ndarray | None:
        arrays = [getattr(part, field) for part in parts]
        return None if arrays[0] is None else np.concatenate(arrays)

    vertices = np.concatenate([part.vertices_m for part in parts])
    return Surface(vertices, faces, joined("normals"), joined("uv"), joined("colours"), first.material)


def _material(mesh: Any, coloured: bool, mapped: bool) -> Material:
    source = getattr(mesh.visual, "material", None)
    if source is None:
        return Material(None if coloured else np.array(BARE_COLOUR), 0.0, 0.5)
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
    return Material(base_colour, metallic, np.maximum(roughness, SMALLEST_ROUGHNESS), normal)


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


def build_shapes(mi: ModuleType, surfaces: list[Surface]) -> dict[str, Any]:
    """Mitsuba meshes of the active variant by name, ready for `mi.load_dict`."""
    return {f"surface_{k}": _shape(mi, f"surface_{k}", surface) for k, surface in enumerate(surfaces)}


def _shape(mi: ModuleType, name: str, surface: Surface) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_bsdf(mi, surface.material))
    if surface.normals is None:
        properties["face_normals"] = True
    mesh = mi.Mesh(
        name,
        len(surface.vertices_m),
        len(surface.faces),
        has_vertex_normals=surface.normals is not None,
        has_vertex_texcoords=surface.uv is not None,
        props=properties,
    )
    if surface.colours is not None:
        mesh.add_attribute("vertex_color", 3, surface.colours.astype(np.float32).ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = surface.vertices_m.astype(np.float32).ravel()
    parameters["faces"] = surface.faces.astype(np.uint32).ravel()
    if surface.normals is not None:
        parameters["vertex_normals"] = surface.normals.astype(np.float32).ravel()
    if surface.uv is not None:
        parameters["vertex_texcoords"] = surface.uv.astype(np.float32).ravel()
    parameters.update()
    return mesh


def _bsdf(mi: ModuleType, material: Material) -> dict[str, Any]:
    principled: dict[str, Any] = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
        "metallic": _number(mi, material.metallic),
        "roughness": _number(mi, material.roughness),
    }
    if material.base_colour is not None:
        principled["base_color"] = _colour(mi, material.base_colour)
    if material.normal is not None:
        principled = {"type": "normalmap", "normalmap": _texture(mi, material.normal), "bsdf": principled}
    return {"type": "twosided", "bsdf": principled}


def _colour(mi: ModuleType, value: Float[ndarray, "..."]) -> dict[str, Any]:
    return _texture(mi, value) if value.ndim == 3 else {"type": "rgb", "value": value.tolist()}


def _number(mi: ModuleType, value: float | Float[ndarray, "h w 1"]) -> float | dict[str, Any]:
    return _texture(mi, value) if isinstance(value, np.ndarray) and value.ndim == 3 else float(value)


def _texture(mi: ModuleType, values: Float[ndarray, "h w c"]) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32)), "raw": True}
