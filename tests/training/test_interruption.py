"""A run that is stopped and resumed ends exactly as the run that never stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")

import torch

import gknet.training.learner as learner
import gknet.training.loop as loop
from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.io.interrupt import Interrupted
from gknet.io.lock import locked
from gknet.training.checkpoint import BEST, CHECKPOINT, load_weights
from gknet.training.run_file import load_run
from gknet.training.schedule import Stage
from gknet.training.settings import TrainSettings
from gknet.training.train import train

SETTINGS = TrainSettings(
    network="locator",
    samples=36,
    stages=(Stage(0.5, 32, 4), Stage(0.5, 64, 4)),
    precision="32-true",
    device="cpu",
    cache_size=96,
    val_frames=2,
    validations=3,
)
STEPS = 9
FRAMES_READ = 2 + 3 * 2
"""Of the val split: once before the training and once in each validation."""


@pytest.fixture(autouse=True)
def frequent_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "REPORT_STEPS", 2)


@pytest.fixture(scope="module")
def straight(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "straight"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "REPORT_STEPS", 2)
        train(data, "satellite_01", out, SETTINGS, quiet=True)
    return out


def result(out: Path) -> dict[str, Any]:
    """All of a run but its times."""
    content = torch.load(out / CHECKPOINT, weights_only=True)
    state = {name: value for name, value in content["state"].items() if name != "elapsed_s"}
    state["history"] = [
        {name: value for name, value in row.items() if name not in ("elapsed_s", "images_per_s")}
        for row in state["history"]
    ]
    best = json.loads((out / "run.json").read_text())["best"]
    return {**content, "state": state, "best": best, "weights": load_weights(out / BEST)}


def assert_same(first: object, second: object, place: str = "") -> None:
    if isinstance(first, dict) and isinstance(second, dict):
        assert first.keys() == second.keys(), place
        for name in first:
            assert_same(first[name], second[name], f"{place}.{name}")
    elif isinstance(first, torch.Tensor) and isinstance(second, torch.Tensor):
        assert torch.equal(first, second), place
    else:
        assert first == second, place


def interrupting(function: Callable[..., Any], at: set[int]) -> Callable[..., Any]:
    """The function, with a Ctrl-C in those of its calls, counted from 1 over all runs."""
    calls = 0

    def run(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls in at:
            os.kill(os.getpid(), signal.SIGINT)
        return function(*arguments, **options)

    return run


def trained_in_parts(data: Path, out: Path, settings: TrainSettings = SETTINGS) -> int:
    """Resume until the run is through; how often it was interrupted."""
    for count in range(100):
        try:
            train(data, "satellite_01", out, settings, resume=count > 0, quiet=True)
        except Interrupted:
            continue
        return count
    raise AssertionError("it never ends")


@pytest.mark.parametrize(
    ("owner", "name", "at"),
    [
        (learner.Learner, "step", {1}),
        (learner.Learner, "step", {5, 6}),
        (learner.Learner, "step", set(range(1, STEPS + 1))),
        (SkdDataset, "__getitem__", {2 + 1, 2 + 2 + 2 + 1}),  # the first validation, then in the next run
        (SkdDataset, "__getitem__", {FRAMES_READ - 1}),  # the last validation
        (loop, "save_checkpoint", {1, 3}),
        (loop, "save_weights", {1}),
    ],
    ids=["first step", "two steps", "every step", "a validation, twice", "last validation", "saving", "keeping"],
)
def test_an_interrupted_run_resumes_to_the_same_result(
    owner: Any, name: str, at: set[int], data: Path, straight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, name, interrupting(getattr(owner, name), at))
    assert trained_in_parts(data, tmp_path / "run") >= len(at)
    assert_same(result(straight), result(tmp_path / "run"))
    assert (tmp_path / "run" / "metrics.csv").read_text().count("\n") == (straight / "metrics.csv").read_text().count(
        "\n"
    )


def test_a_second_signal_ends_at_once_and_the_checkpoint_is_still_of_a_whole_step(
    data: Path, straight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true_update = learner.update_average

    def interrupted_twice(*arguments: Any) -> None:  # in the middle of a step
        if state_of(tmp_path / "run"):
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        true_update(*arguments)

    monkeypatch.setattr(learner, "update_average", interrupted_twice)
    with pytest.raises(Interrupted):
        train(data, "satellite_01", tmp_path / "run", SETTINGS, quiet=True)
    monkeypatch.setattr(learner, "update_average", true_update)
    assert state_of(tmp_path / "run")["samples"] == 12
    train(data, "satellite_01", tmp_path / "run", SETTINGS, resume=True, quiet=True)
    assert_same(result(straight), result(tmp_path / "run"))


def state_of(out: Path) -> dict[str, Any]:
    path = out / CHECKPOINT
    return torch.load(path, weights_only=True)["state"] if path.exists() else {}


def test_a_kill_between_the_weights_and_the_checkpoint_leaves_weights_and_record_agreeing(
    data: Path, straight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, saved = tmp_path / "run", loop.save_weights

    def killed(*arguments: Any) -> None:
        saved(*arguments)
        raise MemoryError

    with pytest.raises(Interrupted):
        train(data, "satellite_01", out, SETTINGS, quiet=True, on_step=lambda _: os.kill(os.getpid(), signal.SIGINT))
    monkeypatch.setattr(loop, "save_weights", killed)
    with pytest.raises(MemoryError):
        train(data, "satellite_01", out, SETTINGS, resume=True, quiet=True)
    best = load_run(out).best
    assert best is not None
    assert (best["samples"], state_of(out)["samples"]) == (12, 4)
    monkeypatch.setattr(loop, "save_weights", saved)
    train(data, "satellite_01", out, SETTINGS, resume=True, quiet=True)
    assert_same(result(straight), result(out))


WORDS: tuple[str, ...] = (
    "--spacecraft",
    "satellite_01",
    "--network",
    "locator",
    "--samples",
    "36",
    "--stages",
    "0.5:32:4,0.5:64:4",
)
WORDS += ("--precision", "32-true", "--device", "cpu", "--cache-size", "96", "--val-frames", "2", "--validations", "3")
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
SLOWLY = """
import time
import gknet.training.loop as loop
from gknet.cli.main import main
loop.REPORT_STEPS, true_step = 2, loop.Trainer.step
def step(trainer, batch):
    true_step(trainer, batch)
    time.sleep(0.3)
