"""A spacecraft under construction: parts with materials, keypoints and edges, and the GLB and .toml they end in."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
import trimesh
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import csr_matrix
from trimesh.visual import TextureVisuals

from gknet.fleet.materials import Material
from gknet.fleet.shapes import Point, joined, point_of
from gknet.io.atomic import write_bytes
from gknet.io.spacecraft_file import save_spacecraft
from gknet.spacecraft import Spacecraft, Symmetry, diameter

CREASE_RAD = np.deg2rad(35)
"""Faces that meet at less than this angle are shaded as one smooth surface."""


@dataclass
class Model:
    """A spacecraft in the making; parts are added in frames of their own and kept in the body frame, in metres.

    Attributes:
        name: Such as satellite_01.
        description: One sentence for people.
        symmetries: Rotations that leave its appearance nearly unchanged.
        parts: Meshes by (part, material).
        keypoints: (3,) points by name.
        edges: Pairs of keypoint names.
    """

    name: str
    description: str
    symmetries: tuple[Symmetry, ...] = ()
    parts: dict[tuple[str, str], list[trimesh.Trimesh]] = field(default_factory=dict)
    keypoints: dict[str, Float[ndarray, "3"]] = field(default_factory=dict)
    edges: list[tuple[str, str]] = field(default_factory=list)

    def add(
        self,
        part: str,
        material: Material,
        *solids: trimesh.Trimesh,
        at: Float[ndarray, "4 4"] | None = None,
        around: bool = False,
    ) -> None:
        """Put solids of one material on the spacecraft.

        Args:
            part: Name of the part that they belong to.
            material: Its texture is laid in the local frame.
            solids: Closed meshes in the local frame, in metres.
            at: (4, 4) body_from_local, the identity by default.
            around: Whether the texture is wrapped about the local z axis, for cylinders; otherwise it is laid flat on
                each side.
        """
        mesh = joined(*solids)
        mesh.merge_vertices()
        mesh.update_faces(mesh.nondegenerate_faces())
        placed = _finished(mesh, material, around)
        placed.apply_transform(np.eye(4) if at is None else at)
        self.parts.setdefault((part, material.name), []).append(placed)

    def mark(self, name: str, point: Point, at: Float[ndarray, "4 4"] | None = None) -> None:
        """Name a keypoint, a point of the local frame that `at` (body_from_local) places."""
        self.keypoints[name] = point_of(np.eye(4) if at is None else at, point)

    def link(self, *chain: str) -> None:
        """Edges of the skeleton along a chain of keypoints."""
        self.edges += list(pairwise(chain))

    def scene(self) -> trimesh.Scene:
        """One node a part and material, in the order of building."""
        scene = trimesh.Scene()
        for (part, material), meshes in self.parts.items():
            name = f"{part}.{material}"
            scene.add_geometry(_merged(meshes), node_name=name, geom_name=name)
        return scene

    def spacecraft(self, mesh_path: Path | None = None) -> Spacecraft:
        """What is built so far, lengths rounded to a tenth of a millimetre."""
        names = tuple(self.keypoints)
        index = {name: k for k, name in enumerate(names)}
        vertices = np.vstack([mesh.vertices for meshes in self.parts.values() for mesh in meshes])
        return Spacecraft(
            name=self.name,
            keypoint_names=names,
            points_m=np.round(np.array([self.keypoints[name] for name in names]), 4),
            edges=tuple((index[a], index[b]) for a, b in self.edges),
            diameter_m=round(diameter(vertices), 4),
            symmetries=self.symmetries,
            mesh_path=mesh_path,
            description=self.description,
        )

    def save(self, folder: Path) -> Spacecraft:
        """Write <folder>/<name>.glb and .toml."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.glb"
        write_bytes(path, self.scene().export(file_type="glb", include_normals=True))
        spacecraft = self.spacecraft(path)
        save_spacecraft(spacecraft, path.with_suffix(".toml"))
        return spacecraft


