"""onnxruntime: the one place that imports it, and how its sessions are set up."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault(
    "ORT_DISABLE_TELEMETRY", "1"
)  # read when onnxruntime is loaded; else it looks up a host and writes files

import onnxruntime

from gknet.errors import GknetError

PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
"""Names of devices, and what onnxruntime calls them."""

MAX_THREADS = 1024


def available_providers() -> list[str]:
    """What this installation of onnxruntime can run on, in its own words."""
    return list(onnxruntime.get_available_providers())


def open_session(model: Path | bytes, threads: int | None = None, device: str = "cpu") -> onnxruntime.InferenceSession:
    """A session that runs an ONNX model.

    Its threads sleep while they wait. By default they spin, and those of the locator and of the other network spin
    against each other: three times the processor time for a pose on two threads, and twice to three times as long on a
    busy machine.

    Args:
        model: The file, or its content.
        threads: Of one call, 1 to 1024; None leaves the choice to onnxruntime (every core).
        device: "cpu", or "cuda" with the package onnxruntime-gpu.

    Raises:
        GknetError: An unknown device or one that is missing here, a number of threads out of range, a file that is
            missing or that onnxruntime cannot open.
    """
    if device not in PROVIDERS:
        raise GknetError(f"device: expected one of {', '.join(PROVIDERS)}, got '{device}'")
    if PROVIDERS[device] not in available_providers():
        raise GknetError(f"device {device}: this onnxruntime cannot use it; install onnxruntime-gpu")
    if threads is not None and not (isinstance(threads, int) and 1 <= threads <= MAX_THREADS):
        raise GknetError(f"threads: expected a whole number, 1 to {MAX_THREADS}, got {threads}")
    if isinstance(model, Path) and not model.is_file():
        raise GknetError(f"{model}: no such model file")
    options = onnxruntime.SessionOptions()
    options.inter_op_num_threads = 1
    options.intra_op_num_threads = threads or 0
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        given = model if isinstance(model, bytes) else str(model)
        return onnxruntime.InferenceSession(given, options, providers=[PROVIDERS[device]])
    except Exception as error:  # onnxruntime's exceptions have no common base
        name = "model" if isinstance(model, bytes) else str(model)
        reason = (str(error).splitlines() or ["no reason given"])[0]
        raise GknetError(f"{name}: not a model that onnxruntime can open ({reason})") from error
