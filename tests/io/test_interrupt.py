"""Stop signals: a flag for loops, a KeyboardInterrupt for everything else, exit codes as a shell counts."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from gknet.io.interrupt import STOP_SIGNALS, Interrupted, Interruption, as_keyboard_interrupt


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_the_first_signal_sets_a_flag_and_the_second_interrupts(number: int, code: int) -> None:
    before = [signal.getsignal(each) for each in STOP_SIGNALS]
    with Interruption() as interruption:
        assert not interruption.requested
        interruption.raise_if_requested()
        send(number)
        assert interruption.requested
        with pytest.raises(Interrupted):
            send(number)
        with pytest.raises(Interrupted) as caught:
            interruption.raise_if_requested()
    assert caught.value.exit_code == code
    assert [signal.getsignal(each) for each in STOP_SIGNALS] == before


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_signals_as_keyboard_interrupt(number: int) -> None:
    with pytest.raises(KeyboardInterrupt), as_keyboard_interrupt():
        send(number)
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with as_keyboard_interrupt(), Interruption() as interruption:
            send(signal.SIGHUP)
            assert not interruption.requested
    finally:
        signal.signal(signal.SIGHUP, before)


def test_other_threads_have_no_handlers() -> None:
    seen = []

    def work() -> None:
        with as_keyboard_interrupt(), Interruption() as interruption:
            seen.append(interruption.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
