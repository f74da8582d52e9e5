"""The release's test set: its labels are fixed to what rounding spares, and a version is judged once."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import ModuleType

import pytest

import gknet
from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
DEMO = Path(gknet.__file__).parent / "demo_data"


@pytest.fixture
def experiment(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("mitsuba")
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    import release_test

    return release_test


@pytest.fixture
def work(tmp_path: Path) -> Path:
    return shutil.copytree(DEMO, tmp_path / "work")


def test_labels_are_held_against_the_manifest(experiment: ModuleType, work: Path, tmp_path: Path) -> None:
    manifest = tmp_path / "manifest.json"
    experiment.check_labels(work, manifest)
    written = manifest.read_text(encoding="utf-8")
    experiment.check_labels(work, manifest)
    assert json.loads(written)["frames"] == len(SkdDataset(work, "test"))
    table = sorted(work.glob("data/*/annotations.csv"))[1]
    text = table.read_text(encoding="utf-8")
    x = text.split('"[')[1].split(",")[0]
    for change, is_same in ((1e-9, True), (1e-3, False)):
        table.write_text(text.replace(x, f"{float(x) + change:.12g}", 1), encoding="utf-8")
        if is_same:
            experiment.check_labels(work, manifest)
        else:
            with pytest.raises(GknetError, match=rf"1 of 3 sequences.*{table.parent.name}"):
                experiment.check_labels(work, manifest)
    assert manifest.read_text(encoding="utf-8") == written


def test_the_shipped_manifest_is_of_all_spacecraft(experiment: ModuleType) -> None:
    manifest = json.loads((experiment.RESULTS / experiment.MANIFEST).read_text(encoding="utf-8"))
    assert (manifest["recipe"], manifest["seed"], manifest["split"], manifest["every"]) == ("skd", 1, "test", 15)
    assert (manifest["frames"], len(manifest["sha256"])) == (1200, 60)


def test_a_version_is_judged_once(experiment: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / gknet.__version__
    experiment.check_unjudged(out, again=False)
    out.mkdir()
    experiment.check_unjudged(out, again=False)
    (out / "satellite_01.json").touch()
    with pytest.raises(GknetError, match=r"judged already.*--again"):
        experiment.check_unjudged(out, again=False)
    experiment.check_unjudged(out, again=True)
