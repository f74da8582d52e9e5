"""The rendering stage: a recipe and options -> a dataset on disk. It goes on after a kill, and shards."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from gknet.dataset.skd_write import write_splits
from gknet.errors import GknetError, MissingExtraError
from gknet.io.interrupt import Interruption
from gknet.render.contact_sheet import write_contact_sheet
from gknet.render.folder import claim, finish, folder_lock, load_or_build_spacecraft, prepare
from gknet.render.mesh import load_mesh
from gknet.render.options import Options, Selection
from gknet.render.plan import Job, SequencePlan, plan_sequences
from gknet.render.pool import MOST_WORKERS, render_chunks
from gknet.render.recipe import Recipe, load_recipe
from gknet.render.variant import choose_variant
from gknet.spacecraft import Spacecraft

CHUNK = 8
"""Frames a worker takes at a time."""


@dataclass(frozen=True)
class Progress:
    """How far a job is.

    Attributes:
        total: Frames to render.
        done: Frames rendered so far.
        failures: Reasons so far, one for each frame that has no image.
        seconds: Since rendering began.
    """

    total: int
    done: int
    failures: tuple[str, ...]
    seconds: float


@dataclass(frozen=True)
class Generated:
    """What a run did.

    Attributes:
        out: The dataset's folder.
        rendered: Frames that are new.
        kept: Selected frames that were there before.
        failures: Reasons, one for each frame that has no image.
        render_seconds: Of rendering the new frames; 0 when there were none.
        seconds: Of the whole run, with its preparation and the contact sheet.
    """

    out: Path
    rendered: int
    kept: int
    failures: tuple[str, ...]
    render_seconds: float
    seconds: float


def generate(
    recipe: str | Path | Recipe,
    out: str | Path,
    options: Options | None = None,
    selection: Selection | None = None,
    workers: int = 2,
    variant: str | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Generated:
    """Render the selected frames of a recipe into the SKD layout; what is there already is kept.

    Ctrl-C, SIGTERM and SIGHUP end the run after the frames that are under way; the same call goes on.

    Args:
        recipe: A name (skd, skd-hard), the path of a .toml, or a Recipe.
        out: The dataset's folder. Another selection may be added to it later, and several runs may share it.
        options: How frames are rendered.
        selection: Which frames; all by default.
        workers: Processes; 1 renders in this process with all cores.
        variant: Mitsuba's, chosen for the machine by default.
        on_progress: Called at the start and after each chunk of frames.

    Returns:
        What was done. Frames that failed are reported there.

    Raises:
        GknetError: `out` was made with other options, the selection has no frame, a mesh has not the size
            that its spacecraft's file declares, or a worker process died.
        MissingExtraError: The extra `render` is not installed.
        Interrupted: A stop signal came.
    """
    _need_mitsuba()
    if not 1 <= workers <= MOST_WORKERS:
        raise GknetError(f"workers: expected 1 to {MOST_WORKERS}, got {workers}")
    started = time.monotonic()
    job = Job(Path(out), recipe if isinstance(recipe, Recipe) else load_recipe(recipe), options or Options())
    plans = plan_sequences(job.recipe, selection or Selection())
    claim(job)
    fleet = {name: load_or_build_spacecraft(job, name) for name in sorted({plan.spacecraft for plan in plans})}
    missing = [prepare(job, plan, fleet[plan.spacecraft]) for plan in plans]
    todo = sum(len(plan.indices) for plan in missing)
    kept = sum(len(plan.indices) for plan in plans) - todo
    for name in sorted({plan.spacecraft for plan in missing if plan.indices}):
        load_mesh(fleet[name])
    failures: tuple[str, ...] = ()
    render_seconds = 0.0
    if todo:
        variant = variant or choose_variant()
        render_started = time.monotonic()
        failures = _render(job, missing, fleet, workers, variant, on_progress)
        render_seconds = time.monotonic() - render_started
    with folder_lock(job.root):
        write_splits(job.root, job.recipe.split_of, job.recipe.spacecraft_of)
    write_contact_sheet(job.root)
    return Generated(job.root, todo - len(failures), kept, failures, render_seconds, time.monotonic() - started)


def _need_mitsuba() -> None:
    for module in ("mitsuba", "trimesh"):
        if importlib.util.find_spec(module) is None:
            raise MissingExtraError("render", module)


def _render(
    job: Job,
    plans: list[SequencePlan],
    fleet: dict[str, Spacecraft],
    workers: int,
    variant: str,
    on_progress: Callable[[Progress], None] | None,
) -> tuple[str, ...]:
    """Render the frames of the plans, finish each sequence as its last frame comes; the reasons of what failed."""
    report = on_progress or (lambda progress: None)
    failures: tuple[str, ...] = ()
    started, done = time.monotonic(), 0
    total = sum(len(plan.indices) for plan in plans)
    spacecraft_of = {plan.sequence: plan.spacecraft for plan in plans}
    left = {plan.sequence: len(plan.indices) for plan in plans}
    report(Progress(total, 0, (), 0.0))
    with Interruption() as interruption:
        for outcome in render_chunks(job, _chunks(plans), workers, variant, interruption):
            done, failures = done + outcome.done, failures + outcome.failures
            left[outcome.sequence] -= outcome.done + len(outcome.failures)
            if left[outcome.sequence] == 0:
                finish(job, outcome.sequence, fleet[spacecraft_of[outcome.sequence]])
            report(Progress(total, done, failures, time.monotonic() - started))
        interruption.raise_if_requested()
    return failures


def _chunks(plans: list[SequencePlan]) -> Iterator[SequencePlan]:
    for plan in plans:
        for start in range(0, len(plan.indices), CHUNK):
            yield replace(plan, indices=plan.indices[start : start + CHUNK])
