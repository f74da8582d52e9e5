"""The metrics of a training: metrics.csv, TensorBoard, and a table with the time left."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.table import Table
from torch.utils.tensorboard import SummaryWriter

from gknet.io.atomic import write_text

ROWS = 12
FIRST_COLUMNS = ("progress", "elapsed_s", "samples", "input_size", "learning_rate", "loss", "images_per_s")


def write_metrics(path: Path, history: list[dict[str, float]]) -> None:
    """Write metrics.csv, with a column for each value that any row has."""
    others = sorted({name for row in history for name in row} - set(FIRST_COLUMNS))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*FIRST_COLUMNS, *others], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in history)
    write_text(path, text.getvalue())


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


class _Console(Console):
    """One that raises when nobody reads it any more; rich's own ends the process."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


class MetricLogger:
    """Logs each row once: to metrics.csv, to TensorBoard, and to the terminal (a line a row where there is none)."""

    def __init__(
        self, folder: Path, history: list[dict[str, float]], is_shown: bool = True, is_written: bool = True
    ) -> None:
        """Open the log of a run.

        Args:
            folder: Of the run.
            history: The rows so far; `log` appends to it.
            is_shown: Whether rows go to standard output.
            is_written: Whether rows go to files.
        """
        self._folder, self._history, self._is_written = folder, history, is_written
        self._console: Console | None = _Console() if is_shown else None
        self._live: Live | None = None
        self._board: SummaryWriter | None = None

    def __enter__(self) -> MetricLogger:
        if self._is_written:
            first = int(self._history[-1]["samples"]) if self._history else None
            self._board = SummaryWriter(str(self._folder / "tensorboard"), purge_step=first)
        if self._console is not None and self._console.is_terminal:
            self._live = Live(console=self._console, refresh_per_second=2)
            self._show(self._live.start)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._show(self._live.stop)
        if self._board is not None:
            self._board.close()

    def log(self, row: dict[str, float], left_s: float) -> None:
        """Add a row to the history.

        Args:
            row: Values by name, "samples" among them.
            left_s: Seconds until the end of the training.
        """
        self._history.append(row)
        if self._is_written:
            write_metrics(self._folder / "metrics.csv", self._history)
        if self._board is not None:
            for name, value in row.items():
                self._board.add_scalar(name, value, int(row["samples"]))
        self._show(lambda: self._print(row, left_s))

    def _show(self, action: Callable[[], object]) -> None:
        """Do what writes to standard output, until it is closed or full: no training ends for that."""
        if self._console is None:
            return
        try:
            action()
        except (OSError, ValueError):  # ValueError: the file object is closed
            self._console = None

    def _print(self, row: dict[str, float], left_s: float) -> None:
        assert self._console is not None
        if self._live is not None:
            self._live.update(self._table(left_s))
            return
        words = "  ".join(f"{name} {_cell(value)}" for name, value in row.items() if name != "elapsed_s")
        self._console.print(f"{words}  left {_clock(left_s)}", soft_wrap=True, highlight=False)

    def _table(self, left_s: float) -> Table:
        rows = self._history[-ROWS:]
        others = sorted({name for row in self._history for name in row} - set(FIRST_COLUMNS))
        names = [name for name in FIRST_COLUMNS if name != "elapsed_s"] + others
        table = Table(*names, caption=f"{_clock(left_s)} left")
        for row in rows:
            table.add_row(*(_cell(row.get(name)) for name in names))
        return table


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(max(0.0, seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
