"""A GLB is read within limits, and is held against what its spacecraft's file says of it."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trimesh")

from gknet.errors import GknetError
from gknet.render import mesh
from gknet.render.mesh import load_mesh, read_glb
from gknet.spacecraft import Spacecraft
from tests.render.glb import QUAD, QUAD_FACES, Glb, box

SIZE = (2.0, 1.0, 0.6)
DIAMETER_M = float(np.linalg.norm(SIZE))
CORNERS = np.unique(box(SIZE)[0], axis=0)


def craft(path: Path, points: np.ndarray = CORNERS, diameter_m: float = DIAMETER_M) -> Spacecraft:
    return Spacecraft("box", tuple(f"k{i}" for i in range(len(points))), points, (), diameter_m, mesh_path=path)


def boxed(folder: Path, scale: float = 1.0) -> Path:
    vertices, faces = box(SIZE)
    return Glb().mesh(scale * vertices, faces).write(folder / "box.glb")


def test_a_mesh_of_the_declared_size_is_taken(tmp_path: Path) -> None:
    for scale in (1.0, 0.995, 1.008):
        (part,) = load_mesh(craft(boxed(tmp_path, scale)))
        assert np.ptp(part.vertices_m, axis=0) == pytest.approx(scale * np.array(SIZE), rel=1e-6)


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1000.0, "mesh in millimetres"),
        (100.0, "mesh in centimetres"),
        (1 / 0.0254, "mesh in inches"),
        (1 / 0.3048, "mesh in feet"),
        (0.001, "keypoints in millimetres"),
        (1.02, r"diameter_m = 2\.3615"),
        (0.98, "export the mesh in metres"),
        (7.0, "export the mesh in metres"),
    ],
)
def test_a_mesh_of_another_size_is_refused_with_a_guess_of_its_unit(tmp_path: Path, scale: float, words: str) -> None:
    with pytest.raises(GknetError, match=rf"box\.glb.*diameter_m = 2\.315.*{words}") as caught:
        load_mesh(craft(boxed(tmp_path, scale)))
    assert "\n" not in str(caught.value)


def test_a_keypoint_far_off_the_mesh_is_named(tmp_path: Path) -> None:
    near, far = CORNERS.copy(), CORNERS.copy()
    near[3] += 0.04 * DIAMETER_M * np.sign(near[3]) * (1, 0, 0)
    far[5] *= 1.5
    load_mesh(craft(boxed(tmp_path), near))
    with pytest.raises(GknetError, match=r"keypoint 'k5'.*outside of the mesh.*metres"):
        load_mesh(craft(boxed(tmp_path), far))


def test_only_glb_within_the_limit_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = boxed(tmp_path)
    other = tmp_path / "box.obj"
    other.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(GknetError, match=r"box\.obj: expected a mesh as \.glb"):
        read_glb(other)
    monkeypatch.setattr(mesh, "LIMIT_BYTES", 100)
    with pytest.raises(GknetError, match=r"box\.glb: expected a mesh of 0 MiB at most"):
        read_glb(path)


def test_links_to_other_files_are_not_followed(tmp_path: Path) -> None:
    """A GLB whose vertices are in a file beside it."""
    glb = Glb().mesh(QUAD, QUAD_FACES)
    (tmp_path / "secret.bin").write_bytes(glb.binary)
    path = glb.write(tmp_path / "linked.glb")
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    document["buffers"][0]["uri"] = "secret.bin"
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<II", len(text), 0x4E4F534A) + text
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunk)) + chunk)
    with pytest.raises(GknetError, match=r"linked\.glb: not a readable mesh"):
        read_glb(path)


def test_flat_meshes_have_a_diameter(tmp_path: Path) -> None:
    path = Glb().mesh(QUAD, QUAD_FACES).write(tmp_path / "quad.glb")
    assert len(load_mesh(craft(path, QUAD, float(np.sqrt(8))))) == 1
