"""The fleet: what ships is what is built, and what is built keeps its promises."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from gknet import fleet
from gknet.cli.fleet import fleet as fleet_command
from gknet.errors import GknetError, MissingExtraError
from gknet.io.spacecraft_file import load_spacecraft
from gknet.spacecraft import Symmetry

NEAR_M = 0.02
names = pytest.mark.parametrize("name", fleet.NAMES)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the whole fleet."""
    for module in ("trimesh", "manifold3d", "shapely", "mapbox_earcut", "PIL"):
        pytest.importorskip(module)
    folder = tmp_path_factory.mktemp("fleet")
    for name in fleet.NAMES:
        fleet.build(name, folder)
    return folder


def triangles(folder: Path, name: str) -> np.ndarray:
    """(t, 3, 3) of all nodes, in the scene's frame."""
    import trimesh

    return trimesh.load_scene(folder / f"{name}.glb", process=False).to_mesh().triangles


def turned(points: np.ndarray, symmetry: Symmetry) -> np.ndarray:
    axis = np.array(symmetry.axis) / np.linalg.norm(symmetry.axis)
    return points @ Rotation.from_rotvec(np.deg2rad(symmetry.angle_deg) * axis).as_matrix().T


def matched(points: np.ndarray, targets: np.ndarray) -> float:
    """Part of the points that have a target near."""
    return float(np.mean(cKDTree(targets).query(points)[0] < NEAR_M))


@names
def test_keypoints_are_enough_and_apart(name: str) -> None:
    craft = fleet.load(name)
    assert craft.name == name
    assert 12 <= craft.keypoint_count <= 24
    distances = np.linalg.norm(craft.points_m[:, None] - craft.points_m[None], axis=-1)
    assert distances[~np.eye(craft.keypoint_count, dtype=bool)].min() > 0.1
    assert np.linalg.svd(craft.points_m - craft.points_m.mean(axis=0), compute_uv=False)[-1] > 0.5


@names
def test_skeleton_is_connected_and_adjacency_symmetric(name: str) -> None:
    craft = fleet.load(name)
    assert connected_components(craft.adjacency)[0] == 1
    assert np.array_equal(craft.adjacency, craft.adjacency.T)
    assert craft.adjacency.diagonal().all()
    assert len(craft.edges) >= craft.keypoint_count


@names
def test_near_symmetry_maps_most_keypoints_but_not_all(name: str) -> None:
    craft = fleet.load(name)
    assert craft.symmetries
    for symmetry in craft.symmetries:
        assert not symmetry.exact
        assert symmetry.broken_by
        assert 0.5 < matched(turned(craft.points_m, symmetry), craft.points_m) < 1


@names
def test_loading_without_mesh_knows_of_none(name: str) -> None:
    shipped = Path(fleet.__file__).parent / f"{name}.toml"
    assert fleet.load(name).mesh_path is None or shipped.with_suffix(".glb").exists()


def test_loading_needs_no_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    monkeypatch.setitem(sys.modules, "PIL", None)
    assert fleet.load("satellite_01").keypoint_count == 18


def test_building_without_the_extra_names_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for module in ("satellite_01", "fittings", "materials", "model", "shapes"):
        monkeypatch.delitem(sys.modules, f"gknet.fleet.{module}", raising=False)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(MissingExtraError, match=r"trimesh.*gknet\[render\]"):
        fleet.build("satellite_01", tmp_path)


@pytest.mark.parametrize("name", ["satellite_04", "", "../satellite_01"])
def test_unknown_name_lists_the_known(name: str, tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="satellite_01, satellite_02, satellite_03"):
        fleet.load(name)
    with pytest.raises(GknetError, match="satellite_01, satellite_02, satellite_03"):
        fleet.build(name, tmp_path)


@names
def test_shipped_file_is_what_build_writes(built: Path, name: str) -> None:
    shipped = Path(fleet.__file__).parent / f"{name}.toml"
    assert shipped.read_text(encoding="utf-8") == (built / f"{name}.toml").read_text(encoding="utf-8")


@names
def test_what_is_built_is_what_is_loaded(built: Path, name: str) -> None:
    craft, written = fleet.load(name), load_spacecraft(built / f"{name}.toml")
    assert written.mesh_path == built / f"{name}.glb"
    assert written.mesh_path.is_file()
    assert craft.keypoint_names == written.keypoint_names
    assert np.array_equal(craft.points_m, written.points_m)
    assert craft.edges == written.edges


