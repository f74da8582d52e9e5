"""Several jobs in one folder: no row is lost between one that appends and one that finishes the sequence."""

from __future__ import annotations

from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest

from gknet.dataset.skd_format import Annotation, row_of
from gknet.dataset.skd_sequence import read_rows
from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.io.lock import locked
from gknet.render import folder as folders
from gknet.render.folder import finish, folder_lock
from gknet.render.journal import JOURNAL, append_row
from gknet.render.options import Options
from gknet.render.plan import Job
from gknet.render.recipe import RECIPES
from gknet.spacecraft import Spacecraft

CRAFT = Spacecraft("satellite_01", tuple("abcd"), np.eye(4, 3), ((0, 1),), 2.0)
FRAMES = 60


def row(index: int) -> dict[str, str]:
    camera, sun = Camera.from_focal(100, 64, 64), np.array([0.0, 0.0, 1.0])
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 5.0]))
    visible = np.ones(4, dtype=bool)
    return row_of(Annotation("Satellite_01", index, pose, 0.0, visible, sun, False, camera, "skd", 0))


def test_no_row_is_lost_while_another_job_finishes_the_sequence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folders, "_is_whole", lambda *_: True)
    job = Job(tmp_path, RECIPES["skd"], Options())
    job.folder(0).mkdir(parents=True)
    is_over = Event()

    def append() -> None:
        for index in range(FRAMES):
            with folder_lock(tmp_path):
                append_row(job.folder(0) / JOURNAL, row(index))
        is_over.set()

    thread = Thread(target=append)
    thread.start()
    while not is_over.is_set():
        finish(job, 0, CRAFT)
    thread.join()
    finish(job, 0, CRAFT)
    assert [int(each["frame"]) for each in read_rows(job.folder(0) / "annotations.csv")] == list(range(FRAMES))
    assert not (job.folder(0) / JOURNAL).exists()


def test_a_lock_that_is_never_freed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folders, "LOCK_WAIT_S", 0.1)
    with locked(tmp_path), pytest.raises(GknetError, match="another gknet command"), folder_lock(tmp_path):
        pass
