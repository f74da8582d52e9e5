"""The recipes keep their word: limits hold on every frame, and a frame depends on its number alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.geometry import Pose
from gknet.render.recipe import RECIPES, Recipe, load_recipe
from gknet.render.scenario import CAMERA, EARTH_RADIUS_M, Shot, shoot
from gknet.render.sequence import SequenceMotion, sample_sequence
from gknet.spacecraft import Spacecraft

SKD, HARD = RECIPES["skd"], RECIPES["skd-hard"]


def winged(name: str) -> Spacecraft:
    """A box, two wings and a mast: 14 keypoints, 8 m across."""
    corners = [(x, y, z) for x in (-0.8, 0.8) for y in (-0.8, 0.8) for z in (-1.2, 1.2)]
    wings = [(x, y, 0.1) for x in (-4.0, 4.0) for y in (-0.6, 0.6)]
    points = np.array([*corners, *wings, (0, 0, 2.2), (0, 1.5, 1.4)])
    return Spacecraft(name, tuple(f"k{i}" for i in range(len(points))), points, ((0, 1),), 8.2)


FLEET = {name: winged(name) for name in SKD.spacecraft}


def solved(recipe: Recipe, sequence: int) -> SequenceMotion:
    return sample_sequence(recipe, FLEET[recipe.spacecraft_of(sequence)], 0, sequence)


def pixels(motion: SequenceMotion, points_m: np.ndarray) -> np.ndarray:
    """(t, n, 2): the keypoints of all frames."""
    points = points_m @ motion.cam_from_body.transpose(0, 2, 1) + motion.body_cam_m[:, None]
    assert points[..., 2].min() > 0
    return points[..., :2] / points[..., 2:] * 1400 + 512


def test_pixels_are_those_of_the_shot() -> None:
    shot = shoot(SKD, FLEET["satellite_01"], 0, 0, 123)
    points = FLEET["satellite_01"].points_m
    projected = shot.camera.project(shot.cam_from_body.transform(points))
    np.testing.assert_allclose(pixels(solved(SKD, 0), points)[123], projected, atol=1e-6)


@pytest.fixture(scope="module")
def skd() -> list[SequenceMotion]:
    return [solved(SKD, sequence) for sequence in range(45)]


def test_split_is_three_to_one_to_one_for_each_spacecraft() -> None:
    counts: dict[tuple[str, str], int] = {}
    for sequence in range(300):
        key = SKD.spacecraft_of(sequence), SKD.split_of(sequence)
        counts[key] = counts.get(key, 0) + 1
    assert counts == {(name, s): k for name in SKD.spacecraft for s, k in (("train", 60), ("val", 20), ("test", 20))}


def test_skd_limits_hold_on_every_frame(skd: list[SequenceMotion]) -> None:
    points = FLEET["satellite_01"].points_m
    spans = []
    for motion in skd:
        at = pixels(motion, points)
        inside = np.all((at >= 0) & (at <= 1024), axis=2)
        spans.append(np.ptp(at, axis=1).max(axis=1) / 1024)
        assert inside.all(axis=1).mean() >= 0.9
        assert inside.sum(axis=1).min() >= len(points) / 2
        assert np.degrees(motion.phase_rad).max() <= 130
    assert np.min(spans) >= 0.08
    assert np.max(spans) <= 0.9
    assert np.min(spans) < 0.12
    assert np.max(spans) > 0.7


def test_skd_spreads_phase_angle_earth_and_attitude(skd: list[SequenceMotion]) -> None:
    phase = np.degrees([motion.phase_rad.mean() for motion in skd])
    assert (np.histogram(phase, bins=4, range=(0, 130))[0] >= 5).all()
    earth = np.array([motion.earth_in_view.mean() for motion in skd])
    assert ((earth == 0) | (earth >= 0.9)).all()
    assert 0.22 <= (earth > 0).mean() <= 0.45
    axes = np.concatenate([motion.cam_from_body[::10, :, 2] for motion in skd])
    octants = np.unique((axes > 0) @ (1, 2, 4), return_counts=True)[1] / len(axes)
    assert len(octants) == 8
    assert octants.min() > 0.06


def test_neighbouring_frames_differ_a_little(skd: list[SequenceMotion]) -> None:
    for motion in skd:
        step = np.einsum("tij,tij->t", motion.cam_from_body[1:], motion.cam_from_body[:-1])
        turn_deg = np.degrees(np.arccos(np.clip((step - 1) / 2, -1, 1)))
        assert 0.2 < turn_deg.mean() < 13
        assert turn_deg.max() < 25
        moved = np.linalg.norm(np.diff(motion.body_cam_m, axis=0), axis=1) / np.linalg.norm(
            motion.body_cam_m[1:], axis=1
        )
        assert moved.max() < 0.1


def test_an_approach_moves_through_much_of_the_range(skd: list[SequenceMotion]) -> None:
    ratios = [np.ptp(np.log(np.linalg.norm(m.body_cam_m, axis=1))) for m in skd if m.spec.kind == "approach"]
    assert len(ratios) >= 10
    assert np.exp(np.median(ratios)) > 2.5


def test_hard_recipe_goes_where_skd_does_not() -> None:
    points = FLEET["satellite_01"].points_m
    motions = [solved(HARD, sequence) for sequence in range(30)]
    at = [pixels(motion, points) for motion in motions]
    inside = np.stack([((p >= 0) & (p <= 1024)).all(axis=2).sum(axis=1) for p in at])
    spans = np.stack([np.ptp(p, axis=1).max(axis=1) / 1024 for p in at])
    assert inside.min() >= 6
    assert spans.max() <= 1.6
    assert spans.max() > 1.2
    assert 0.1 < (inside < len(points)).mean() < 0.7, "a good part of the frames is truncated"
    phase = np.degrees([motion.phase_rad for motion in motions])
    assert 150 < phase.max() <= 165
    assert sum(motion.spec.scene == "earth_fills" for motion in motions) >= 5


@pytest.mark.parametrize("sequence", [0, 7, 31])
def test_sun_and_earth_hold_together(sequence: int) -> None:
    motion = solved(SKD, sequence)
    sun = np.einsum("tji,tj->ti", motion.cam_from_inertial, motion.sun_direction)
    np.testing.assert_allclose(sun, np.broadcast_to(sun[0], sun.shape), atol=1e-9)
    distance = np.linalg.norm(motion.earth_centre_cam_m, axis=1) - EARTH_RADIUS_M
    assert 398e3 < distance.min() <= distance.max() < 1202e3
    to_craft = np.einsum("tji,tj->ti", motion.cam_from_inertial, motion.body_cam_m - motion.earth_centre_cam_m)
    height = to_craft @ sun[0]
    beside = np.sqrt((to_craft**2).sum(axis=1) - height**2)
    assert ((height > 0) | (beside > 0.999 * EARTH_RADIUS_M)).all(), "not in the Earth's shadow"
    north = np.einsum("tji,tj->ti", motion.cam_from_inertial, motion.cam_from_earth[:, :, 2])
    np.testing.assert_allclose(north, np.broadcast_to([0.0, 0, 1], north.shape), atol=1e-9)


def as_values(shot: Shot) -> list[object]:
    """A shot as plain values, to compare."""
    flat: list[object] = []
    for field in dataclasses.fields(shot):
        value = getattr(shot, field.name)
        if isinstance(value, Pose):
            value = np.concatenate([value.rotation.ravel(), value.translation_m])
        flat.append(value.tobytes() if isinstance(value, np.ndarray) else value)
    return [value for value in flat if isinstance(value, (str, int, float, bytes)) or dataclasses.is_dataclass(value)]


def comparable(shot: Shot) -> list[object]:
    keep = dataclasses.replace(shot, earth=None, planet=None, camera=CAMERA)
    return [value for value in as_values(keep) if value is not CAMERA]


def test_random_access_equals_sequential() -> None:
    craft = FLEET["satellite_02"]
    forward = [comparable(shoot(SKD, craft, 0, 4, index)) for index in (0, 50, 299)]
    sample_sequence.cache_clear()
    shoot(SKD, FLEET["satellite_01"], 0, 3, 10)
    backward = [comparable(shoot(SKD, craft, 0, 4, index)) for index in (299, 50, 0)]
    assert forward == backward[::-1]


def test_seed_sequence_and_frame_all_matter() -> None:
    craft = FLEET["satellite_02"]
    base = shoot(SKD, craft, 0, 4, 5)
    others = [shoot(SKD, craft, 1, 4, 5), shoot(SKD, craft, 0, 7, 5), shoot(SKD, craft, 0, 4, 6)]
    for other in others:
        assert base.cam_from_body.angle_to(other.cam_from_body) > 1e-3
        assert base.seed != other.seed


def test_a_shot_of_a_frame_is_complete() -> None:
    shot = shoot(SKD, FLEET["satellite_01"], 0, 0, 17)
    assert (shot.recipe, shot.spacecraft, shot.sequence, shot.index) == ("skd", "satellite_01", 0, 17)
    assert np.linalg.norm(shot.sun_direction) == pytest.approx(1)
    assert shot.time_s > 0
    assert shot.sensor.exposure > 0
    assert shot.planet is not None
    assert (shot.earth is not None) == bool(solved(SKD, 0).earth_in_view[17])


def test_out_of_range_is_refused() -> None:
    with pytest.raises(GknetError, match="sequence"):
        shoot(SKD, FLEET["satellite_01"], 0, 300, 0)
    with pytest.raises(GknetError, match="frame"):
        shoot(SKD, FLEET["satellite_01"], 0, 0, 300)
    with pytest.raises(GknetError, match="sequence"):
        SKD.split_of(-1)


def test_limits_that_nothing_obeys_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gknet.render.sequence._ATTEMPTS", 20)
    motion = SKD.motion.model_copy(update={"span": (0.5, 0.501)})
    with pytest.raises(GknetError, match="obeys its limits"):
        sample_sequence(SKD.model_copy(update={"motion": motion, "name": "narrow"}), FLEET["satellite_01"], 0, 0)


def test_recipe_file_round_trip_and_bad_ones(tmp_path: Path) -> None:
    import gknet.render.recipe as module

    text = (Path(module.__file__).parent / "recipes" / "skd.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(text)
    assert load_recipe(path) == SKD
    assert hash(load_recipe(path)) == hash(SKD)
    for old, new, word in (
        ("frames = 300", "frames = 300\nframe = 3", "frame"),
        ("span = [0.08, 0.90]", "span = [0.9, 0.08]", "span"),
        ("hold = 0.3", "hold = nan", "hold"),
        ("[motion]", "[motion", "TOML"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(GknetError, match=word):
            load_recipe(path)
    with pytest.raises(GknetError, match="skd"):
        load_recipe("no-such-recipe")
