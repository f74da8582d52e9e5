"""The test frames that ship for `gknet demo`: eight frames of one skd test sequence of each spacecraft.

    pip install '.[render]'
    python experiments/demo_frames.py --work runs/demo --out src/gknet/demo_data

Hardware   2 CPU cores
Time       about a minute
Expected   24 frames, 5 MB
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from gknet.errors import ends_in_one_line
from gknet.render.generate import generate
from gknet.render.options import Options, Selection

TEST_SEQUENCES = {"satellite_01": 7, "satellite_02": 17, "satellite_03": 14}
"""Which of a spacecraft's 20 test sequences: ones with the Earth behind and the craft large enough to look at."""
KEPT = ("camera_matrix.txt", "recipe.json", "test.json", "data")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="folder to render into")
    parser.add_argument("--out", type=Path, required=True, help="folder of what ships; replaced")
    arguments = parser.parse_args()
    for name, place in TEST_SEQUENCES.items():
        chosen = Selection((name,), "test", first=120, every=4, frames=8, shard=(place, 20))
        generate("skd", arguments.work, Options(mask=False), chosen)
    shutil.rmtree(arguments.out, ignore_errors=True)
    (arguments.out / "spacecraft").mkdir(parents=True)
    for kept in KEPT:
        source = arguments.work / kept
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, arguments.out / kept)
    for toml in (arguments.work / "spacecraft").glob("*.toml"):
        shutil.copyfile(toml, arguments.out / "spacecraft" / toml.name)


if __name__ == "__main__":
    with ends_in_one_line():
        main()
