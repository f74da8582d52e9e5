"""The command as a whole: help, exit codes, one line for what went wrong."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gknet.cli.main import run

COMMANDS = ("render", "train", "export", "predict", "eval", "demo", "doctor", "fleet")


def fails_with(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    """Make `gknet doctor` raise."""

    def raising() -> None:
        raise error

    monkeypatch.setattr("gknet.cli.doctor.examine", raising)


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    words = capsys.readouterr().out.split()
    assert set(COMMANDS) <= set(words)


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([command, "--help"]) == 0
    assert command in capsys.readouterr().out


def test_help_is_fast() -> None:
    """0.5 s of processor time beyond an empty process, whatever else the machine is doing; best of two."""

    def seconds(code: str) -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    helped = "import sys; from gknet.cli.main import run; sys.exit(run(['--help']))"
    best = min(seconds(helped) for _ in range(2)) - seconds("pass")
    print(f"gknet --help: {best:.2f} s")
    assert best < 0.5


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    from gknet import __version__

    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"gknet {__version__}\n"


def test_unknown_command_and_option(refused: Callable[..., str]) -> None:
    assert "nonsense" in refused("nonsense")
    assert "--nonsense" in refused("doctor", "--nonsense")
    assert "INPUT" in refused("predict")
    assert "every" in refused("predict", "x", "--every", "often")


def test_interrupt_is_130(monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]) -> None:
    fails_with(monkeypatch, KeyboardInterrupt())
    assert refused("doctor", code=130) == "gknet: interrupted"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_stop_signals_end_in_one_line(
    number: int, code: int, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
    monkeypatch.setattr("gknet.cli.doctor.examine", lambda: os.kill(os.getpid(), number))
    assert refused("doctor", code=code) == "gknet: interrupted"


def test_full_disk_says_so(monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]) -> None:
    fails_with(monkeypatch, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/out/poses.jsonl"))
    assert refused("doctor") == "gknet: /out/poses.jsonl: No space left on device; free some space and run it again"


@pytest.mark.parametrize(
    ("module", "extra"), [("torch", "train"), ("mitsuba", "render"), ("lightning_fabric", "train")]
)
def test_missing_extra_names_the_install(
    module: str, extra: str, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
    fails_with(monkeypatch, ModuleNotFoundError(f"No module named '{module}'", name=f"{module}.part"))
    assert f"pip install 'gknet[{extra}]'" in refused("doctor")


def test_own_faults_are_told_apart(monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]) -> None:
    fails_with(monkeypatch, ZeroDivisionError("division\nby zero"))
    assert refused("doctor", code=1) == (
        "gknet: a fault in gknet: ZeroDivisionError: division by zero; GKNET_DEBUG=1 shows where"
    )
    monkeypatch.setenv("GKNET_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        run(["doctor"])


def test_process_exits_with_the_code(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gknet.cli.main", "predict", str(tmp_path / "none.jpg"), "--spacecraft", "nobody"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "nobody" in done.stderr


@pytest.mark.parametrize("folder", ["experiments", "benchmarks", "examples"])
def test_no_command_is_taken_for_a_library(folder: str) -> None:
    for path in (Path(__file__).parents[2] / folder).rglob("*.py"):
        assert "gknet.cli" not in path.read_text(encoding="utf-8"), path
