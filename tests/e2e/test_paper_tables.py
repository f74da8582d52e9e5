"""The recipe of the paper's tables from rendering to Markdown, at its smallest scale: every stage runs and resumes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from gknet.fleet import NAMES

pytest.importorskip("mitsuba")
pytest.importorskip("torch")
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
CRAFT = "satellite_02"
METHODS = ("gknet-xs", "hrnet-xs", "resunet-xs", "dmanet-xs", "gknet-xs_identity", "gknet-xs_random", "gknet-xs_none")


def recipe(name: str, *words: object) -> str:
    command = [sys.executable, str(ROOT / "experiments" / name), *map(str, words)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert run.returncode == 0, f"{run.stdout[-2000:]}\n{run.stderr[-3000:]}"
    return run.stdout


def test_smoke(tmp_path: Path) -> None:
    words = ("--scale", "smoke", "--work", tmp_path / "work", "--results", tmp_path / "results")
    recipe("paper_tables.py", *words, "--spacecraft", CRAFT)
    folder = tmp_path / "results" / "smoke"
    kept = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.json")}
    assert set(kept) == {f"{CRAFT}_{method}_0.json" for method in METHODS}
    for path in folder.glob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        assert content["samples"] == content["curve"][-1][0] > 0
        assert 0 < content["curve"][-1][1] < 256
        protocols = content["protocols"]
        heatmaps = content["name"] != "DMANet"
        assert set(protocols) == ({"oracle", "detected", "paper"} if heatmaps else {"oracle", "detected"})
        frames = [protocol["frames"] for protocol in protocols.values()]
        assert all(each == frames[0] for each in frames)
        assert len(frames[0]) >= 10
        assert all(len(protocol["values"]["e_t"]) == len(frames[0]) for protocol in protocols.values())

    recipe("paper_tables.py", *words, "--spacecraft", CRAFT)  # all is there: nothing is made again
    assert kept == {path.name: path.stat().st_mtime_ns for path in folder.glob("*.json")}

    text = recipe("paper_report.py", "--scale", "smoke", "--results", tmp_path / "results")
    assert text.strip() == (folder / "README.md").read_text(encoding="utf-8").strip()
    for words_of_a_table in ("Table 1", "Table 2", "Table 3", "Swaps", "29.11", "0.763"):
        assert words_of_a_table in text
    assert "nan" not in text
    assert f"({CRAFT}.svg)" in text
    assert "GKNet, no edges" in (folder / f"{CRAFT}.svg").read_text(encoding="utf-8")
    for table in text.split("## ")[1:]:
        title = table.split("\n")[0]
        told = ("Cost", "training", "Table 1, RMSE in px: ours", "Hidden", "Table 2", "DMANet")
        assert ("DMANet" in table) == any(words in title for words in told), title
        if "Table 2" in title:
            (direct,) = (line for line in table.splitlines() if line.startswith("| DMANet"))
            assert "not run" not in direct.split("|")[2 + NAMES.index(CRAFT)], title
