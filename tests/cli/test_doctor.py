"""`gknet doctor`: its findings and its exit code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from gknet.cli import doctor
from gknet.cli.doctor import CheckStatus, Finding
from gknet.cli.main import run
from gknet.errors import GknetError
from gknet.inference.crop_estimator import InferenceSettings
from gknet.inference.network_io import NetworkOutput
from gknet.spacecraft import Spacecraft
from tests.cli.toy import toy_spacecraft


@dataclass(frozen=True)
class ToyModel:
    """Networks of `channels` maps."""

    channels: int = 13
    spacecraft: Spacecraft = field(default_factory=toy_spacecraft)
    settings: InferenceSettings = field(default_factory=InferenceSettings)
    locator: object = None

    def keypoint_network(self, images: np.ndarray) -> NetworkOutput:
        return NetworkOutput(np.full((len(images), self.channels, 64, 64), images.mean(), dtype=np.float32))


@pytest.fixture
def model(monkeypatch: pytest.MonkeyPatch) -> Callable[[ToyModel], None]:
    def put(toy: ToyModel) -> None:
        monkeypatch.setattr("gknet.inference.load.shipped_models", lambda: ("toycraft",))
        monkeypatch.setattr("gknet.inference.load.load_estimator", lambda name: toy)

    return put


def test_core_is_well() -> None:
    for finding in (doctor._python(), doctor._core_libraries(), doctor._providers(), doctor._disk()):
        assert finding.status in (CheckStatus.good, CheckStatus.note)
    assert "numpy" in doctor._core_libraries().words
    assert "CPUExecutionProvider" in doctor._providers().words


def test_shipped_models_are_well() -> None:
    findings = list(doctor._models())
    assert [finding.what for finding in findings] == [f"model satellite_0{k}" for k in (1, 2, 3)]
    assert all(finding.status is CheckStatus.good for finding in findings), findings


def test_model_is_run(model: Callable[[ToyModel], None]) -> None:
    model(ToyModel())
    (finding,) = doctor._models()
    assert finding.status is CheckStatus.good
    assert "keypoints 13 x 64 x 64" in finding.words


def test_model_of_another_shape_is_bad(model: Callable[[ToyModel], None]) -> None:
    model(ToyModel(channels=12))
    (finding,) = doctor._models()
    assert finding.status is CheckStatus.bad
    assert "expected 13 finite maps" in finding.words


def test_a_missing_extra_is_a_note_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_versions", lambda packages: ({}, list(packages)))
    finding = doctor._extra("train")
    assert (finding.status, finding.words) == (CheckStatus.note, "not installed")
    assert "pip install '.[train]' in a clone, else pip install 'gknet[train]'" in finding.remedy
    assert doctor._renderer().status is CheckStatus.note
    assert doctor._core_libraries().status is CheckStatus.bad


def test_renderer_without_llvm_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba")
    monkeypatch.setattr("gknet.render.scene.choose_variant", lambda: "scalar_rgb")
    assert doctor._renderer().status is CheckStatus.note

    def broken() -> str:
        raise GknetError("no variant works")

    monkeypatch.setattr("gknet.render.scene.choose_variant", broken)
    assert doctor._renderer().status is CheckStatus.bad


def test_exit_codes(
    monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str], capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "examine", lambda: [Finding("disk", CheckStatus.note, "[full]", "pip install 'x[y]'")])
    assert run(["doctor"]) == 0
    printed = capfd.readouterr().out
    assert "[full]" in printed
    assert "'x[y]'" in printed
    monkeypatch.setattr(doctor, "examine", lambda: [Finding("models", CheckStatus.bad, "none")])
    assert refused("doctor") == "gknet: doctor: 1 of 1 checks failed: models"
