"""How a rendering job gets on: a bar with the time left on a terminal, a line now and then in a log file."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

LOG_EVERY_S = 30.0
REASONS_SHOWN = 10


class Progress:
    """A context; `add` what was done."""

    def __init__(self, total: int) -> None:
        self.total, self.done, self.failed = total, 0, 0
        self._console = Console(stderr=True)
        self._started = self._logged = time.monotonic()
        columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
        self._bar = Bar(
            *columns,
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("rendering", total=total, rate="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def add(self, done: int, failures: Sequence[str]) -> None:
        for reason in failures[: max(0, REASONS_SHOWN - self.failed)]:
            self._console.print(f"frame failed: {reason}", markup=False, highlight=False, soft_wrap=True)
        self.done += done
        self.failed += len(failures)
        gone = self.done + self.failed
        pace = (time.monotonic() - self._started) / max(gone, 1)
        self._bar.update(self._task, completed=gone, rate=f"{pace:.3f} s/frame")
        if not self._console.is_terminal and (gone == self.total or time.monotonic() - self._logged > LOG_EVERY_S):
            self._logged = time.monotonic()
            left = f"{pace * (self.total - gone) / 60:.0f} min left"
            text = f"{gone}/{self.total} frames, {pace:.3f} s/frame, {left}, {self.failed} failed"
            self._console.print(text, highlight=False, soft_wrap=True)
