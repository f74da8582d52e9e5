"""Files written by torch.save, read as data: whatever else a pickle holds is refused and never run."""

from __future__ import annotations

import warnings
from pathlib import Path

from gknet.errors import GknetError, MissingExtraError


def load_torch_file(path: Path) -> object:
    """The content of a file that torch.save wrote.

    Args:
        path: The file.

    Returns:
        Tensors on the CPU, numbers, texts, lists and dicts of them.

    Raises:
        GknetError: The file cannot be read, or holds anything else.
        MissingExtraError: torch is not installed.
    """
    import gknet.io.openmp  # noqa: F401 (before torch)

    try:
        import torch
    except ImportError as error:
        raise MissingExtraError("train", "torch") from error
    if Path(path).exists() and not Path(path).is_file():
        raise GknetError(f"{path}: expected a file, got a folder or a pipe")
    try:
        with warnings.catch_warnings(action="ignore"):
            return torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise GknetError(f"{path}: cannot be read ({error})") from error
    except Exception as error:  # torch.load raises whatever its unpickler meets
        raise GknetError(f"{path}: not readable: it is damaged, or holds more than data and is not loaded") from error
