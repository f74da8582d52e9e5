"""onnxruntime stays on this machine, and is given numbers that it can take."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gknet.errors import GknetError
from gknet.inference.load import shipped_models
from gknet.inference.onnx_session import available_providers, open_session

SCRIPT = """
import os, stat, sys
import numpy as np
import gknet
estimator = gknet.load_estimator(sys.argv[1], threads=1)
estimator.estimate(np.zeros((64, 64, 3), np.uint8), gknet.Camera.from_focal(100, 64, 64))
opened = [fd for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")]
print(sum(stat.S_ISSOCK(os.fstat(int(fd)).st_mode) for fd in opened))
"""


@pytest.mark.skipif(not shipped_models(), reason="no model is shipped with this checkout")
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")
def test_no_telemetry(tmp_path: Path) -> None:
    """onnxruntime would write a device id and a database into the home folder, and look up a host."""
    hidden = {"ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"}
    environment = {key: value for key, value in os.environ.items() if key not in hidden} | {"HOME": str(tmp_path)}
    command = [sys.executable, "-c", SCRIPT, shipped_models()[0]]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "0"
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_the_processor_is_always_there() -> None:
    assert "CPUExecutionProvider" in available_providers()


def test_bad_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="expected one of cpu, cuda, got 'tpu'"):
        open_session(b"", device="tpu")
    if "CUDAExecutionProvider" not in available_providers():
        with pytest.raises(GknetError, match="install onnxruntime-gpu"):
            open_session(b"", device="cuda")
    for threads in (0, -3, 1025, 99_999):
        with pytest.raises(GknetError, match="threads: expected a whole number, 1 to 1024"):
            open_session(b"", threads=threads)
    with pytest.raises(GknetError, match="no such model file"):
        open_session(tmp_path / "none.onnx")
    with pytest.raises(GknetError, match="model: not a model that onnxruntime can open"):
        open_session(b"not a model")
