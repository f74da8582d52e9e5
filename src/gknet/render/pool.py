"""Worker processes that render, and how they end: with the job, with a stop signal, or with the process above them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from threading import Thread

import cv2

from gknet.errors import GknetError
from gknet.io.interrupt import Interruption
from gknet.render.plan import Job, SequencePlan
from gknet.render.worker import Outcome, WorkerState, render_chunk

MOST_WORKERS = 256
_POLL_S = 0.2
_SIGNAL_ON_ITS_WAY_S = 1.0


def render_chunks(
    job: Job, chunks: Iterable[SequencePlan], workers: int, variant: str, interruption: Interruption
) -> Iterator[Outcome]:
    """Render chunks of frames; the outcome of each as it comes.

    It ends early, after the frames that are under way, when a stop signal comes.

    Args:
        job: The folder and its options.
        chunks: What to render.
        workers: Processes; 1 renders in this process with all cores.
        variant: Mitsuba's.
        interruption: Asked between frames.

    Raises:
        GknetError: A worker process died.
    """
    if workers == 1:
        state = WorkerState(job, variant)
        for chunk in chunks:
            if interruption.requested:
                return
            yield render_chunk(state, chunk, lambda: interruption.requested)
        return
    context = multiprocessing.get_context("spawn")
    lifeline, held = context.Pipe(duplex=False)
    stop = context.Event()
    executor = ProcessPoolExecutor(workers, context, _start_worker, (job, variant, stop, lifeline))
    try:
        yield from _outcomes(executor, chunks, 2 * workers, interruption)
    except BrokenProcessPool as error:
        # A signal to the whole process group ends the workers too; this process may get it a moment later.
        deadline = time.monotonic() + _SIGNAL_ON_ITS_WAY_S
        while not interruption.requested and time.monotonic() < deadline:
            time.sleep(_POLL_S)
        if not interruption.requested:
            raise GknetError(
                "a rendering process died (out of memory, or Mitsuba aborted); run the same command again to go on, "
                "with --workers 1 or GKNET_MITSUBA_VARIANT=scalar_rgb if it happens again; a script of your own needs "
                "if __name__ == '__main__' about its call"
            ) from error
    finally:
        stop.set()
        try:
            executor.shutdown(wait=True, cancel_futures=True)
        finally:
            held.close()
            lifeline.close()


def _outcomes(
    executor: ProcessPoolExecutor, chunks: Iterable[SequencePlan], most: int, interruption: Interruption
) -> Iterator[Outcome]:
    """Results as they come; at most so many chunks are handed out at a time."""
    waiting, running = iter(chunks), set[Future[Outcome]]()
    is_exhausted = False
    while not interruption.requested:
        while not is_exhausted and len(running) < most:
            chunk = next(waiting, None)
            is_exhausted = chunk is None
            if chunk is not None:
                with _stop_signals_held_back():
                    running.add(executor.submit(_work, chunk))
        if not running:
            return
        finished, running = wait(running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        yield from (future.result() for future in finished)


@contextmanager
def _stop_signals_held_back() -> Iterator[None]:
    """Processes that start meanwhile never get a Ctrl-C or a hang-up of the terminal: the process above stops them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_state: WorkerState | None = None
_stop: Event | None = None


def _start_worker(job: Job, variant: str, stop: Event, lifeline: Connection) -> None:
    """Called once in each worker process: one thread each, and a state of its own."""
    global _state, _stop
    os.dup2(2, 1)  # a reader of the command's standard output does not wait for workers
    cv2.setNumThreads(1)
    _state, _stop = WorkerState(job, variant, threads=1), stop
    Thread(target=_end_with, args=(lifeline, _state), daemon=True).start()


def _end_with(lifeline: Connection, state: WorkerState) -> None:
    """End this process when the one above closes its end of the pipe or dies, but not in the middle of a file."""
    try:
        lifeline.recv_bytes()
    except (EOFError, OSError):
        with state.writing:
            os._exit(1)


def _work(chunk: SequencePlan) -> Outcome:
    if _state is None or _stop is None:
        raise RuntimeError("_start_worker was not called in this process")
    return render_chunk(_state, chunk, _stop.is_set)
