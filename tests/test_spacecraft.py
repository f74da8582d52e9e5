"""Spacecraft: invariants, the .toml round trip, and files that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.io.spacecraft_file import load_spacecraft, save_spacecraft, spacecraft_toml
from gknet.spacecraft import Spacecraft, Symmetry, diameter

GOOD = """
name = "probe"
diameter_m = 2.0
edges = [["a", "b"], ["c", "d"]]
[[keypoint]]
name = "a"
point_m = [0, 0, 0]
[[keypoint]]
name = "b"
point_m = [1, 0, 0.5]
[[keypoint]]
name = "c"
point_m = [0, 1, 0]
[[keypoint]]
name = "d"
point_m = [0, 0, -1.25]
"""


def probe() -> Spacecraft:
    return Spacecraft("probe", ("a", "b", "c", "d"), np.eye(4, 3), ((1, 0), (0, 1), (2, 3)), 2.0)


def written(folder: Path, text: str) -> Path:
    path = folder / "probe.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_edges_are_sorted_and_single() -> None:
    assert probe().edges == ((0, 1), (2, 3))


def test_adjacency_is_symmetric_with_ones_on_the_diagonal() -> None:
    """Eq. 3."""
    adjacency = probe().adjacency
    assert (adjacency == adjacency.T).all()
    assert adjacency.diagonal().all()
    assert adjacency.sum() == 4 + 2 * 2


def test_points_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        probe().points_m[0, 0] = 9


@given(st.integers(0, 2**31), st.integers(4, 24), st.text(max_size=30))
def test_toml_round_trip(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, description: str) -> None:
    rng = np.random.default_rng(seed)
    craft = Spacecraft(
        name='od"d \\ name',
        keypoint_names=tuple(f"kp {k}" for k in range(count)),
        points_m=np.round(rng.normal(size=(count, 3)) * 5, 4),
        edges=tuple((int(i), int(j)) for i, j in rng.integers(0, count, (6, 2)) if i != j),
        diameter_m=round(float(rng.uniform(0.5, 30)), 4),
        symmetries=(Symmetry(axis=[0, 0, 1], angle_deg=180, broken_by="a mark"),),
        description=description,
    )
    path = tmp_path_factory.mktemp("craft") / "craft.toml"
    save_spacecraft(craft, path)
    back = load_spacecraft(path)
    np.testing.assert_allclose(back.points_m, craft.points_m, atol=1e-9)
    assert (back.name, back.keypoint_names, back.edges) == (craft.name, craft.keypoint_names, craft.edges)
    assert (back.diameter_m, back.symmetries, back.mesh_path) == (craft.diameter_m, craft.symmetries, None)
    assert spacecraft_toml(back) == spacecraft_toml(craft)


def test_mesh_is_looked_for_beside_the_file(tmp_path: Path) -> None:
    craft = load_spacecraft(written(tmp_path, 'mesh = "probe.glb"\n' + GOOD))
    assert craft.mesh_path == tmp_path / "probe.glb"


def test_saving_leaves_no_temporary_file(tmp_path: Path) -> None:
    save_spacecraft(probe(), tmp_path / "probe.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["probe.toml"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("diameter_m = 2.0", "diameter_m = 2.0\nmass_kg = 3"), "mass_kg"),
        (("diameter_m = 2.0", "diameter_m = nan"), "diameter_m"),
        (("diameter_m = 2.0", "diameter_m = -1"), "diameter_m"),
        (("diameter_m = 2.0\n", ""), "diameter_m"),
        (('["a", "b"]', '["a", "q"]'), "'q' is no keypoint"),
        (('["a", "b"]', '["a", "a"]'), "edge"),
        (('["a", "b"]', '["a"]'), "edges"),
        (('name = "b"', 'name = "a"'), "names must differ|'b' is no keypoint"),
        (("[0, 1, 0]", "[0, 1]"), "point_m"),
        (("[0, 1, 0]", "[0, inf, 0]"), "point_m"),
        (("[0, 1, 0]", '[0, "x", 0]'), "point_m"),
        (('name = "d"\n', ""), "keypoint.3.name"),
        (("[[keypoint]]", "[[keypoint"), "TOML"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_bad_file_is_refused_by_name(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    assert change[0] in GOOD
    path = written(tmp_path, GOOD.replace(*change, 1))
    with pytest.raises(GknetError, match=words) as caught:
        load_spacecraft(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_duplicate_names_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, GOOD.replace('name = "d"', 'name = "a"').replace('["c", "d"]', '["c", "a"]'))
    with pytest.raises(GknetError, match="names must differ"):
        load_spacecraft(path)


def test_fewer_than_four_keypoints_are_refused(tmp_path: Path) -> None:
    text = GOOD[: GOOD.rindex("[[keypoint]]")].replace(', ["c", "d"]', "")
    with pytest.raises(GknetError, match=r"keypoint.*at least 4"):
        load_spacecraft(written(tmp_path, text))


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00\x81", b""])
def test_unreadable_file_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "probe.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(GknetError, match=r"probe\.toml"):
        load_spacecraft(path)


@pytest.mark.parametrize("edge", [(0, 4), (-1, 2), (3, 3)])
def test_edge_out_of_range_is_refused(edge: tuple[int, int]) -> None:
    with pytest.raises(GknetError, match="edge"):
        Spacecraft("probe", ("a", "b", "c", "d"), np.eye(4, 3), (edge,), 2.0)


@pytest.mark.parametrize("points", [np.eye(3), np.full((4, 3), np.nan)])
def test_bad_points_are_refused(points: np.ndarray) -> None:
    with pytest.raises(GknetError, match="keypoints"):
        Spacecraft("probe", ("a", "b", "c", "d"), points, (), 2.0)


def test_diameter_is_the_largest_distance() -> None:
    points = np.random.default_rng(2).normal(size=(60, 3))
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert diameter(points) == pytest.approx(distances.max())
