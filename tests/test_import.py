"""Importing gknet is cheap and its names are there."""

from __future__ import annotations

import subprocess
import sys

import pytest

import gknet

HEAVY = ["torch", "mitsuba", "trimesh", "cv2", "onnxruntime", "scipy", "poselib", "lightning_fabric", "matplotlib"]
EXTRAS = ["torch", "mitsuba", "trimesh", "lightning_fabric", "onnx", "safetensors"]


def loaded_after(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_import_loads_nothing_heavy() -> None:
    assert not loaded_after("import gknet") & set(HEAVY)


def test_the_runtime_needs_no_extra() -> None:
    everything = "import gknet, gknet.metrics\nfor name in gknet.__all__: getattr(gknet, name)"
    assert not loaded_after(everything) & set(EXTRAS)


@pytest.mark.slow
def test_import_takes_under_half_a_second() -> None:
    code = "import time; s = time.perf_counter(); import gknet; print(time.perf_counter() - s)"
    times = [float(subprocess.check_output([sys.executable, "-c", code])) for _ in range(3)]
    assert min(times) < 0.5


def test_every_name_is_there() -> None:
    for name in gknet.__all__:
        assert getattr(gknet, name).__name__ == name
        assert name in dir(gknet)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = gknet.nothing
