"""The models and the frames that ship, run as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

from gknet.cli.main import run

LEAST_POSED = 20
"""Of 24 bundled frames; and with a median attitude error far below chance (2.2 rad) for two of the three craft."""


def test_demo_estimates_the_bundled_frames(tmp_path: Path) -> None:
    assert run(["demo", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))["spacecraft"]
    detected = {name: found["runs"]["detected"] for name, found in content.items()}
    assert sorted(detected) == ["satellite_01", "satellite_02", "satellite_03"]
    assert sum(found["frames"] - sum(found["failures"].values()) for found in detected.values()) >= LEAST_POSED
    for name in ("satellite_01", "satellite_03"):
        assert detected[name]["metrics"]["e_q_rad"]["median"] < 0.2
        assert detected[name]["metrics"]["e_t"]["median"] < 0.06
    assert (tmp_path / "report.html").stat().st_size > 100_000
