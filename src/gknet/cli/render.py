"""`gknet render`: frames with exact labels from a recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def render(
    out: Annotated[Path, typer.Argument(help="Folder to render into; a job that was stopped goes on where it was.")],
    recipe: Annotated[str, typer.Option(help="skd, skd-hard, or a recipe's .toml.")] = "skd",
    seed: Annotated[int, typer.Option(help="The same seed gives the same frames.")] = 0,
    spacecraft: Annotated[str | None, typer.Option(help="Names, separated by commas; all by default.")] = None,
    split: Annotated[str | None, typer.Option(help="train, val or test; all by default.")] = None,
    sequences: Annotated[int | None, typer.Option(help="At most so many sequences of each spacecraft.")] = None,
    every: Annotated[int, typer.Option(help="Render every n-th frame of a sequence.")] = 1,
    first: Annotated[int, typer.Option(help="The first frame of each sequence, from 0.")] = 0,
    frames: Annotated[int | None, typer.Option(help="At most so many frames of each sequence.")] = None,
    window: Annotated[str, typer.Option(help="frame: the whole picture; target: a square around the craft.")] = "frame",
    size: Annotated[int | None, typer.Option(help="Pixels of a side [frame: 1024, target: at most 320].")] = None,
    spp: Annotated[int, typer.Option(help="Samples per pixel: 4, 8, 16 or 64.")] = 8,
    shard: Annotated[str, typer.Option(help="i/n: only the i-th of n parts, i from 0, for job arrays.")] = "0/1",
    workers: Annotated[int, typer.Option(help="Processes; 1 renders in this one with all cores.")] = 2,
    mask: Annotated[bool | None, typer.Option(help="Write masks [frame: yes, target: no].")] = None,
    depth: Annotated[bool, typer.Option(help="Write depth maps.")] = False,
) -> None:
    """Render a dataset in the SKD layout, with poses, keypoint visibility and a contact sheet."""
    from gknet.errors import GknetError
    from gknet.render.generate import generate
    from gknet.render.plan import parse_shard

    result = generate(
        recipe,
        out,
        seed=seed,
        spacecraft=spacecraft,
        split=split,
        sequences=sequences,
        every=every,
        first=first,
        frames=frames,
        window=window,
        size=size,
        spp=spp,
        shard=parse_shard(shard),
        workers=workers,
        mask=mask,
        depth=depth,
    )
    typer.echo(
        f"{result.out}: {result.rendered} frames rendered in {result.seconds:.0f} s, "
        f"{result.kept} were there, {len(result.failures)} failed"
    )
    if result.failures:
        raise GknetError(
            f"{len(result.failures)} frames failed, the first: {result.failures[0]}; run again to try them again"
        )
