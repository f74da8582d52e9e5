"""torch's OpenMP starts with the short spin, unless the user has chosen how threads wait."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

pytest.importorskip("torch")

from gknet.io.openmp import SPIN_COUNT

LIBGOMP_DEFAULT = "300000"


def spin_count(module: str, **chosen: str) -> str:
    """What libgomp itself reports when a fresh process imports the module."""
    unset = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    environment = {**unset, **chosen, "OMP_DISPLAY_ENV": "verbose"}
    command = [sys.executable, "-c", f"import {module}"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found = re.search(r"GOMP_SPINCOUNT = '(\d+)'", run.stderr)
    if found is None:
        pytest.skip("this torch has another OpenMP")
    return found[1]


@pytest.mark.parametrize("module", ["gknet.network.gknet", "gknet.training.loop"])
def test_importing_what_uses_torch_sets_it(module: str) -> None:
    assert spin_count(module) == SPIN_COUNT


def test_the_users_choice_wins() -> None:
    assert spin_count("gknet.network.gknet", GOMP_SPINCOUNT="77") == "77"
    assert spin_count("gknet.network.gknet", OMP_WAIT_POLICY="passive") == "0"


def test_torch_alone_has_the_long_spin() -> None:
    """If this fails, torch has changed and the setting may have no purpose any more."""
    assert spin_count("torch") == LIBGOMP_DEFAULT
