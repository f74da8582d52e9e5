"""The rendering stage: what is planned and written, what a resumed job does. Stand-ins make the images."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from gknet import fleet
from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.frame import Box
from gknet.geometry import Pose
from gknet.inference.crop import Crop
from gknet.io.image import read_image, read_mask
from gknet.io.spacecraft_file import save_spacecraft
from gknet.render import generate as stage
from gknet.render import worker
from gknet.render.contact_sheet import TILE_PX
from gknet.render.journal import JOURNAL, append_row
from gknet.render.options import Options, Selection, parse_shard
from gknet.render.plan import FILM_SIZES, plan_sequences, target_window
from gknet.render.recipe import Recipe, load_recipe
from gknet.render.scenario import CAMERA, Sensor, Shot
from gknet.render.scene import Rendered, Renderer
from gknet.spacecraft import Spacecraft
from tests.dataset import authors

POINTS = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0.5], [0, 0, 1]])
SENSOR = Sensor(
    psf_sigma_px=0.6,
    exposure=1.0,
    full_well_e=20000,
    read_noise_e=10,
    bloom=0.0,
    veil=0.0,
    gamma=1.0,
    monochrome=False,
    jpeg_quality=95,
)


def recipe(sequences: int = 15, frames: int = 6) -> Recipe:
    return load_recipe("skd").model_copy(update={"sequences": sequences, "frames": frames})


def shot_of(recipe: Recipe, spacecraft: Spacecraft, seed: int, sequence: int, index: int) -> Shot:
    """The craft unturned, 20 m away, moving to the right by 2 m a frame."""
    return Shot(
        recipe=recipe.name,
        spacecraft=spacecraft.name,
        sequence=sequence,
        index=index,
        time_s=float(index),
        camera=CAMERA,
        cam_from_body=Pose(np.eye(3), np.array([2.0 * index - 4, 0.5 * sequence - 2, 20.0])),
        sun_direction=np.array([0.0, 0.0, -1.0]),
        earth=None,
        cam_from_inertial=np.eye(3),
        sensor=SENSOR,
        seed=1000 * sequence + index + seed,
    )


class PaintedRenderer(Renderer):
    """Stands in for Mitsuba: a white disc of 0.3 m at each keypoint, on a craft of which all is visible."""

    def __init__(self, spacecraft: Spacecraft, variant: str, spp: int, threads: int | None) -> None:
        self.spacecraft = spacecraft

    def render(self, shot: Shot, window: Crop) -> Rendered:
        camera = shot.camera.warped(window.input_from_image, window.size, window.size)
        y, x = np.mgrid[: window.size, : window.size] + 0.5
        mask = np.zeros((window.size, window.size), dtype=bool)
        for px, py in camera.project(shot.cam_from_body.transform(self.spacecraft.points_m)):
            mask |= np.hypot(x - px, y - py) < camera.matrix[0, 0] * 0.3 / 20
        alpha = mask.astype(np.float32)
        radiance = np.repeat(alpha[..., None], 3, axis=2)
        return Rendered(radiance, alpha, mask, 20 * alpha, np.ones(len(POINTS), dtype=bool))


def black(shot: Shot, window: Crop) -> np.ndarray:
    return np.zeros((window.size, window.size, 3), dtype=np.float32)


def clip(radiance: np.ndarray, sensor: Sensor, scale: float, seed: int) -> np.ndarray:
    return (255 * np.clip(radiance, 0, 1)).astype(np.uint8)


def built(name: str, folder: Path) -> Spacecraft:
    (folder / f"{name}.glb").touch()
    craft = Spacecraft(name, tuple("abcde"), POINTS, ((0, 1), (2, 3)), 2.5, mesh_path=folder / f"{name}.glb")
    save_spacecraft(craft, folder / f"{name}.toml")
    return craft


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "Renderer", PaintedRenderer)
    monkeypatch.setattr(worker, "shoot", shot_of)
    monkeypatch.setattr(worker, "background", black)
    monkeypatch.setattr(worker, "expose", clip)
    monkeypatch.setattr(fleet, "build", built)
    monkeypatch.setattr(stage, "load_mesh", lambda spacecraft: [])


def run(out: Path, **values: Any) -> stage.Generated:
    """Render with the options, the selection and the other arguments that have these names."""
    given: dict[str, Any] = {"seed": 5, "size": 64} | values
    options = Options(**{field.name: given.pop(field.name) for field in fields(Options) if field.name in given})
    selection = Selection(**{field.name: given.pop(field.name) for field in fields(Selection) if field.name in given})
    rest: dict[str, Any] = {"recipe": recipe(), "workers": 1, "variant": "scalar_rgb"} | given
    return stage.generate(out=out, options=options, selection=selection, **rest)


def everything(root: Path) -> dict[str, bytes]:
    paths = [p for p in root.rglob("*") if p.is_file() and p.name != "contact_sheet.jpg" and p.suffix != ".pth"]
    return {str(p.relative_to(root)): p.read_bytes() for p in paths}


def test_keypoints_fall_on_their_discs(tmp_path: Path) -> None:
    """Pose, camera and image agree, for the whole sensor and for windows that leave it."""
    for window in ("frame", "target"):
        root = tmp_path / window
        run(root, window=window, size=128, mask=True, frames=6, sequences=1)
        dataset = SkdDataset(root, spacecraft="satellite_02")
        for i, frame in enumerate(dataset):
            image, mask_path = frame.image, dataset.extras(i).mask_path
            assert image is not None
            assert frame.visible is not None
            assert mask_path is not None
            pixels = frame.keypoints_px(dataset.spacecraft.points_m)
            for (x, y), visible in zip(pixels, frame.visible, strict=True):
                inside = 0 <= x < frame.camera.width and 0 <= y < frame.camera.height
                assert not (visible and not inside)
                if visible:
                    assert image[int(y), int(x)].min() > 200
            assert read_mask(mask_path).shape == image.shape[:2]
        assert (root / "contact_sheet.jpg").exists()


def test_windows_are_black_beyond_the_sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "background", lambda shot, window: black(shot, window) + 0.5)
    run(tmp_path, window="target", size=96, mask=True, sequences=1, frames=1, spacecraft=("satellite_01",))
    frame = SkdDataset(tmp_path).frame(0)
    full_from_window = CAMERA.matrix @ np.linalg.inv(frame.camera.matrix)
    y, x = np.mgrid[:96, :96] + 0.5
    full_x = full_from_window[0, 0] * x + full_from_window[0, 2]
    full_y = full_from_window[1, 1] * y + full_from_window[1, 2]
    outside = np.hypot(np.maximum(0, 8 - full_x), np.maximum(0, 8 - full_y)) > 24
    inside = (full_x > 16) & (full_y > 16)
    assert frame.image is not None
    if outside.any():
        assert frame.image[outside].max() < 40
    assert frame.image[inside].min() > 90


def test_same_seed_same_bytes_whatever_the_order(tmp_path: Path) -> None:
    run(tmp_path / "a")
    for i in (1, 0):
        run(tmp_path / "b", shard=(i, 2), every=2)
        run(tmp_path / "b", shard=(i, 2))
    assert everything(tmp_path / "a") == everything(tmp_path / "b")
    assert len(SkdDataset(tmp_path / "a")) == 15 * 6
    assert Counter(path.stem for path in tmp_path.glob("a/*.json")) == Counter(["train", "val", "test", "recipe"])


def test_a_killed_job_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(tmp_path / "whole", sequences=1)
    drawn: list[tuple[int, int]] = []
    paint = worker.render_frame

    def killed(state: worker.WorkerState, name: str, sequence: int, index: int) -> None:
        if len(drawn) == 9:
            raise KeyboardInterrupt
        drawn.append((sequence, index))
        paint(state, name, sequence, index)

    monkeypatch.setattr(worker, "render_frame", killed)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cut", sequences=1)
    assert not list(tmp_path.rglob("*.tmp"))
    journal = tmp_path / "cut/data/000002" / JOURNAL
    journal.write_text(journal.read_text()[:-30])  # the last line was cut as well
    (tmp_path / "cut/data/000001/image/000002.jpg").write_bytes(b"\xff\xd8 cut")
    monkeypatch.setattr(worker, "render_frame", paint)
    result = run(tmp_path / "cut", sequences=1)
    assert (result.kept, result.rendered) == (7, 11)
    assert 0 < result.render_seconds < result.seconds
    assert everything(tmp_path / "cut") == everything(tmp_path / "whole")
    again = run(tmp_path / "cut", sequences=1)
    assert (again.rendered, again.render_seconds) == (0, 0)


def test_a_bad_frame_is_reported_and_the_others_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paint = worker.render_frame

    def clumsy(state: worker.WorkerState, name: str, sequence: int, index: int) -> None:
        if index == 3:
            raise GknetError("no light")
        paint(state, name, sequence, index)

    monkeypatch.setattr(worker, "render_frame", clumsy)
    result = run(tmp_path, sequences=1, spacecraft=("satellite_03",))
    assert result.rendered == 5
    assert result.failures == ("data/000003 frame 3: GknetError: no light",)
    dataset = SkdDataset(tmp_path)
    assert [dataset.extras(i).index for i in range(len(dataset))] == [0, 1, 2, 4, 5]
    monkeypatch.setattr(worker, "render_frame", paint)
    assert run(tmp_path, sequences=1, spacecraft=("satellite_03",)).rendered == 1


def test_a_full_disk_ends_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(worker, "render_frame", full)
    with pytest.raises(OSError, match="No space"):
        run(tmp_path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full")
def test_a_journal_that_cannot_grow_ends_the_job_and_is_named(tmp_path: Path) -> None:
    run(tmp_path, sequences=1, frames=1)
    (tmp_path / "data/000002" / JOURNAL).symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space") as caught:
        append_row(tmp_path / "data/000002" / JOURNAL, {"frame": "1"})
    assert caught.value.filename == str(tmp_path / "data/000002" / JOURNAL)


def test_other_options_are_refused(tmp_path: Path) -> None:
    run(tmp_path, sequences=1, frames=1)
    other = recipe().model_copy(update={"frames": 7})
    for changed in ({"seed": 6}, {"size": 96}, {"window": "target"}, {"spp": 16}, {"depth": True}, {"recipe": other}):
        with pytest.raises(GknetError, match=next(iter(changed))):
            run(tmp_path, sequences=1, frames=1, **changed)
    (tmp_path / "recipe.json").write_text("{")
    with pytest.raises(GknetError, match=r"recipe.json"):
        run(tmp_path)
    (tmp_path / "recipe.json").unlink()
    with pytest.raises(GknetError, match="another folder"):
        run(tmp_path)


def test_depth_is_written_on_demand(tmp_path: Path) -> None:
    run(tmp_path, sequences=1, frames=1, depth=True)
    extras = SkdDataset(tmp_path).extras(0)
    assert extras.depth_path is not None
    assert extras.mask_path is not None
    depth = np.load(extras.depth_path)["depth_m"]
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth > 0, read_mask(extras.mask_path))


def test_plans_follow_the_selection() -> None:
    plans = plan_sequences(recipe(30, 10), Selection(("satellite_02",), "train", every=3, first=1, frames=2))
    assert {plan.spacecraft for plan in plans} == {"satellite_02"}
    assert {recipe(30).split_of(plan.sequence) for plan in plans} == {"train"}
    assert {plan.indices for plan in plans} == {(1, 4)}
    shards = [plan_sequences(recipe(30), Selection(shard=(i, 4))) for i in range(4)]
    assert sorted(plan.sequence for shard in shards for plan in shard) == list(range(30))
    limited = plan_sequences(recipe(30), Selection(sequences=2))
    assert Counter(plan.spacecraft for plan in limited) == dict.fromkeys(fleet.NAMES, 2)


@pytest.mark.parametrize(
    "selection",
    [
        {"spacecraft": ("satellite_9",)},
        {"split": "dev"},
        {"every": 0},
        {"frames": 0},
        {"first": -1},
        {"first": 6},
        {"shard": (2, 2)},
        {"sequences": 0},
    ],
)
def test_bad_selections_are_named(selection: dict) -> None:
    with pytest.raises(GknetError):
        plan_sequences(recipe(), Selection(**selection))


@pytest.mark.parametrize(
    "option",
    [{"window": "crop"}, {"size": 4}, {"size": 9000}, {"spp": 0}, {"spp": 10**6}, {"seed": -1}, {"seed": 2**60}],
)
def test_bad_options_are_named(option: dict) -> None:
    good = Options(size=64, spp=4)
    with pytest.raises(GknetError, match=next(iter(option))):
        replace(good, **option)


def test_target_windows_hold_the_box_at_native_resolution() -> None:
    random = np.random.default_rng(0)
    for seed in range(300):
        side = random.uniform(20, 900)
        x, y = random.uniform(0, 1024 - side, 2)
        box = Box(x, y, x + side, y + random.uniform(0.3, 1) * side)
        window = target_window(box, 320, seed)
        assert window == target_window(box, 320, seed)
        assert window.x0 <= box.x0
        assert window.y0 <= box.y0
        assert window.x0 + window.side >= box.x1
        assert window.y0 + window.side >= box.y1
        assert 1.3 < window.side / box.side < 1.8
        assert window.size in FILM_SIZES
        assert window.size >= min(window.side, 320)
        smaller = [size for size in FILM_SIZES if size < window.size]
        assert not smaller or smaller[-1] < window.side
    assert len({target_window(Box(100, 100, 300, 300), 320, seed) for seed in range(20)}) == 20


def test_shards_are_parsed() -> None:
    assert parse_shard("3/8") == (3, 8)
    for text in ("3", "a/b", "1/2/3", "-1/2"):
        with pytest.raises(GknetError, match="shard"):
            parse_shard(text)


def test_recipe_json_records_what_the_folder_is(tmp_path: Path) -> None:
    run(tmp_path, sequences=1, frames=1)
    recorded = json.loads((tmp_path / "recipe.json").read_text())
    assert (recorded["seed"], recorded["window"], recorded["recipe"]["name"]) == (5, "frame", "skd")
    assert read_image(tmp_path / "contact_sheet.jpg").shape[1] == 3 * TILE_PX


def test_a_reader_of_the_authors_rules_finds_the_keypoints_in_our_pictures(tmp_path: Path) -> None:
    run(tmp_path, size=128, recipe=recipe(sequences=15, frames=3))
    records = authors.read(tmp_path, 128)
    assert Counter(record.split for record in records) == {"train": 27, "val": 9, "test": 9}
    count = 0
    for record in records:
        image = read_image(record.image_path)
        for x, y in record.keypoints:
            if 2 < x < 126 and 2 < y < 126:
                assert image[int(y), int(x)].min() > 200
                count += 1
    assert count > 100


DAMAGES: dict[str, Callable[[str], str]] = {
    "cut": lambda line: line[:-30],
    "no JSON": lambda line: line.replace('"', "'"),
    "a list": lambda line: f"[{line}]",
    "nested": lambda line: 5000 * "[" + 5000 * "]",
    "digits": lambda line: line.replace('"frame": "1"', f'"frame": {"9" * 5000}'),
    "another key": lambda line: line.replace('"time_s"', '"clock"'),
    "one key more": lambda line: line.replace("{", '{"more": "1", ', 1),
    "a number": lambda line: line.replace('"frame": "1"', '"frame": 1'),
    "another frame": lambda line: line.replace('"frame": "1"', '"frame": "6"'),
    "a frame of many digits": lambda line: line.replace('"frame": "1"', f'"frame": "{"9" * 5000}"'),
    "no pose": lambda line: line.replace('"position": "[', '"position": "[x'),
    "no camera": lambda line: re.sub(r'"camera": "[^"]*"', '"camera": ""', line),
    "flags": lambda line: re.sub(r'"visible": "[^"]*"', '"visible": "[1]"', line),
    "bytes": lambda line: line.replace("position", "posi\udcfftion"),
    "nothing": lambda line: "",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_the_frame_of_a_damaged_line_is_rendered_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    selection: dict[str, Any] = {"sequences": 1, "spacecraft": ("satellite_01",), "frames": 4}
    run(tmp_path / "whole", **selection)
    with monkeypatch.context() as context:
        context.setattr(stage, "finish", lambda *_: None)
        run(tmp_path / "cut", **selection)
    journal = tmp_path / "cut/data/000001" / JOURNAL
    lines = journal.read_text(encoding="utf-8").splitlines()
    [place] = [k for k, line in enumerate(lines) if '"frame": "1"' in line]
    lines[place] = DAMAGES[damage](lines[place])
    journal.write_text("\n".join(lines), encoding="utf-8", errors="surrogateescape")
    result = run(tmp_path / "cut", **selection)
    assert (result.kept, result.rendered) == (3, 1)
    assert everything(tmp_path / "cut") == everything(tmp_path / "whole")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"{}",
        b"null",
        b"\xff\xfe",
        b"5" * 5000,
        b"[" * 5000 + b"]" * 5000,
        b'{"seed": ' + b"9" * 401 + b"}",
        b" " * (2 << 20),
    ],
)
def test_a_damaged_recipe_json_is_one_line(tmp_path: Path, content: bytes) -> None:
    run(tmp_path, sequences=1, frames=1)
    (tmp_path / "recipe.json").write_bytes(content)
    with pytest.raises(GknetError, match=r"recipe\.json.*choose another folder") as caught:
        run(tmp_path, sequences=1, frames=1)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def test_damaged_annotations_are_one_line(tmp_path: Path) -> None:
    run(tmp_path, sequences=1, frames=2, spacecraft=("satellite_01",))
    table = tmp_path / "data/000001/annotations.csv"
    good = table.read_text(encoding="utf-8")
    for bad in (
        "",
        "a,b\n",
        good.replace("visible", "seen"),
        good[:-200],
        good.replace("Satellite_01", "x,Satellite_01"),
    ):
        table.write_text(bad, encoding="utf-8")
        with pytest.raises(GknetError, match=r"annotations\.csv") as caught:
            run(tmp_path, sequences=1, frames=2, spacecraft=("satellite_01",))
        assert "\n" not in str(caught.value)
    table.unlink()
    assert run(tmp_path, sequences=1, frames=2, spacecraft=("satellite_01",)).rendered == 2


def test_an_own_spacecraft_is_rendered_by_its_name(tmp_path: Path) -> None:
    """Its files are put into the folder beforehand; capitals make no difference."""
    (tmp_path / "spacecraft").mkdir()
    built("Envisat", tmp_path / "spacecraft")
    own = recipe().model_copy(update={"spacecraft": ("Envisat", "satellite_01")})
    run(tmp_path, recipe=own, sequences=1, frames=1, spacecraft=("envisat",))
    assert SkdDataset(tmp_path).categories == ("Envisat",)


@pytest.mark.parametrize("workers", [0, -1, 100_000])
def test_workers_are_bounded(tmp_path: Path, workers: int) -> None:
    with pytest.raises(GknetError, match="workers: expected 1 to 256"):
        run(tmp_path, workers=workers)


def test_a_mesh_of_another_scale_ends_the_job_before_its_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(spacecraft: Spacecraft) -> None:
        raise GknetError(f"{spacecraft.name}: is the mesh in millimetres?")

    monkeypatch.setattr(stage, "load_mesh", refuse)
    with pytest.raises(GknetError, match="millimetres"):
        run(tmp_path, sequences=1)
    assert not list(tmp_path.rglob("*.jpg"))


def test_progress_is_reported_from_start_to_end(tmp_path: Path) -> None:
    reported: list[stage.Progress] = []
    run(tmp_path, sequences=1, frames=2, on_progress=reported.append)
    assert [(each.done, each.total) for each in reported] == [(0, 6), (2, 6), (4, 6), (6, 6)]
