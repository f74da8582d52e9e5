"""Ctrl-C, SIGTERM (clusters) and SIGHUP (a closed terminal), which all mean: keep what there is, and end.

The command line turns the last two into a KeyboardInterrupt (`as_keyboard_interrupt`). A loop whose steps must not be
cut in the middle opens an `Interruption` and checks its flag between two steps:

    with Interruption() as interruption:
        for item in items:
            if interruption.requested:
                break
            step(item)
    save()
    interruption.raise_if_requested()
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

_Handlers = dict[signal.Signals, Any]


class Interrupted(KeyboardInterrupt):
    """A KeyboardInterrupt that knows its signal.

    Attributes:
        signal_number: SIGINT, SIGTERM or SIGHUP.
        detail: What was kept and how to go on, for the line that ends the command; it may be empty.
    """

    def __init__(self, signal_number: int = signal.SIGINT, detail: str = "") -> None:
        super().__init__(signal_number, detail)
        self.signal_number, self.detail = signal_number, detail

    def __str__(self) -> str:
        return f"interrupted; {self.detail}" if self.detail else "interrupted"

    @property
    def exit_code(self) -> int:
        """As a shell counts: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + self.signal_number


class Interruption:
    """While it is open, the first stop signal sets `requested`; a second one raises `Interrupted` at once.

    Outside of the main thread, where Python allows no signal handlers, it never sets anything. A signal that the
    process ignores (`nohup`) stays ignored.
    """

    def __init__(self) -> None:
        self._signal_number: int | None = None
        self._before: _Handlers = {}

    @property
    def requested(self) -> bool:
        """Whether a stop signal came."""
        return self._signal_number is not None

    def raise_if_requested(self, detail: str = "") -> None:
        """Raise `Interrupted`, with its `detail`, when a stop signal came."""
        if self._signal_number is not None:
            raise Interrupted(self._signal_number, detail)

    def _note(self, signal_number: int, frame: FrameType | None) -> None:
        if self._signal_number is not None:
            raise Interrupted(signal_number)
        self._signal_number = signal_number

    def __enter__(self) -> Interruption:
        self._before = _handle(self._note, STOP_SIGNALS)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _restore(self._before)


@contextmanager
def as_keyboard_interrupt() -> Iterator[None]:
    """SIGTERM and SIGHUP raise `Interrupted` in the main thread, as Ctrl-C raises KeyboardInterrupt."""

    def interrupt(signal_number: int, frame: FrameType | None) -> None:
        raise Interrupted(signal_number)

    before = _handle(interrupt, STOP_SIGNALS)
    try:
        yield
    finally:
        _restore(before)


def _handle(handler: Any, signals: tuple[signal.Signals, ...]) -> _Handlers:
    """Install a handler for those signals that are not ignored; what was there before."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    wanted = [number for number in signals if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    return {number: signal.signal(number, handler) for number in wanted}


def _restore(before: _Handlers) -> None:
    for number, handler in before.items():
        signal.signal(number, handler)
