"""Recipes: what ships is read, what is out of its range is one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from gknet.errors import GknetError
from gknet.render.recipe import RECIPE_FOLDER, RECIPES, load_recipe

SHIPPED = RECIPE_FOLDER / "skd.toml"
NAMES = '["satellite_01", "satellite_02", "satellite_03"]'


def changed(folder: Path, before: str, after: str) -> Path:
    text = SHIPPED.read_text(encoding="utf-8")
    assert before in text
    path = folder / "own.toml"
    path.write_text(text.replace(before, after), encoding="utf-8")
    return path


def test_names_need_not_ascend(tmp_path: Path) -> None:
    """Two names are a list of two, not a range."""
    recipe = load_recipe(changed(tmp_path, NAMES, '["satellite_02", "satellite_01"]'))
    assert [recipe.spacecraft_of(k) for k in range(3)] == ["satellite_02", "satellite_01", "satellite_02"]


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_bytes(b"\xef\xbb\xbf" + SHIPPED.read_bytes())
    assert load_recipe(path) == RECIPES["skd"]


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("span = [0.08, 0.90]", "span = [0.90, 0.08]", r"motion\.span: expected \[low, high\]"),
        ("phase_deg = [0.0, 130.0]", "phase_deg = [130.0, 0.0]", r"light\.phase_deg: expected \[low, high\]"),
        ("jpeg_quality = [88, 97]", "jpeg_quality = [97, 88]", r"detector\.jpeg_quality: expected \[low, high\]"),
        ("frames = 300", "frames = 100000000", "frames.*10000"),
        ("sequences = 300", "sequences = 1000000000", "sequences.*999999"),
        ("sequences = 300", f"sequences = {'9' * 401}", "64 bits"),
        ("sequences = 300", f"sequences = {'9' * 5000}", "too many digits"),
        ("sequences = 300", "sequences = -1", "sequences"),
        ("step_s = [0.5, 2.0]", "step_s = [0.5, 1e9]", r"motion\.step_s"),
        ("tumble_deg_s = [0.5, 6.0]", "tumble_deg_s = [0.5, inf]", r"motion\.tumble_deg_s"),
        ("altitude_km = [400.0, 1200.0]", "altitude_km = [400.0, 1e300]", r"light\.altitude_km"),
        ("gamma = [1.6, 2.4]", "gamma = [nan, 2.4]", r"detector\.gamma"),
        (NAMES, "[]", "spacecraft"),
        (NAMES, '["../../etc/passwd"]', "spacecraft"),
        ('name = "skd"', "name = " + 3000 * "[" + 3000 * "]", "nested too deeply"),
        ('name = "skd"', 'name = "skd"\nname = "skd"', "TOML"),
        ("[motion]", "[motion]\nspeed = 1", r"motion\.speed"),
    ],
)
def test_what_is_out_of_range_is_one_line(tmp_path: Path, before: str, after: str, words: str) -> None:
    with pytest.raises(GknetError, match=rf"own\.toml: .*{words}") as caught:
        load_recipe(changed(tmp_path, before, after))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_an_unknown_name_lists_the_known() -> None:
    with pytest.raises(GknetError, match="skd, skd-hard"):
        load_recipe("skd-easy")
