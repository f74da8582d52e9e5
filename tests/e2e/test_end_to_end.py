"""Render, train, export, predict and evaluate on the command line; the result must beat stated dumb baselines.

The task is an easy one: two slow sequences, near and well lit, with the frames dealt out to train, val and test, so
that a test frame lies about two degrees from a training frame. A training of about a minute can learn that. It
shows that the rooms fit together and that training learns; how good gknet is on sequences that it never saw is
measured elsewhere.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.dataset.skd import SkdDataset
from gknet.dataset.skd_format import SPLITS, category_of
from gknet.evaluation.metrics import oracle_crop

pytest.importorskip("mitsuba")
pytest.importorskip("torch")
pytestmark = pytest.mark.slow

CRAFT = "satellite_01"
RECIPE = Path(__file__).parent / "easy.toml"
KEYPOINT_STAGES, LOCATOR_STAGES = "1:128:16", "1:128:8"


def gknet(*words: object, code: int = 0) -> str:
    """One command line in a process of its own; its standard output."""
    command = [sys.executable, "-m", "gknet.cli.main", *map(str, words)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert run.returncode == code, f"{' '.join(command)}\n{run.stdout[-3000:]}\n{run.stderr[-3000:]}"
    return run.stdout if code == 0 else run.stderr


@dataclass(frozen=True)
class Products:
    """train_crops and train_frames hold the even frames of the sequences, val and test a half of the odd ones each."""

    train_crops: Path
    train_frames: Path
    val: Path
    test: Path
    model: Path


def render(out: Path, split: str, *words: object) -> Path:
    """Frames of both sequences; whatever the recipe says, all of them are listed in `split`."""
    gknet("render", out, "--recipe", RECIPE, "--spp", 4, *words)
    lists = [json.loads((out / f"{name}.json").read_text(encoding="utf-8")) for name in SPLITS]
    sequences = sorted(name for listing in lists for names in listing.values() for name in names)
    for name in SPLITS:
        listing = {category_of(CRAFT): sequences} if name == split else {}
        (out / f"{name}.json").write_text(json.dumps(listing), encoding="utf-8")
    return out


@pytest.fixture(scope="module")
def products(tmp_path_factory: pytest.TempPathFactory) -> Products:
    """Rendered frames, and both networks trained on them and exported."""
    root = tmp_path_factory.mktemp("e2e")
    crops = render(root / "crops", "train", "--window", "target", "--size", 192, "--every", 2)
    frames = render(root / "frames", "train", "--size", 256, "--every", 4)
    val = render(root / "val", "val", "--size", 256, "--first", 1, "--every", 8)
    test = render(root / "test", "test", "--size", 256, "--first", 3, "--every", 4)
    common = ("--spacecraft", CRAFT, "--val", val, "--val-frames", 12, "--validations", 2)
    keypoints, locator, model = root / "keypoints", root / "locator", root / "model"
    locate = ("--network", "locator", "--epochs", 100, "--stages", LOCATOR_STAGES)
    gknet("train", crops, *common, "--out", keypoints, "--epochs", 120, "--stages", KEYPOINT_STAGES)
    gknet("train", frames, *common, "--out", locator, *locate)
    gknet("export", keypoints, "--out", model)
    gknet("export", locator, "--out", model)
    return Products(crops, frames, val, test, model)


def keypoints_in_crop(dataset: SkdDataset, i: int) -> ndarray:
    """(n, 2) in pixels of the 256 oracle crop, NaN where out of view."""
    frame = dataset.frame(i, image=False)
    pixels = frame.keypoints_px(dataset.spacecraft.points_m)
    inside = frame.camera.contains(pixels)
    return np.where(inside[:, None], oracle_crop(frame, dataset.spacecraft).to_input(pixels), np.nan)


def constant_rmse_px(products: Products) -> float:
    """Mean RMSE of the predictor that puts each keypoint where it is on average over the training crops."""
    train = SkdDataset(products.train_crops, "train", CRAFT)
    test = SkdDataset(products.test, "test", CRAFT)
    mean = np.nanmean([keypoints_in_crop(train, i) for i in range(len(train))], axis=0)
    squared = [((keypoints_in_crop(test, i) - mean) ** 2).sum(axis=1) for i in range(len(test))]
    return float(np.mean([np.sqrt(np.nanmean(row)) for row in squared]))


@pytest.fixture(scope="module")
def metrics(products: Products) -> dict[str, dict[str, dict[str, float]]]:
    """Metric -> statistics, for each protocol."""
    out = products.model.parent / "evaluation"
    gknet("eval", products.test, "--model", products.model, "--split", "test", "--out", out, "--images", 2)
    assert (out / "report.html").stat().st_size > 10_000
    content = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    return {protocol: run["metrics"] for protocol, run in content["runs"].items()}


def test_keypoints_beat_the_constant_predictor(
    products: Products, metrics: dict[str, dict[str, dict[str, float]]]
) -> None:
    baseline, found = constant_rmse_px(products), metrics["oracle"]["rmse_px"]["mean"]
    print(f"RMSE, oracle crop: {found:.1f} px, constant predictor {baseline:.1f} px")
    assert found < 0.4 * baseline


def attitudes(dataset: SkdDataset) -> Rotation:
    frames = (dataset.frame(i, image=False) for i in range(len(dataset)))
    return Rotation.from_matrix([frame.cam_from_body.rotation for frame in frames if frame.cam_from_body is not None])


def constant_e_q_rad(products: Products) -> float:
    """Mean E_q of the mean training attitude, said of every test frame."""
    mean = attitudes(SkdDataset(products.train_crops, "train", CRAFT)).mean()
    return float((mean.inv() * attitudes(SkdDataset(products.test, "test", CRAFT))).magnitude().mean())


def test_attitudes_beat_the_constant_predictor(
    products: Products, metrics: dict[str, dict[str, dict[str, float]]]
) -> None:
    """Failures count as pi."""
    baseline = constant_e_q_rad(products)
    for protocol, share in (("oracle", 0.3), ("detected", 0.5)):
        found = metrics[protocol]["e_q_rad"]["mean"]
        print(f"E_q, {protocol} crop: {found:.2f} rad, constant predictor {baseline:.2f} rad")
        assert found < share * baseline


def test_locator_beats_the_whole_picture(products: Products, metrics: dict[str, dict[str, dict[str, float]]]) -> None:
    test = SkdDataset(products.test, "test", CRAFT)
    boxes = [test.frame(i, image=False).true_box(test.spacecraft.points_m) for i in range(len(test))]
    baseline = float(np.mean([box.area / 256**2 for box in boxes if box is not None]))
    found = metrics["detected"]["locator_iou"]["mean"]
    print(f"IoU: {found:.2f}, whole image {baseline:.2f}")
    assert found > max(0.6, 2 * baseline)


def test_prediction_writes_a_line_for_each_picture(products: Products, tmp_path: Path) -> None:
    dataset = SkdDataset(products.test, "test", CRAFT)
    out = tmp_path / "predictions"
    gknet("predict", products.test, "--model", products.model, "--split", "test", "--out", out)
    lines = [json.loads(line) for line in (out / "poses.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [line["name"] for line in lines] == [dataset.frame(i, image=False).name for i in range(len(dataset))]
    posed = [line for line in lines if line["status"] == "ok"]
    assert posed
    assert all(np.linalg.norm(line["quaternion_wxyz"]) == pytest.approx(1, abs=1e-6) for line in posed)
    assert len(list((out / "overlays").glob("*.jpg"))) == len(lines)


def test_rendering_again_changes_nothing(products: Products) -> None:
    annotations = sorted(products.test.glob("data/*/annotations.csv"))
    before = [path.read_bytes() for path in annotations]
    words = ("--recipe", RECIPE, "--spp", 4, "--size", 256, "--first", 3, "--every", 4)
    assert ": 0 frames rendered" in gknet("render", products.test, *words)
    assert [path.read_bytes() for path in annotations] == before


def test_bad_input_ends_with_one_line_and_code_2(products: Products, tmp_path: Path) -> None:
    (tmp_path / "torn.jpg").write_bytes(b"\xff\xd8\xff\xe0 no picture")
    for words in (
        ("predict", tmp_path / "absent.jpg", "--model", products.model, "--focal-px", 1400, "--out", tmp_path),
        ("predict", tmp_path / "torn.jpg", "--model", products.model, "--focal-px", 1400, "--out", tmp_path),
        ("eval", tmp_path, "--model", products.model),
        ("export", tmp_path, "--out", tmp_path / "model"),
        ("train", tmp_path, "--out", tmp_path / "run", "--spacecraft", CRAFT, "--minutes", 1),
        ("render", products.val, "--recipe", RECIPE, "--seed", 5, "--size", 256),
    ):
        said = gknet(*words, code=2)
        assert len(said.strip().splitlines()) == 1, said
        assert "Traceback" not in said
