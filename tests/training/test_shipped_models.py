"""The recipe of the shipped models on drawn images: it trains, blends, exports, and chooses what it says it does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")
pytest.importorskip("lightning_fabric")
pytest.importorskip("mitsuba")

import onnx
import torch

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.inference.load import load_estimator
from gknet.network.build import build
from gknet.render.recipe import RECIPES
from gknet.training.checkpoint import BEST, load_weights
from gknet.training.onnx_graph import WEIGHTS
from gknet.training.schedule import Stage

CRAFT = "satellite_01"
STAGES = (Stage(1.0, 64, 4),)
SEED = 5
EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    import shipped_models

    monkeypatch.setattr(shipped_models, "NAMES", (CRAFT,))
    monkeypatch.setattr(shipped_models, "FIRST_STAGES", STAGES)
    return shipped_models


@pytest.fixture
def work(data: Path, tmp_path: Path) -> Path:
    for folder in ("crops", "pictures", "frames"):
        shutil.copytree(data, tmp_path / folder)
    return tmp_path


def test_more_sequences_have_the_splits_of_the_first(recipe: ModuleType) -> None:
    """So what a longer recipe trains on is never of skd's val and test sequences."""
    for scale in recipe.SCALES.values():
        longer = RECIPES["skd"].model_copy(update={"sequences": scale.sequences})
        for sequence in range(RECIPES["skd"].sequences):
            assert longer.split_of(sequence) == RECIPES["skd"].split_of(sequence)
            assert longer.spacecraft_of(sequence) == RECIPES["skd"].spacecraft_of(sequence)


def test_a_mean_goes_from_the_old_weights_to_the_new(recipe: ModuleType) -> None:
    before = {"w": torch.tensor([1.0, 2.0]), "count": torch.tensor(3)}
    after = {"w": torch.tensor([5.0, 0.0]), "count": torch.tensor(9)}
    for share, expected in ((0.0, [1.0, 2.0]), (0.25, [2.0, 1.5]), (1.0, [5.0, 0.0])):
        found = recipe.mean(before, after, share)
        assert found["w"].tolist() == expected
        assert found["count"] == 9


@pytest.mark.slow
@pytest.mark.slow
def test_it_trains_blends_and_exports(recipe: ModuleType, work: Path) -> None:
    scale = replace(
        recipe.SCALES["cpu"], first_minutes=0.01, keypoint_minutes=(0.01,), locator_minutes=0.01, stages=STAGES
    )
    recipe.train_all(work, scale, None, SEED)
    recipe.ship(work, work / "models", None)
    assert load_estimator(work / "models" / CRAFT).locator is not None
    assert not list((work / "blended").glob("first*"))

    run = f"{CRAFT}_keypoints"
    record = json.loads((work / "blended" / run / "run.json").read_text())
    chosen = record["best"]
    assert record["settings"]["seed"] == SEED
    before, after = load_weights(work / "runs" / "first" / BEST), load_weights(work / "runs" / run / BEST)
    blended = load_weights(work / "blended" / run / BEST)
    for name, expected in recipe.mean(before, after, chosen["share"]).items():
        torch.testing.assert_close(blended[name], expected)
    job = next(job for job in recipe.jobs(work, scale, None, SEED) if job.run == run)
    assert scores_of(recipe.blend(job), recipe) is None  # done before, so left alone
    shutil.rmtree(work / "blended" / run)
    scores = scores_of(recipe.blend(job), recipe)
    assert scores is not None
    assert list(scores) == list(recipe.SHARES)
    assert scores[chosen["share"]] == min(scores.values())


@pytest.mark.slow
@pytest.mark.slow
def test_weights_of_another_network_give_what_fits_and_make_no_mean(recipe: ModuleType, work: Path) -> None:
    """And a locator that is kept ships as it was, neither rendered for nor trained."""
    scale = replace(recipe.SCALES["cpu"], keypoint_minutes=(0.01,), stages=STAGES)
    start = work / "start"
    (start / CRAFT).mkdir(parents=True)
    (start / CRAFT / "locator.onnx").write_bytes(b"as it was")
    other = {name: weight for name, weight in initial(work).items() if not name.startswith("decoder")}
    save_as_export(start / CRAFT / "keypoints.onnx", other)
    kinds = ("keypoints",)
    [job] = recipe.jobs(work, scale, start, SEED, kinds)
    recipe.run(job)
    assert list(scores_of(recipe.blend(job), recipe) or {}) == [1.0]
    recipe.ship(work, work / "models", start, kinds)
    assert (work / "models" / CRAFT / "locator.onnx").read_bytes() == b"as it was"
    assert (work / "models" / CRAFT / "keypoints.onnx").exists()


def save_as_export(path: Path, weights: dict[str, torch.Tensor]) -> None:
    """A file that holds weights as an export does, and no graph that uses them."""
    tensors = [onnx.numpy_helper.from_array(each.numpy(), WEIGHTS + name) for name, each in weights.items()]
    graph = onnx.helper.make_graph([], "weights alone", [], [], tensors)
    path.write_bytes(onnx.helper.make_model(graph).SerializeToString())


def initial(work: Path) -> dict[str, torch.Tensor]:
    spacecraft = SkdDataset(work / "frames", "val", CRAFT).spacecraft
    return build("gknet-s", spacecraft.adjacency, spacecraft.points_m).state_dict()


def scores_of(said: str, recipe: ModuleType) -> dict[float, float] | None:
    """What `blend` says of each share."""
    if "done before" in said:
        return None
    words = said.split(": ", 1)[1].split(", ")
    return {float(word.split()[1]): float(word.split()[3]) for word in words}


def test_models_to_start_from_are_looked_at_first(recipe: ModuleType, tmp_path: Path) -> None:
    recipe.check_start(None)
    with pytest.raises(GknetError, match=r"satellite_01/keypoints\.onnx"):
        recipe.check_start(tmp_path)
