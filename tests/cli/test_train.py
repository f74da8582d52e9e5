"""`gknet train` and `gknet export` given what is damaged or malicious: one line, code 2, and nothing half-written."""

from __future__ import annotations

import csv
import json
import pickle
import pickletools
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")

from gknet.cli.main import run  # noqa: E402
from gknet.training.checkpoint import BEST, CHECKPOINT  # noqa: E402
from tests.training.toy import write_toy  # noqa: E402

Refused = Callable[..., str]
QUICK = ("--epochs", "1", "--stages", "1:32:4", "--val-frames", "2", "--validations", "1", "--device", "cpu")
NETWORK = ("--spacecraft", "satellite_01", "--network", "locator", *QUICK)


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("toy") / "set"
    write_toy(root, 6, 3, 64)
    return root


@pytest.fixture
def data(toy: Path, tmp_path: Path) -> Path:
    return shutil.copytree(toy, tmp_path / "set")


@pytest.fixture(scope="module")
def finished(toy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert run(["train", str(toy), "--out", str(out), "--cache", str(out.parent / "cache"), *NETWORK]) == 0
    return out


class Touch:
    """A pickle of it writes a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def edit(path: Path, row: int, column: str, text: str) -> None:
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    rows[row][column] = text
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_a_pickle_is_never_run(finished: Path, data: Path, refused: Refused, tmp_path: Path) -> None:
    """As weights, as a checkpoint, as a skeleton; by pickle itself and by torch."""
    mark, copy, out = tmp_path / "mark", tmp_path / "copy", tmp_path / "out"
    torch.save(Touch(mark), tmp_path / "torch.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps(Touch(mark)))
    for path in (tmp_path / "torch.pt", tmp_path / "plain.pt"):
        assert path.name in refused("train", data, "--out", out, *NETWORK, "--init", path)
        assert not out.exists()
        shutil.copytree(finished, copy)
        shutil.copy(path, copy / CHECKPOINT)
        assert CHECKPOINT in refused("train", data, "--out", copy, *NETWORK, "--resume")
        shutil.copy(path, copy / BEST)
        assert BEST in refused("export", copy, "--out", out)
        shutil.rmtree(copy)
    shutil.rmtree(data / "spacecraft")
    (data / "data/000001/skeleton.json").unlink()
    for path in (tmp_path / "torch.pt", tmp_path / "plain.pt"):
        shutil.copy(path, data / "data/000001/skeleton.pth")
        assert "skeleton.pth" in refused("train", data, "--out", out, *NETWORK)
        assert not out.exists()
    assert not mark.exists()
    assert "REDUCE" in {code.name for code, _, _ in pickletools.genops((tmp_path / "plain.pt").read_bytes())}
    call, arguments = Touch(mark).__reduce__()  # what loading it would have done
    call(*arguments)
    assert mark.exists()


@pytest.mark.parametrize("content", [[], {}, {"identity": "x"}, "text"])
def test_a_checkpoint_of_something_else(
    content: object, finished: Path, toy: Path, refused: Refused, tmp_path: Path
) -> None:
    shutil.copytree(finished, tmp_path / "run")
    torch.save(content, tmp_path / "run" / CHECKPOINT)
    assert CHECKPOINT in refused("train", toy, "--out", tmp_path / "run", *NETWORK, "--resume")


def test_a_checkpoint_without_its_parts(finished: Path, toy: Path, refused: Refused, tmp_path: Path) -> None:
    whole = torch.load(finished / CHECKPOINT, weights_only=True)
    for part in whole:
        shutil.copytree(finished, tmp_path / part)
        torch.save({name: value for name, value in whole.items() if name != part}, tmp_path / part / CHECKPOINT)
        if part != "cuda_rng":
            assert CHECKPOINT in refused("train", toy, "--out", tmp_path / part, *NETWORK, "--resume")
    wrong: list[dict[str, object]] = [{"network": {}}, {"state": {"steps": 3, "speed": 5}}]
    wrong += [{part: 5} for part in whole]
    for parts in wrong:
        if "cuda_rng" not in parts:
            torch.save({**whole, **parts}, tmp_path / "network" / CHECKPOINT)
            assert CHECKPOINT in refused("train", toy, "--out", tmp_path / "network", *NETWORK, "--resume")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("network", 5),
        ("network", "hourglass"),
        ("loss", None),
        ("input_size", "big"),
        ("input_size", -64),
        ("spacecraft_toml", 3),
        ("spacecraft_toml", "name = "),
        ("best", [1, 2]),
        ("best", {"floor_cells": "wide"}),
        ("data", 7),
    ],
)
def test_a_run_json_of_something_else(
    key: str, value: object, finished: Path, refused: Refused, tmp_path: Path
) -> None:
    shutil.copytree(finished, tmp_path / "run")
    content = json.loads((finished / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps({**content, key: value}))
    refused("export", tmp_path / "run", "--out", tmp_path / "model")
    assert not (tmp_path / "model").exists()


def skeleton(edges: str, names: int = 17) -> str:
    return f'{{"keypoint_names": {json.dumps([f"k{k}" for k in range(names)])}, "edges": {edges}}}'


TABLE, SKELETON = "data/000001/annotations.csv", "data/000001/skeleton.json"
MATRIX, POINTS = "data/000001/camera_matrix.txt", "data/000001/keypoints.txt"
DAMAGED = {
    "no split file": ("train.json", None, "train.json"),
    "cut split file": ("train.json", "{", "train.json"),
    "deep split file": ("train.json", "[" * 100_000, "train.json"),
    "a sequence that is not there": ("train.json", '{"Satellite_01": ["data/000009"]}', "data/000009"),
    "no annotations": (TABLE, None, "annotations.csv"),
    "wrong columns": (TABLE, "category,position,attitude\n", "'orientation'"),
    "no rows": (TABLE, "category,position,orientation\n", "0 rows"),
    "too few cells": (TABLE, 'category,position,orientation\nSatellite_01,"[1, 2, 3]"\n', "row 1"),
    "binary": (TABLE, "\x00\x01,\x02\n", "annotations.csv"),
    "no keypoints": (POINTS, None, "keypoints.txt"),
    "empty keypoints": (POINTS, "", "keypoints.txt"),
    "three keypoints": (POINTS, "1, 2, 3\n4, 5, 6\n7, 8, 10\n", "4 keypoints"),
    "one place for all": (POINTS, "1, 2, 3\n" * 17, "apart"),
    "NaN keypoint": (POINTS, "1, 2, nan\n", "keypoints.txt"),
    "NaN camera": (MATRIX, "512, nan, 0\n512, 0, 1400\n1, 0, 0\n", "camera_matrix.txt"),
    "edge out of range": (SKELETON, skeleton("[[0, 17]]"), "(0, 17)"),
    "negative edge": (SKELETON, skeleton("[[-1, 3]]"), "(-1, 3)"),
    "endless edge": (SKELETON, skeleton("[[0, Infinity]]"), "skeleton.json"),
    "half an edge": (SKELETON, skeleton("[[0, 1.5]]"), "skeleton.json"),
    "three ends": (SKELETON, skeleton("[[0, 1, 2]]"), "skeleton.json"),
    "too few names": (SKELETON, skeleton("[]", names=5), "17 keypoint names"),
    "a name twice": (SKELETON, skeleton("[]").replace("k16", "k15"), "differ"),
    "no skeleton": (SKELETON, None, "skeleton"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_datasets(case: str, data: Path, refused: Refused, tmp_path: Path) -> None:
    name, text, words = DAMAGED[case]
    shutil.rmtree(data / "spacecraft")
    for path in (data / "data/000001").glob("*.pth"):
        path.unlink()
    (data / name).unlink()
    if text is not None:
        (data / name).write_text(text)
    assert words in refused("train", data, "--out", tmp_path / "out", *NETWORK)
    assert not (tmp_path / "out").exists()


BAD_CELLS = {
    "NaN": ("position", "[0.1, nan, 3]"),
    "not a number": ("position", "[1, 2, 'far']"),
    "a huge integer": ("position", f"[1{'0' * 400}, 0, 9]"),
    "an endless integer": ("position", f"[1{'0' * 5000}, 0, 9]"),
    "complex": ("position", "[1, 2, 3j]"),
    "a sum": ("position", "[1 + 1, 2, 9]"),
    "nested": ("position", "[" * 500 + "]" * 500),
    "no unit quaternion": ("orientation", "[0, 0, 0, 0]"),
    "one flag too few": ("visible", "[1, 0]"),
    "a camera of nothing": ("camera", "[0, 0, 0, 0, 0, 0]"),
    "half a pixel": ("camera", "[77, 77, 32, 32, 64.5, 64]"),
}


@pytest.mark.parametrize("case", BAD_CELLS)
def test_a_bad_label_is_reported_and_left_out(
    case: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    column, text = BAD_CELLS[case]
    edit(data / TABLE, 2, column, text)
    assert run(["train", str(data), "--out", str(tmp_path / "out"), *NETWORK]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("left out") == 1
    assert f"row 3: {column}" in told


@pytest.mark.parametrize("column", ["position", "orientation", "visible", "sun_direction", "camera", "time_s", "seed"])
def test_a_cell_is_data_and_never_run(
    column: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mark = tmp_path / "mark"
    for table in (TABLE, TABLE.replace("1/", "2/")):
        edit(data / table, 1, column, f"[__import__('pathlib').Path({str(mark)!r}).touch() or 0.0, 0.0, 0.0, 1.0]")
    assert run(["train", str(data), "--out", str(tmp_path / "out"), *NETWORK]) == 0
    assert not mark.exists()
    assert "row 2" in capsys.readouterr().out


def test_bad_pictures_are_reported_and_left_out(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Cut, empty, gone, of another size: of the training and of the validation."""
    images = data / "data/000001/image"
    for number, size in ((1, 500), (2, 0)):
        path = images / f"00000{number}.jpg"
        path.write_bytes(path.read_bytes()[:size])
    (images / "000003.jpg").unlink()
    (data / "data/000002/image/000001.jpg").write_bytes(b"no picture")
    assert run(["train", str(data), "--out", str(tmp_path / "out"), *NETWORK]) == 0
    told = capsys.readouterr().out
    assert told.count("left out") == 4
    for name in ("000001/image/000001.jpg", "000001/image/000002.jpg", "000001/image/000003.jpg"):
        assert name in "".join(told.split())


def test_no_picture_to_validate_on_is_said_before_the_training(data: Path, refused: Refused, tmp_path: Path) -> None:
    shutil.rmtree(data / "data/000002/image")
    assert "val" in refused("train", data, "--out", tmp_path / "out", *NETWORK)
    assert not (tmp_path / "out").exists()
