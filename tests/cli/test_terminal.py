"""What becomes of the terminal ends no work: closed and full streams, and characters that it lacks."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gknet.cli.main import run
from gknet.cli.terminal import LastingStream, lasting_output, print_line, print_warning

CODE = """
import sys
from gknet.cli import main
def examine():
    for k in range(20_000):
        main.print_line(f"line {k} \\u885b")
    print("worked", file=sys.__stderr__)
    return iter(())
from gknet.cli.terminal import print_line
main.print_line = print_line
import gknet.cli.doctor
gknet.cli.doctor.examine = examine
sys.exit(main.run(["doctor"]))
"""


def shell(pipeline: str, **environment: str) -> tuple[int, str]:
    """The exit code of the first command of a pipeline and its standard error."""
    script = (
        f"set -o pipefail; {pipeline.replace('COMMAND', chr(34) + '$0' + chr(34) + ' -c ' + chr(34) + '$1' + chr(34))}"
    )
    done = subprocess.run(
        ["bash", "-c", script, sys.executable, CODE], capture_output=True, text=True, env={**os.environ, **environment}
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize("pipeline", ["COMMAND | head -1", "COMMAND | true", "COMMAND >&-", "COMMAND > /dev/null"])
def test_a_reader_that_goes_away_ends_no_work(pipeline: str) -> None:
    assert shell(pipeline) == (0, "worked\n")


def test_a_full_output_ends_no_work_and_is_reported() -> None:
    code, words = shell("COMMAND > /dev/full")
    assert code == 2
    assert words == "worked\ngknet: standard output: No space left on device; the work is done\n"


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "latin-1"])
def test_a_terminal_that_lacks_a_character_gets_an_escape(encoding: str) -> None:
    code, words = shell("COMMAND | grep -c 'u885b' >&2", PYTHONIOENCODING=encoding)
    assert code == 0
    assert words.splitlines() == ["worked", "20000"]


class Broken(io.StringIO):
    def write(self, text: str) -> int:
        raise OSError(errno.EIO, "Input/output error")


def test_a_broken_stream_is_left_alone_after_its_first_error() -> None:
    stream = LastingStream(Broken())
    for _ in range(3):
        assert stream.write("abc") == 3
        stream.flush()
    assert stream.failure is not None
    assert stream.failure.errno == errno.EIO


def test_streams_are_put_back() -> None:
    before = sys.stdout, sys.stderr
    with lasting_output() as output:
        assert sys.stdout is output
    assert (sys.stdout, sys.stderr) == before


def test_names_move_no_cursor(capsys: pytest.CaptureFixture[str]) -> None:
    print_line("a\x1b[31m[red]b")
    print_warning("a\nb\udce9")
    captured = capsys.readouterr()
    assert captured.out == "a\\x1b[31m[red]b\n"
    assert captured.err == "gknet: warning: a\\x0ab\\xe9\n"


@pytest.mark.parametrize(
    ("command", "words"),
    [("fleet", "gknet[render]"), ("predict", "[default: predictions]"), ("eval", "[default: evaluation]")],
)
def test_help_keeps_square_brackets(
    command: str, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert run([command, "--help"]) == 0
    assert words in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "usage"), [("predict", "predict [OPTIONS] INPUT..."), ("eval", "eval [OPTIONS] DATA")]
)
def test_the_usage_line_is_that_of_other_programs(
    command: str, usage: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert run([command, "--help"]) == 0
    assert f"Usage: gknet {usage}  " in capsys.readouterr().out


def test_errors_show_no_control_character(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GKNET_DEBUG", "0")
    name = str(tmp_path / "a\x1b(\udce9.jpg")
    assert run(["predict", name, "--spacecraft", "satellite_01", "--focal-px", "9"]) == 2
    words = capfd.readouterr().err
    assert "\x1b" not in words
    assert "a\\x1b(\\xe9.jpg" in words