loop.Trainer.step = step
main()
"""


def terminated(command: list[str], out: Path) -> list[str]:
    """Run a training, send it SIGTERM after its first checkpoint; what it prints on standard error."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=ENVIRONMENT) as process:
        while process.poll() is None and not (out / CHECKPOINT).exists():
            time.sleep(0.02)
        process.terminate()
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, errors
    return errors.decode().splitlines()


def test_sigterm_saves_and_ends_with_its_code(data: Path, straight: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-c", SLOWLY, "train", str(data), *WORDS, "--out", str(out)]
    assert len(terminated(command, out)) == 1
    assert 0 < state_of(out)["samples"] < 36
    train(data, "satellite_01", out, SETTINGS, resume=True, quiet=True)
    assert_same(result(straight), result(out))


@pytest.mark.slow
def test_two_processes_stop_after_the_same_step(data: Path, tmp_path: Path) -> None:
    """DDP on the CPU; the signal reaches one of them."""
    script, out = tmp_path / "slowly.py", tmp_path / "run"  # a file: the first process starts the second one from it
    script.write_text(SLOWLY)
    command = [sys.executable, str(script), "train", str(data), *WORDS, "--devices", "2", "--samples", "48", "--out"]
    terminated([*command, str(out)], out)
    assert 0 < state_of(out)["samples"] < 48
    for words in ([str(out), "--resume"], [str(tmp_path / "straight")]):
        run = subprocess.run([*command, *words], env=ENVIRONMENT, check=True, capture_output=True, text=True)
        assert run.stdout.count("best:") == 1
    assert_same(result(tmp_path / "straight"), result(out))


def test_two_trainings_never_write_into_one_folder(data: Path, straight: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with locked(tmp_path / "run"), pytest.raises(GknetError, match="another gknet command"):
        train(data, "satellite_01", tmp_path / "run", SETTINGS, quiet=True)
    with locked(straight), pytest.raises(GknetError, match="another gknet command"):
        train(data, "satellite_01", straight, SETTINGS, resume=True, quiet=True)


@pytest.mark.parametrize("output", ["closed", "full"])
def test_nobody_reading_the_output_ends_no_training(output: str, data: Path, straight: Path, tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open("/dev/full", "wb") as full:
        stdout = full if output == "full" else writer
        command = [sys.executable, "-m", "gknet.cli.main", "train", str(data), *WORDS, "--out", str(tmp_path / "run")]
        subprocess.run(command, stdout=stdout, timeout=120, check=False)
    os.close(writer)
    assert state_of(tmp_path / "run")["samples"] == 36
    assert torch.equal(
        load_weights(tmp_path / "run" / BEST)["encoder.stem.conv.weight"],
        load_weights(straight / BEST)["encoder.stem.conv.weight"],
    )
