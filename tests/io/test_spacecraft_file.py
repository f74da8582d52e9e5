"""A spacecraft's .toml: the round trip, and files that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.io.spacecraft_file import load_spacecraft, save_spacecraft, spacecraft_from_toml, spacecraft_toml
from gknet.spacecraft import Spacecraft, Symmetry

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


def written(folder: Path, text: str) -> Path:
    path = folder / "probe.toml"
    path.write_text(text, encoding="utf-8")
    return path


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
    save_spacecraft(spacecraft_from_toml(GOOD, "good"), tmp_path / "probe.toml")
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
        (("[0, 1, 0]", "[0, 1e308, 0]"), "within 100000 m"),
        (("diameter_m = 2.0", "diameter_m = 1e300"), "diameter_m"),
        (("diameter_m = 2.0", f"diameter_m = {'9' * 401}"), "64 bits"),
        (("diameter_m = 2.0", f"diameter_m = {'9' * 5000}"), "too many digits"),
        (('["a", "b"]', "[" * 5000), "nested too deeply|TOML"),
        (("diameter_m = 2.0", 'diameter_m = 2.0\nmesh = "../other.glb"'), "mesh"),
        (("diameter_m = 2.0", 'diameter_m = 2.0\nmesh = "/etc/passwd"'), "mesh"),
        (("diameter_m = 2.0", 'diameter_m = 2.0\nmesh = "probe.exe"'), "mesh"),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
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


def test_a_byte_order_mark_is_no_matter(tmp_path: Path) -> None:
    path = tmp_path / "probe.toml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.encode())
    assert load_spacecraft(path).name == "probe"


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
