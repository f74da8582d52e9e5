"""The three spacecraft of the dataset: their keypoints are at hand always, their meshes are built with [render].

The .toml files here are copies of what `build` writes: `gknet fleet OUT && cp OUT/*.toml src/gknet/fleet/`.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path

from gknet.errors import GknetError, MissingExtraError
from gknet.io.spacecraft_file import load_spacecraft
from gknet.spacecraft import Spacecraft

NAMES = ("satellite_01", "satellite_02", "satellite_03")


def _known(name: str) -> str:
    if name not in NAMES:
        raise GknetError(f"fleet: no spacecraft '{name}'; expected one of {', '.join(NAMES)}")
    return name


def load(name: str) -> Spacecraft:
    """A spacecraft of the fleet by its shipped .toml; its mesh_path is None unless the GLB is beside it.

    Raises:
        GknetError: The fleet has no spacecraft of that name.
    """
    spacecraft = load_spacecraft(Path(__file__).parent / f"{_known(name)}.toml")
    if spacecraft.mesh_path is not None and not spacecraft.mesh_path.exists():
        return replace(spacecraft, mesh_path=None)
    return spacecraft


def build(name: str, folder: str | Path) -> Spacecraft:
    """Write <folder>/<name>.glb and <name>.toml, the same bytes every time.

    Raises:
        GknetError: The fleet has no spacecraft of that name.
        MissingExtraError: The extra `render` is not installed.
    """
    module = f"gknet.fleet.{_known(name)}"
    try:
        craft = import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtraError("render", str(error.name)) from error
    return craft.model().save(Path(folder))
