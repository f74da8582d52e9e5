"""GLB files for tests, written byte by byte so that glTF's own conventions are what is tested."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray


def png(image: ndarray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "png")
    return stream.getvalue()


class Glb:
    """A small glTF 2.0 file in the making."""

    def __init__(self) -> None:
        self.binary = b""
        self.json: dict[str, list] = {
            name: [] for name in ("accessors", "bufferViews", "images", "textures", "materials", "meshes", "nodes")
        }

    def _view(self, data: bytes) -> int:
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data + b"\0" * (-len(data) % 4)
        return len(self.json["bufferViews"]) - 1

    def _accessor(self, values: ndarray, kind: str) -> int:
        component = {"f": 5126, "u": 5125}[values.dtype.kind]
        entry = {"bufferView": self._view(values.tobytes()), "componentType": component, "count": len(values)}
        extra = {"type": kind}
        if kind == "VEC3":
            extra |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.json["accessors"].append(entry | extra)
        return len(self.json["accessors"]) - 1

    def texture(self, image: ndarray) -> dict[str, int]:
        self.json["images"].append({"bufferView": self._view(png(image)), "mimeType": "image/png"})
        self.json["textures"].append({"source": len(self.json["images"]) - 1})
        return {"index": len(self.json["textures"]) - 1}

    def mesh(
        self,
        vertices: ndarray,
        faces: ndarray,
        material: dict | None = None,
        matrix: ndarray | None = None,
        **attributes: ndarray,
    ) -> Glb:
        """Attributes by glTF's names: NORMAL, TEXCOORD_0, COLOR_0."""
        kinds = {"TEXCOORD_0": "VEC2"}
        named = {"POSITION": vertices, **attributes}
        accessors = {
            name: self._accessor(np.asarray(values, dtype=np.float32), kinds.get(name, "VEC3"))
            for name, values in named.items()
        }
        primitive = {
            "attributes": accessors,
            "indices": self._accessor(np.asarray(faces, dtype=np.uint32).ravel(), "SCALAR"),
        }
        if material is not None:
            self.json["materials"].append(material)
            primitive["material"] = len(self.json["materials"]) - 1
        self.json["meshes"].append({"primitives": [primitive]})
        node: dict[str, object] = {"mesh": len(self.json["meshes"]) - 1}
        if matrix is not None:
            node["matrix"] = np.asarray(matrix, dtype=float).T.ravel().tolist()
        self.json["nodes"].append(node)
        return self

    def write(self, path: Path) -> Path:
        document: dict[str, Any] = {key: value for key, value in self.json.items() if value}
        document |= {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": len(self.binary)}],
            "scenes": [{"nodes": list(range(len(self.json["nodes"])))}],
            "scene": 0,
        }
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
        return path


BOX_FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4]]
    + [[2, 3, 7], [2, 7, 6], [1, 2, 6], [1, 6, 5], [0, 4, 7], [0, 7, 3]]
)


def box(size: tuple[float, float, float]) -> tuple[ndarray, ndarray]:
    """Vertices and outward faces of a box about the origin, flat-shaded (corners not shared)."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.array([(x, y, z) for z in (-1, 1) for x, y in signs]) * np.array(size) / 2
    return corners[BOX_FACES].reshape(-1, 3), np.arange(3 * len(BOX_FACES)).reshape(-1, 3)


QUAD = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
"""In the body's xy plane, facing +z, counter-clockwise."""
QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]])
QUAD_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=float)
"""The texture upright when +y is up: glTF's v runs down."""
