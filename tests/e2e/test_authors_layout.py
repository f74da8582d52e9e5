"""A folder with nothing but the authors' files and columns: train, export, eval and predict on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytestmark = pytest.mark.slow

from gknet.cli.main import run  # noqa: E402
from gknet.geometry import Camera  # noqa: E402
from tests.dataset import authors  # noqa: E402
from tests.training.toy import EDGES, POINTS, drawn, random_pose  # noqa: E402

SIZE = 96
CRAFT = ("--spacecraft", "Satellite_07")
QUICK = ("--epochs", "1", "--stages", "1:64:4", "--val-frames", "2", "--validations", "1", "--device", "cpu")


def gknet(*words: object) -> None:
    assert run([str(word) for word in words]) == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root, camera = tmp_path_factory.mktemp("authors") / "SKD", Camera.from_focal(1.2 * SIZE, SIZE, SIZE)
    shots: dict[str, list[authors.Shot]] = {}
    for number, (split, count) in enumerate((("train", 8), ("val", 3), ("test", 3))):
        poses = [random_pose(np.random.default_rng((number, index))) for index in range(count)]
        shots[split] = [authors.Shot(drawn(camera, pose), pose.rotation, pose.translation_m) for pose in poses]
    authors.write(root, "Satellite_07", camera.matrix, POINTS, list(EDGES), shots)
    return root


@pytest.fixture(scope="module")
def model(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network trained for a moment, and exported."""
    root = tmp_path_factory.mktemp("model")
    gknet("train", folder, *CRAFT, "--out", root / "run", *QUICK)
    gknet("export", root / "run", "--out", root / "model")
    return root / "model"


def test_the_locator_trains_too(folder: Path, tmp_path: Path) -> None:
    gknet("train", folder, *CRAFT, "--network", "locator", "--out", tmp_path / "run", *QUICK)
    assert (tmp_path / "run" / "best.safetensors").is_file()


def test_eval_says_what_it_knows_and_what_it_does_not(
    folder: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    gknet("eval", folder, "--model", model, "--out", tmp_path, "--threads", 1)
    content = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert (content["spacecraft"], content["skipped"]) == ("Satellite_07", [])
    assert content["unknown"] == ["visible", "sun_direction"]
    found = content["runs"]["oracle"]
    assert (found["frames"], found["sequences"]) == (3, 1)
    assert found["metrics"]["rmse_px"]["frames"] == found["metrics"]["e_t"]["frames"] == 3
    assert "rmse_hidden_px" not in found["metrics"]
    by = {b["by"] for b in found["bins"]}
    assert by - {"attitude_confidence"} == {
        "range_diameters"
    }  # the attitude confidence is of poses, and there may be none
    assert list(found["keypoints"])[:2] == ["keypoint_01", "keypoint_02"]
    assert all(k["frames"] > 0 and k["hidden_median_px"] is None for k in found["keypoints"].values())
    for told in (capsys.readouterr().out, (tmp_path / "report.html").read_text(encoding="utf-8")):
        assert "which keypoints the spacecraft hides" in told
        assert "where the sun is" in told


def test_predict_takes_the_folder_and_its_camera(folder: Path, model: Path, tmp_path: Path) -> None:
    """The network has learned nothing, so the command may find no pose at all; it answers for every image."""
    run(["predict", str(folder), "--model", str(model), "--split", "test", "--oracle", "--out", str(tmp_path)])
    records = [json.loads(line) for line in (tmp_path / "poses.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [record["name"] for record in records] == [f"000003/00000{k}" for k in (1, 2, 3)]
    assert all(len(record["keypoints"]) == len(POINTS) for record in records)
    assert len(list((tmp_path / "overlays").iterdir())) == 3
