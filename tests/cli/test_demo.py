"""`gknet demo`: everything it promises is written, from whatever models and frames are bundled."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from gknet.cli.main import run
from gknet.io.video import open_video
from tests.cli.toy import ToyEstimator


@pytest.fixture
def bundled(monkeypatch: pytest.MonkeyPatch, dataset: Path, use: Callable[[ToyEstimator], None]) -> None:
    use(ToyEstimator(error=1.0, blind=frozenset({2})))
    monkeypatch.setattr("gknet.inference.load.shipped_models", lambda: ("toycraft",))
    monkeypatch.setattr("gknet.dataset.demo_frames.bundled_frames", lambda: dataset)


@pytest.mark.usefixtures("bundled")
def test_demo_writes_all_it_promises(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    assert run(["demo", "--out", str(out)]) == 0
    folder = out / "toycraft"
    lines = (folder / "poses.jsonl").read_text().splitlines()
    assert [json.loads(line)["status"] for line in lines].count("ok") == 9
    assert len(list((folder / "overlays").glob("*.jpg"))) == 10
    assert open_video(folder / "overlay.mp4").announced == 10
    metrics = json.loads((out / "metrics.json").read_text())
    found = metrics["spacecraft"]["toycraft"]["runs"]["detected"]
    assert found["frames"] == 10
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "http" not in page
    assert f'data-value="{found["metrics"]["e_t"]["mean"]!r}"' in page
    printed = capsys.readouterr().out
    assert "toycraft" in printed
    for name in ("poses.jsonl", "overlay.mp4", "report.html", "metrics.json"):
        assert name in printed


def test_without_models_it_says_so(
    monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str], tmp_path: Path
) -> None:
    monkeypatch.setattr("gknet.inference.load.shipped_models", lambda: ())
    assert "no model is shipped" in refused("demo", "--out", tmp_path / "demo")
    assert not (tmp_path / "demo").exists()