def _finished(mesh: trimesh.Trimesh, material: Material, around: bool) -> trimesh.Trimesh:
    """The mesh with texture coordinates and with normals that are smooth on curves and split at hard edges."""
    coordinates = (_wrapped if around else _flat)(mesh) / material.tile_m
    normals = _corner_normals(mesh)
    corners = np.column_stack([mesh.faces.reshape(-1, 1), np.round(normals, 4), np.round(coordinates, 5)])
    _, first, faces = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    return trimesh.Trimesh(
        vertices=mesh.vertices[mesh.faces.reshape(-1)[first]],
        faces=faces.reshape(-1, 3),
        vertex_normals=normals[first],
        visual=TextureVisuals(uv=coordinates[first], material=material.pbr),
        process=False,
    )


def _merged(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Meshes of one material as one, every vertex with its own normal and texture coordinate."""
    visuals = [cast(TextureVisuals, mesh.visual) for mesh in meshes]
    starts = np.cumsum([0, *[len(mesh.vertices) for mesh in meshes[:-1]]])
    return trimesh.Trimesh(
        vertices=np.vstack([mesh.vertices for mesh in meshes]),
        faces=np.vstack([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        vertex_normals=np.vstack([mesh.vertex_normals for mesh in meshes]),
        visual=TextureVisuals(uv=np.vstack([visual.uv for visual in visuals]), material=visuals[0].material),
        process=False,
    )


def _corner_normals(mesh: trimesh.Trimesh) -> Float[ndarray, "c 3"]:
    """A normal for each corner of each face: the mean over the faces at that vertex within the crease angle.

    Faces count by their area, so that a large flat face stays flat and its narrow rounded edge does the bending.
    """
    vertex = mesh.faces.reshape(-1)
    corner = np.arange(len(vertex))
    at_vertex = csr_matrix((np.ones(len(vertex)), (vertex, corner)))
    pairs = (at_vertex.T @ at_vertex).tocoo()
    own, weight = mesh.face_normals, np.repeat(mesh.area_faces, 3)
    smooth = np.einsum("ij,ij->i", own[pairs.row // 3], own[pairs.col // 3]) > np.cos(CREASE_RAD)
    row, column = pairs.row[smooth], pairs.col[smooth]
    gather = csr_matrix((weight[column], (row, column)), shape=pairs.shape)
    normals = gather @ np.repeat(own, 3, axis=0)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _flat(mesh: trimesh.Trimesh) -> Float[ndarray, "c 2"]:
    """Metres on the side of a box that each face points to, for each corner."""
    axis = np.argmax(np.abs(mesh.face_normals) + np.array([0, 1e-6, 2e-6]), axis=1)
    return _planar(mesh.triangles, axis, mesh.face_normals)


def _planar(
    triangles: Float[ndarray, "f 3 3"], axis: Int[ndarray, " f"], normals: Float[ndarray, "f 3"]
) -> Float[ndarray, "c 2"]:
    right, up = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
    row = np.arange(len(axis))
    mirrored = np.where(axis == 1, -1, 1) * np.sign(normals[row, axis])
    u = triangles[row[:, None], np.arange(3), right[:, None]] * mirrored[:, None]
    v = triangles[row[:, None], np.arange(3), up[:, None]]
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def _wrapped(mesh: trimesh.Trimesh) -> Float[ndarray, "c 2"]:
    """Metres around and along the z axis, for each corner; faces whose normal is near z are laid flat."""
    triangles, normals = mesh.triangles, mesh.face_normals
    angle = np.arctan2(triangles[..., 1], triangles[..., 0])
    middle = triangles.mean(axis=1)
    centre = np.arctan2(middle[:, 1], middle[:, 0])[:, None]
    angle = centre + (angle - centre + np.pi) % (2 * np.pi) - np.pi
    radius = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]).max()
    wrapped = np.stack([angle * radius, triangles[..., 2]], axis=-1)
    flat = _planar(triangles, np.full(len(triangles), 2), normals).reshape(-1, 3, 2)
    return np.where(np.abs(normals[:, 2, None, None]) > 0.8, flat, wrapped).reshape(-1, 2)
