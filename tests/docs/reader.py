"""A reader's terminal: the repository's gknet and python, in a folder of the test's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.docs.pages import ROOT


def terminal(folder: Path) -> dict[str, str]:
    """An environment in which `gknet` and `python` are this installation's."""
    programs = folder / ".programs"
    programs.mkdir(exist_ok=True)
    for name, words in (("gknet", "-m gknet.cli.main"), ("python", "")):
        script = programs / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n', encoding="utf-8")
        script.chmod(0o755)
    path = os.pathsep.join([str(ROOT / "src"), str(ROOT)])
    return {**os.environ, "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": path}


def read(page: str, folder: Path, *languages: str) -> str:
    """Run a page's blocks in `folder`; what they print."""
    command = [sys.executable, "-m", "tests.docs.run_page", str(ROOT / "docs" / page), *languages]
    run = subprocess.run(command, cwd=folder, env=terminal(folder), capture_output=True, text=True, timeout=1800)
    assert run.returncode == 0, f"{page}\n{run.stdout[-3000:]}\n{run.stderr[-3000:]}"
    return run.stdout
