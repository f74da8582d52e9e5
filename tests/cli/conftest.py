"""Fixtures of the command-line tests: a toy dataset, a toy model behind every name, and a way to run commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from gknet.cli.main import run
from tests.cli.toy import ToyEstimator, write_toy_dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_dataset(tmp_path_factory.mktemp("toy") / "toyset")


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Callable[[ToyEstimator], None]:
    """Put an estimator behind `load_estimator`, whatever name is asked for; unforeseen errors are raised."""
    monkeypatch.setenv("GKNET_DEBUG", "1")

    def put(estimator: ToyEstimator) -> None:
        monkeypatch.setattr("gknet.inference.load.shipped_folder", Path)
        monkeypatch.setattr("gknet.inference.load.load_estimator", lambda name, **options: estimator)

    return put


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Run a command that must end with `code` and one line on standard error; returns the line."""

    def check(*arguments: object, code: int = 2) -> str:
        monkeypatch.setenv("GKNET_DEBUG", "0")
        capfd.readouterr()
        found = run([str(argument) for argument in arguments])
        lines = capfd.readouterr().err.strip().splitlines()
        assert (found, len(lines)) == (code, 1), lines
        assert "Traceback" not in lines[0]
        assert lines[0].startswith("gknet: ")
        return lines[0]

    return check
