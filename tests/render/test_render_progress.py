"""The progress of rendering in a log file: a line now and then, each failure once."""

from __future__ import annotations

import pytest

from gknet.render.generate import Progress
from gknet.render.render_progress import LOG_EVERY_S, REASONS_SHOWN, RenderProgress


def test_a_log_file_gets_a_line_now_and_then_and_one_at_the_end(capfd: pytest.CaptureFixture[str]) -> None:
    with RenderProgress() as progress:
        for done in range(5):
            progress.show(Progress(4, done, (), 0.6 * LOG_EVERY_S * done))
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(" frames")[0] for line in lines] == ["2/4", "4/4"]
    assert lines[-1] == "4/4 frames, 18.000 s/frame, 0 min left, 0 failed"


def test_each_failure_is_shown_once_and_not_all_of_them(capfd: pytest.CaptureFixture[str]) -> None:
    reasons = tuple(f"data/000001 frame {k}: \x1b[31mno light" for k in range(REASONS_SHOWN + 5))
    with RenderProgress() as progress:
        for k in range(len(reasons) + 1):
            progress.show(Progress(len(reasons), 0, reasons[:k], 1.0))
    text = capfd.readouterr().err
    assert text.count("no light") == REASONS_SHOWN
    assert "frame 9: \\x1b[31mno light" in text
    assert f"{len(reasons)} failed" in text


def test_a_second_job_begins_anew(capfd: pytest.CaptureFixture[str]) -> None:
    with RenderProgress() as progress:
        for _ in range(2):
            progress.show(Progress(2, 0, (), 0.0))
            progress.show(Progress(2, 1, ("frame 0: no light",), 2 * LOG_EVERY_S))
    assert capfd.readouterr().err.count("no light") == 2
