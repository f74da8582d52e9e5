"""Experiments end on bad input with one line that names it, and exit code 2."""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gknet.evaluation.comparison import Interval, Trial

pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")
pytest.importorskip("mitsuba")

from gknet.errors import DivergedError
from gknet.training.settings import TrainSettings

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


Refused = Callable[..., str]


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Run a script that must end with code 2; what it prints on standard error."""

    def run(name: str, *words: object) -> str:
        monkeypatch.syspath_prepend(str(EXPERIMENTS))
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(EXPERIMENTS / name), run_name="__main__")
        assert end.value.code == 2
        return capsys.readouterr().err

    return run


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"name": "GKNet", "protocols": {"oracle": {}}}'])
def test_a_result_that_is_none(content: str, refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / "satellite_01_a_0.json").write_text(content)
    line = refused("paper_report.py", "--results", tmp_path)
    assert line.startswith("error: ")
    assert "satellite_01_a_0.json: not a result" in line
    assert line.count("\n") == 1
    assert not (tmp_path / "cpu" / "README.md").exists()


@pytest.mark.parametrize("path", [("curve",), ("protocols", "oracle", "values", "e_q_rad"), ("protocols", "oracle")])
def test_a_result_that_lacks_something(path: tuple[str, ...], refused: Refused, tmp_path: Path) -> None:
    """As results of an earlier recipe do, of its curve or of a metric."""
    kept = next((EXPERIMENTS.parent / "results" / "paper_tables" / "cpu").glob("satellite_*.json"))
    content = json.loads(kept.read_text(encoding="utf-8"))
    *parents, last = path
    inner = content
    for name in parents:
        inner = inner[name]
    del inner[last]
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / kept.name).write_text(json.dumps(content))
    line = refused("paper_report.py", "--results", tmp_path)
    assert f"{kept.name}: not a result" in line
    assert f"no {last}" in line
    assert line.count("\n") == 1


@pytest.mark.parametrize("content", ["{}", '{"score": NaN}'])
def test_a_score_that_is_none(content: str, refused: Refused, tmp_path: Path) -> None:
    work, sweep = tmp_path / "work" / "cpu", tmp_path / "results" / "cpu" / "sweep"
    work.mkdir(parents=True)
    sweep.mkdir(parents=True)
    (work / "rendered_satellite_02").touch()
    scale = runpy.run_path(str(EXPERIMENTS / "paper_tables.py"))["SCALES"]["cpu"]
    names = [f"satellite_02_{method.network}_{rate:g}.json" for method in scale.methods for rate in scale.rates]
    for name in names:
        (sweep / name).write_text(content)
    folders = ("--work", tmp_path / "work", "--results", tmp_path / "results")
    line = refused("paper_tables.py", *folders, "--spacecraft", "satellite_02")
    assert f"{names[0]}: not a score" in line
    assert line.count("\n") == 1


@pytest.mark.parametrize(
    ("scores", "chosen"),
    [
        ({1.5e-3: 31, 3e-3: 30, 6e-3: 35}, 3e-3),
        ({3e-3: 36, 6e-3: 35, 1.2e-2: 33, 2.4e-2: None}, 1.2e-2),
        ({7.5e-4: 40, 1.5e-3: 38, 3e-3: 39, 6e-3: None}, 1.5e-3),
        ({3e-3: 36, 6e-3: 35, 1.2e-2: 34, 2.4e-2: 33, 4.8e-2: 32, 9.6e-2: 31}, 9.6e-2),  # enough is enough
    ],
)
def test_a_sweep_goes_on_until_its_best_lies_inside(
    scores: dict[float, float | None], chosen: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every rate that it tries is among `scores`, each once; a diverged one has none."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    import paper_tables

    scale, left = paper_tables.SCALES["cpu"], dict(scores)
    (tmp_path / "sweep").mkdir()

    def training(work: Path, spacecraft: str, run: Path, settings: TrainSettings) -> float:
        score = left.pop(round(settings.learning_rate, 6))
        if score is None:
            raise DivergedError("the loss became nan")
        run.mkdir(parents=True)
        (run / "run.json").write_text(json.dumps({"best": {"score": score}}))
        return 1.0

    monkeypatch.setattr(paper_tables, "run_training", training)
    for mine in (True, False):  # another share reads the same
        rate = paper_tables.chosen_rate(tmp_path / "work", tmp_path, scale, "hrnet-xs", "satellite_02", mine)
        assert rate == pytest.approx(chosen)
    assert not left


def test_the_papers_training_has_the_papers_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eq. 4 alone, of the fused maps, by Adam."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    import paper_tables

    settings = paper_tables.SCALES["full"].settings
    assert (settings.auxiliary, settings.weight_decay, settings.ema, settings.optimizer) == (0, 0, 0, "adamw")
    for method in paper_tables.SCALES["full"].methods[:3]:
        assert replace(settings, network=method.network).chosen_loss == "squared"


@pytest.mark.parametrize(("second", "bold"), [(5.0, True), (-0.1, False)])
def test_a_difference_is_bold_where_each_seed_agrees(
    second: float, bold: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    import paper_report

    def trials(shifts: tuple[float, float]) -> list[Trial]:
        names = tuple(str(k) for k in range(30))
        return [
            Trial("m", "satellite_01", seed, names, names, {"e_t": np.full(30, 9.0 + shift)}, np.eye(2, dtype=np.int64))
            for seed, shift in enumerate(shifts)
        ]

    both = {("a", "satellite_01", "oracle"): trials((5, second)), ("b", "satellite_01", "oracle"): trials((0, 0))}
    monkeypatch.setattr(paper_report, "difference", lambda *_: Interval(2, 1, 3))  # it excludes zero
    row = paper_report.difference_row(both, "a", "b", "e_t", "oracle")
    assert row[0].startswith("**") == bold
    assert f"2 seeds: 5, {second:.2g}" in row[0]
    assert row[1:] == ["not run", "not run"]


@pytest.mark.parametrize("share", ["2/2", "-1/2", "1", "a/b", "0/0"])
def test_a_share_that_is_none(share: str, refused: Refused, tmp_path: Path) -> None:
    line = refused("paper_tables.py", "--work", tmp_path, "--results", tmp_path, f"--share={share}")
    assert f"expected I/N with I from 0 to N - 1, got '{share}'" in line


def test_models_that_are_none(refused: Refused, tmp_path: Path) -> None:
    assert "keypoints.onnx" in refused("shipped_tables.py", "--models", tmp_path, "--results", tmp_path)
    assert "no model" in refused("paper_figures.py", "--out", tmp_path, "--work", tmp_path)
