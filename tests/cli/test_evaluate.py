"""`gknet eval`: the numbers it prints, writes and shows are one and the same."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from gknet.cli.main import run
from tests.cli.toy import ToyEstimator

Use = Callable[[ToyEstimator], None]


class Reader(HTMLParser):
    """Checks that tags nest, and collects attributes and values."""

    VOID = frozenset({"meta", "img", "br", "hr", "link", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.values: dict[str, float] = {}
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        given = dict(attrs)
        self.links += [given[key] or "" for key in ("src", "href", "xlink:href", "data") if key in given]
        if "data-metric" in given:
            self.values[given["data-metric"] or ""] = float(given["data-value"] or "nan")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def evaluated(dataset: Path, out: Path, *options: str) -> tuple[dict, Reader]:
    assert run(["eval", str(dataset), "--spacecraft", "toycraft", "--out", str(out), *options]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    assert "http:" not in page
    assert "https:" not in page
    assert "url(" not in page
    assert "<script" not in page
    return json.loads((out / "metrics.json").read_text()), reader


def test_page_holds_everything_and_agrees(
    use: Use, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    use(ToyEstimator(error=1.0, blind=frozenset({4})))
    metrics, page = evaluated(dataset, tmp_path)
    assert list(metrics["runs"]) == ["oracle", "detected"]
    assert metrics["unknown"] == []
    for protocol, found in metrics["runs"].items():
        assert found["frames"] == 10
        assert found["sequences"] == 2
        assert found["failures"] == {"no_spacecraft": 1}
        assert len(found["keypoints"]) == 13
        for name, statistic in found["metrics"].items():
            if (protocol, name) == ("oracle", "locator_iou"):
                continue
            assert page.values[f"{protocol}.{name}.mean"] == statistic["mean"]
            assert page.values[f"{protocol}.{name}.median"] == statistic["median"]
            assert statistic["low"] <= statistic["mean"] <= statistic["high"]
    assert page.tags.count("img") == 10
    assert page.tags.count("svg") == 10  # no chart of one point or bar: one bin of confidence, no column of the Earth
    assert all(link.startswith("data:image/jpeg;base64,") for link in page.links)
    printed = capsys.readouterr().out
    mean = metrics["runs"]["detected"]["metrics"]["e_t"]["mean"]
    assert f"{mean:.4f}" in printed


def test_truth_scores_zero_and_a_failure_counts(use: Use, dataset: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    metrics, _ = evaluated(dataset, tmp_path / "perfect")
    found = metrics["runs"]["detected"]["metrics"]
    assert found["rmse_px"]["mean"] == pytest.approx(0, abs=1e-4)
    assert found["e_t"]["mean"] == pytest.approx(0, abs=1e-7)
    assert found["e_q_rad"]["mean"] == pytest.approx(0, abs=1e-6)
    assert found["pck_2"]["mean"] == 1
    use(ToyEstimator(blind=frozenset({0, 7})))
    metrics, _ = evaluated(dataset, tmp_path / "blind")
    found = metrics["runs"]["detected"]["metrics"]
    assert found["e_t"]["mean"] == pytest.approx(2 / 10, abs=1e-6)
    assert found["e_q_rad"]["mean"] == pytest.approx(2 * math.pi / 10, abs=1e-5)


def test_every_takes_fewer_frames(use: Use, dataset: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    metrics, page = evaluated(dataset, tmp_path, "--every", "2", "--images", "1")
    assert metrics["runs"]["oracle"]["frames"] == 6
    assert page.tags.count("img") == 3


def test_without_a_locator_only_the_oracle_is_run(use: Use, dataset: Path, tmp_path: Path) -> None:
    use(replace(ToyEstimator(), has_locator=False))
    metrics, _ = evaluated(dataset, tmp_path)
    assert list(metrics["runs"]) == ["oracle"]


def test_lost_image_is_skipped(use: Use, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tests.cli.toy import write_toy_dataset

    use(ToyEstimator())
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=3)
    (root / "data" / "000001" / "image" / "000002.jpg").write_bytes(b"x")
    metrics, _ = evaluated(root, tmp_path / "out")
    assert metrics["runs"]["detected"]["frames"] == 2
    assert "000002.jpg" in metrics["skipped"][0]["failure"]["detail"]
    assert "1 frame skipped" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["[nan, 0, 9]", "[1 + 1, 0, 9]", "[__import__('os').mkdir('{mark}') or 0, 0, 9]"])
def test_a_bad_label_is_skipped_and_never_run(
    text: str, use: Use, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tests.cli.toy import write_toy_dataset

    use(ToyEstimator())
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=3)
    mark, table = tmp_path / "mark", root / "data" / "000001" / "annotations.csv"
    with open(table, newline="") as file:
        rows = list(csv.DictReader(file))
    rows[1]["position"] = text.replace("{mark}", str(mark))
    with open(table, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    metrics, _ = evaluated(root, tmp_path / "out")
    assert metrics["runs"]["detected"]["frames"] == 2
    assert "row 2: position" in metrics["skipped"][0]["failure"]["detail"]
    assert "1 frame skipped" in capsys.readouterr().out
    assert not mark.exists()
    assert run(["predict", str(root), "--spacecraft", "toycraft", "--out", str(tmp_path / "poses")]) == 0
    assert "row 2: position" in (tmp_path / "poses" / "poses.jsonl").read_text(encoding="utf-8")
    assert not mark.exists()


def test_refusals(use: Use, refused: Callable[..., str], dataset: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    model = ("--spacecraft", "toycraft", "--out", out)
    assert "no such dataset" in refused("eval", tmp_path / "none", *model)
    assert "SKD folder" in refused("eval", tmp_path, *model)
    assert "split" in refused("eval", dataset, *model, "--split", "exam")
    assert "no sequence" in refused("eval", dataset, *model, "--split", "train")
    assert "every" in refused("eval", dataset, *model, "--every", "0")
    assert not out.exists()


def test_interrupt_leaves_nothing(
    use: Use, refused: Callable[..., str], dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(ToyEstimator())

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ToyEstimator, "estimate", interrupt)
    refused("eval", dataset, "--spacecraft", "toycraft", "--out", tmp_path / "out", code=130)
    assert not (tmp_path / "out").exists()
