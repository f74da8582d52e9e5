"""One run a folder at a time."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gknet.errors import GknetError
from gknet.io.lock import locked

HOLDER = """
import sys, time
from gknet.io.lock import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_run_is_refused_and_a_killed_one_frees_the_folder(tmp_path: Path) -> None:
    with locked(tmp_path):
        pass
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, tmp_path], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(GknetError, match="another gknet command"), locked(tmp_path):
            pass
    finally:
        holder.kill()
        holder.wait()
    with locked(tmp_path):
        pass
