"""The progress of rendering for people: a bar with the time left on a terminal, a line now and then in a log file."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from gknet.io.text import printable
from gknet.render.generate import Progress

LOG_EVERY_S = 30.0
REASONS_SHOWN = 10


class RenderProgress:
    """Writes the progress of rendering jobs, one after the other, to standard error.

    with RenderProgress() as progress:
        generate("skd", "out", on_progress=progress.show)
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._logged_s, self._shown = 0.0, 0
        columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
        self._bar = Bar(
            *columns,
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("rendering", total=None, rate="")

    def __enter__(self) -> RenderProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, progress: Progress) -> None:
        """Update the bar; in a log file, write a line every `LOG_EVERY_S` and one at the end."""
        gone = progress.done + len(progress.failures)
        if gone == 0:
            self._logged_s, self._shown = 0.0, 0
        for reason in progress.failures[self._shown : REASONS_SHOWN]:
            self._print(f"frame failed: {printable(reason)}")
        self._shown = len(progress.failures)
        pace = progress.seconds / max(gone, 1)
        self._bar.update(self._task, total=progress.total, completed=gone, rate=f"{pace:.3f} s/frame")
        is_due = gone == progress.total or progress.seconds - self._logged_s > LOG_EVERY_S
        if not self._console.is_terminal and gone and is_due:
            self._logged_s = progress.seconds
            left = f"{pace * (progress.total - gone) / 60:.0f} min left"
            self._print(f"{gone}/{progress.total} frames, {pace:.3f} s/frame, {left}, {self._shown} failed")

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)
