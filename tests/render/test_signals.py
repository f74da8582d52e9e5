"""`gknet render` under signals, with real processes: no worker outlives it, what is done is kept, a rerun goes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mitsuba")
pytest.importorskip("trimesh")

from gknet.dataset.skd import SkdDataset
from gknet.io.spacecraft_file import save_spacecraft
from gknet.render.journal import JOURNAL
from gknet.render.recipe import RECIPE_FOLDER
from gknet.spacecraft import Spacecraft, diameter
from tests.render.glb import Glb, box
from tests.render.state import VARIANT, white

FRAMES = 150
PATIENCE_S = 60.0

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder that has its own spacecraft, a box, and a recipe beside it."""
    vertices, faces = box((2.0, 1.4, 0.8))
    craft = tmp_path / "out/spacecraft/toy.toml"
    craft.parent.mkdir(parents=True)
    mesh = Glb().mesh(vertices, faces, white()).write(craft.with_suffix(".glb"))
    points = np.unique(vertices, axis=0)
    names = tuple(f"corner_{k}" for k in range(len(points)))
    save_spacecraft(Spacecraft("toy", names, points, ((0, 1),), diameter(vertices), mesh_path=mesh), craft)
    text = (RECIPE_FOLDER / "skd.toml").read_text(encoding="utf-8")
    text = text.replace("earth_fraction = 0.3333333", "earth_fraction = 0.0")
    text = text.replace('["satellite_01", "satellite_02", "satellite_03"]', '["toy"]')
    (tmp_path / "toy.toml").write_text(text.replace("frames = 300", f"frames = {FRAMES}"), encoding="utf-8")
    return tmp_path / "out"


def command(out: Path, workers: int) -> list[str]:
    options = ["--recipe", str(out.parent / "toy.toml"), "--sequences", "1", "--size", "64", "--spp", "1"]
    return [sys.executable, "-m", "gknet.cli.main", "render", str(out), *options, "--workers", str(workers)]


def environment() -> dict[str, str]:
    return {**os.environ, "GKNET_MITSUBA_VARIANT": VARIANT}


def rows(out: Path) -> list[int]:
    """The frames in the journal."""
    journal = out / "data/000001" / JOURNAL
    lines = journal.read_text(encoding="utf-8").splitlines() if journal.exists() else []
    return [int(json.loads(line)["frame"]) for line in lines if line]


def under_way(out: Path, workers: int) -> subprocess.Popen[str]:
    """The command, once it has rendered a frame, in a process group of its own."""
    process = subprocess.Popen(
        command(out, workers),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment(),
        start_new_session=True,
    )
    deadline = time.monotonic() + PATIENCE_S
    while not rows(out) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert process.poll() is None, process.communicate()
    assert rows(out)
    return process


def members(group: int) -> Iterator[int]:
    """Processes of a group that still run."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            state, _, number = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(number) == group and state != "Z":
            yield int(entry.name)


def assert_all_end(group: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while list(members(group)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not list(members(group))


@pytest.mark.parametrize(
    ("number", "workers", "is_to_group"),
    [
        (signal.SIGTERM, 2, False),
        pytest.param(signal.SIGTERM, 2, True, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, 2, True, marks=pytest.mark.slow),
        (signal.SIGINT, 1, False),
        (signal.SIGHUP, 1, False),
    ],
)
def test_a_stop_signal_ends_workers_and_keeps_frames(
    out: Path, number: signal.Signals, workers: int, is_to_group: bool
) -> None:
    process = under_way(out, workers)
    (os.killpg if is_to_group else os.kill)(process.pid, number)
    text, _ = process.communicate(timeout=PATIENCE_S)  # returns once nobody holds the standard output
    assert process.returncode == 128 + number, text
    assert text.strip() == "gknet: interrupted"
    assert_all_end(process.pid)
    assert 0 < len(rows(out)) < FRAMES
    assert len(list((out / "data/000001/image").glob("*.jpg"))) >= len(rows(out))
    assert (number is signal.SIGTERM and is_to_group) or not list(out.rglob("*.tmp"))


@pytest.mark.slow
def test_a_killed_render_leaves_no_worker_and_goes_on(out: Path) -> None:
    process = under_way(out, 2)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    assert_all_end(process.pid)
    assert not list(out.rglob("*.tmp"))
    done = rows(out)
    most = max(done) + 4
    call = [*command(out, 1), "--frames", str(most)]
    again = subprocess.run(call, capture_output=True, text=True, env=environment(), check=False)
    assert again.returncode == 0, again.stderr
    assert f"{len(done)} were there, 0 failed" in again.stdout
    assert len(SkdDataset(out)) == most


@pytest.mark.slow
def test_two_renders_into_one_folder_share_it(out: Path) -> None:
    """The same sequence at once with other frames: every frame has its image and its label."""
    calls = [[*command(out, 1), "--frames", "12", "--every", every, "--first", "1"] for every in ("1", "3")]
    processes = [
        subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment())
        for call in calls
    ]
    for process in processes:
        text, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, text
    dataset = SkdDataset(out)
    expected = sorted({*range(1, 13), *range(1, 35, 3)})
    assert [dataset.extras(i).index for i in range(len(dataset))] == expected
    assert all(frame.image is not None for frame in dataset)
