"""The test frames that ship with the package: a few of each spacecraft, in the SKD layout."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from gknet.errors import GknetError


def bundled_frames() -> Path:
    """The folder of the bundled test frames.

    Raises:
        GknetError: This installation has none.
    """
    folder = Path(str(resources.files("gknet") / "demo_data"))
    if not (folder / "test.json").is_file():
        raise GknetError("demo: the bundled test frames are missing; install gknet from a built wheel")
    return folder
