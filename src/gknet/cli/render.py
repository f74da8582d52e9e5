"""`gknet render`: frames with exact labels from a recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gknet.cli.dataclass_options import with_options
from gknet.cli.terminal import print_line
from gknet.render.options import Options, Selection, parse_names, parse_shard


@with_options(Selection, parsers={"spacecraft": parse_names, "shard": parse_shard}, panel="Which frames")
@with_options(Options, panel="How they are rendered")
def render(
    out: Annotated[Path, typer.Argument(help="Folder to render into; a job that was stopped goes on where it was.")],
    selection: Selection,
    options: Options,
    recipe: Annotated[str, typer.Option(help="skd, skd-hard, or a recipe's .toml.")] = "skd",
    workers: Annotated[int, typer.Option(help="Processes; 1 renders in this one with all cores.")] = 2,
) -> None:
    """Render a dataset in the SKD layout, with poses, keypoint visibility and a contact sheet."""
    from gknet.errors import GknetError
    from gknet.io.text import counted
    from gknet.render.generate import generate
    from gknet.render.render_progress import RenderProgress

    with RenderProgress() as progress:
        result = generate(recipe, out, options, selection, workers, on_progress=progress.show)
    print_line(
        f"{result.out}: {counted(result.rendered, 'frame')} rendered in {result.render_seconds:.0f} s, "
        f"{result.kept} were there, {len(result.failures)} failed; {result.seconds:.0f} s with all preparation"
    )
    if result.failures:
        raise GknetError(
            f"{counted(len(result.failures), 'frame')} failed, the first: {result.failures[0]}; "
            "run again to try them again"
        )
