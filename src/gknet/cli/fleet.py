"""`gknet fleet OUT`: build the meshes of the fleet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gknet.cli.terminal import print_line


def fleet(
    out: Annotated[Path, typer.Argument(help="folder for the meshes", file_okay=False)],
    name: Annotated[list[str] | None, typer.Option("--name", help="only this spacecraft; may be repeated")] = None,
) -> None:
    """Build the three spacecraft: OUT/<name>.glb, in metres with PBR materials, and its keypoints in OUT/<name>.toml.

    The same files come out every time; the package ships copies of the .toml files. Needs gknet[render].
    """
    from gknet.fleet import NAMES, build

    for each in name or NAMES:
        spacecraft = build(each, out)
        path = spacecraft.mesh_path
        if path is not None:
            size = path.stat().st_size / 2**20
            points = f"{spacecraft.keypoint_count} keypoints, {len(spacecraft.edges)} edges"
            print_line(f"{path}  {size:.1f} MiB, {spacecraft.diameter_m:.2f} m across, {points}")
