"""What a training tells: metrics.csv, TensorBoard, and a table with the time left."""

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
    """metrics.csv; a column for each value that any row has."""
    others = sorted({name for row in history for name in row} - set(FIRST_COLUMNS))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*FIRST_COLUMNS, *others], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in history)
    write_text(path, text.getvalue())


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


class MetricLogger:
    """Tells each row once: to metrics.csv, to TensorBoard and to the terminal (a line a row where there is none)."""

    def __init__(self, folder: Path, history: list[dict[str, float]], quiet: bool = False) -> None:
        self._folder = folder
        self._history = history
        self._console = Console(quiet=quiet)
        self._live = Live(console=self._console, refresh_per_second=2) if self._console.is_terminal else None
        self._board = SummaryWriter(
            str(folder / "tensorboard"), purge_step=int(history[-1]["samples"]) if history else None
        )

    def __enter__(self) -> MetricLogger:
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()
        self._board.close()

    @property
    def say(self) -> Callable[[str], None]:
        return self._console.print

    def log(self, row: dict[str, float], left_s: float) -> None:
        """A new row of the history, and the seconds that are left."""
        self._history.append(row)
        write_metrics(self._folder / "metrics.csv", self._history)
        for name, value in row.items():
            self._board.add_scalar(name, value, int(row["samples"]))
        if self._live:
            self._live.update(self._table(left_s))
        else:
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
