"""Parts of a mesh as Mitsuba shapes whose BSDFs follow glTF's metallic-roughness materials."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.render.mesh import GltfMaterial, MeshPart


def build_shapes(mi: ModuleType, parts: list[MeshPart]) -> dict[str, Any]:
    """Mitsuba meshes of the active variant by name, ready for `mi.load_dict`."""
    return {f"part_{k}": _shape(mi, f"part_{k}", part) for k, part in enumerate(parts)}


def _shape(mi: ModuleType, name: str, part: MeshPart) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_bsdf(mi, part.material))
    if part.normals is None:
        properties["face_normals"] = True
    mesh = mi.Mesh(
        name,
        len(part.vertices_m),
        len(part.faces),
        has_vertex_normals=part.normals is not None,
        has_vertex_texcoords=part.uv is not None,
        props=properties,
    )
    if part.colours is not None:
        mesh.add_attribute("vertex_color", 3, part.colours.astype(np.float32).ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = part.vertices_m.astype(np.float32).ravel()
    parameters["faces"] = part.faces.astype(np.uint32).ravel()
    if part.normals is not None:
        parameters["vertex_normals"] = part.normals.astype(np.float32).ravel()
    if part.uv is not None:
        parameters["vertex_texcoords"] = part.uv.astype(np.float32).ravel()
    parameters.update()
    return mesh


def _bsdf(mi: ModuleType, material: GltfMaterial) -> dict[str, Any]:
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