@names
def test_mesh_has_the_size_of_a_spacecraft(built: Path, name: str) -> None:
    craft, corners = fleet.load(name), triangles(built, name)
    assert 15_000 <= len(corners) <= 100_000
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    assert 3 < np.linalg.norm(high - low) < 12
    assert np.linalg.norm(low + high) / 2 < 0.15 * craft.diameter_m
    assert (high - low).max() <= craft.diameter_m <= np.linalg.norm(high - low)
    assert (built / f"{name}.glb").stat().st_size < 8e6


@names
def test_keypoints_lie_on_the_mesh(built: Path, name: str) -> None:
    import trimesh

    corners = triangles(built, name)
    for point in fleet.load(name).points_m:
        nearest = trimesh.triangles.closest_point(corners, np.broadcast_to(point, (len(corners), 3)))
        assert np.linalg.norm(nearest - point, axis=1).min() < 0.01


@names
def test_near_symmetry_is_near_and_broken_in_the_mesh(built: Path, name: str) -> None:
    vertices = triangles(built, name).reshape(-1, 3)
    sample = vertices[::11]
    for symmetry in fleet.load(name).symmetries:
        assert 0.3 < matched(turned(sample, symmetry), vertices) < 0.985


@names
def test_parts_have_unit_normals_and_pbr_materials(built: Path, name: str) -> None:
    import trimesh

    scene = trimesh.load_scene(built / f"{name}.glb", process=False)
    kinds = set()
    for part, mesh in scene.geometry.items():
        material = mesh.visual.material
        kinds.add(material.name)
        assert isinstance(material, trimesh.visual.material.PBRMaterial), part
        assert mesh.visual.uv.shape == (len(mesh.vertices), 2), part
        assert np.allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1, atol=1e-4), part
        agreement = np.einsum("fcx,fx->fc", mesh.vertex_normals[mesh.faces], mesh.face_normals)
        assert agreement.min() > 0.5, f"{part}: a normal leaves its face by more than 60 degrees"
        for texture in (material.baseColorTexture, material.normalTexture):
            assert texture is None or max(texture.size) <= 1024, part
    assert {"gold_foil", "solar_cells", "mirror_tiles", "aluminium", "nozzle_metal", "white_paint"} <= kinds


def test_flat_faces_are_shaded_flat() -> None:
    pytest.importorskip("trimesh")
    shapes, model = (importlib.import_module(f"gknet.fleet.{module}") for module in ("shapes", "model"))
    materials = importlib.import_module("gknet.fleet.materials")
    craft = model.Model("cube", "")
    craft.add("cube", materials.aluminium(), shapes.box((1, 1, 1), radius=0.01))
    (mesh,) = craft.scene().geometry.values()
    large = mesh.area_faces > 0.1
    normals = mesh.vertex_normals[mesh.faces[large]]
    assert large.sum() == 12
    assert np.einsum("fcx,fx->fc", normals, mesh.face_normals[large]).min() > 0.999


def test_textures_keep_their_density() -> None:
    """A metre on the surface is as many tiles everywhere, on boxes and round cylinders."""
    pytest.importorskip("trimesh")
    shapes, model = (importlib.import_module(f"gknet.fleet.{module}") for module in ("shapes", "model"))
    foil = importlib.import_module("gknet.fleet.materials").gold_foil()
    for solid, around in ((shapes.box((1, 2, 0.5)), False), (shapes.cylinder(0.5, 0, 2, sections=64), True)):
        craft = model.Model("part", "")
        craft.add("part", foil, solid, around=around)
        (mesh,) = craft.scene().geometry.values()
        large = mesh.area_faces > 0.02
        first, second, third = (mesh.visual.uv[mesh.faces[large, k]] * foil.tile_m for k in range(3))
        a, b = second - first, third - first
        area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
        assert np.allclose(area, mesh.area_faces[large], rtol=0.02)


def test_command_builds_the_same_bytes_again(built: Path, tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(fleet_command)
    result = CliRunner().invoke(app, [str(tmp_path), "--name", "satellite_01"])
    assert result.exit_code == 0, result.output
    assert "18 keypoints" in result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["satellite_01.glb", "satellite_01.toml"]
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (built / path.name).read_bytes()
