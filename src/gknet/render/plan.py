"""What a rendering job consists of: its options, its frames, and the window of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box
from gknet.inference.crop import Crop
from gknet.render.scenario import Recipe, Shot

WINDOWS = ("frame", "target")
DEFAULT_SIZE = {"frame": 1024, "target": 320}
FILM_SIZES = (96, 128, 192, 256, 320)
"""Sizes of target windows: a renderer needs about a second for each new film size, so there are few of them."""
TARGET_MARGIN = (1.35, 1.75)
"""A target window's side over the longer side of the keypoints' box: wider than a network's crop, for augmentation."""
TARGET_SHIFT = 0.08
"""How far the window's centre strays from the box's, at most, as a part of the window's side."""


@dataclass(frozen=True)
class Options:
    """What makes one rendered folder differ from another.

    window  'frame' renders the whole sensor, 'target' a square around the spacecraft
    size    pixels of the picture's side; for target windows the largest
    spp     samples per pixel
    mask    whether masks are written
    depth   whether depth maps are written
    """

    recipe: Recipe
    seed: int
    window: str
    size: int
    spp: int
    mask: bool
    depth: bool

    def __post_init__(self) -> None:
        if self.window not in WINDOWS:
            raise GknetError(f"window: expected one of {', '.join(WINDOWS)}, got '{self.window}'")
        if not 16 <= self.size <= 8192:
            raise GknetError(f"size: expected 16 to 8192 pixels, got {self.size}")
        if self.spp < 1:
            raise GknetError(f"spp: expected 1 or more samples per pixel, got {self.spp}")
        if self.seed < 0:
            raise GknetError(f"seed: expected 0 or more, got {self.seed}")

    def recorded(self) -> dict[str, object]:
        """As it is written beside the data, in JSON's types."""
        plain: dict[str, object] = {field.name: getattr(self, field.name) for field in fields(self)}
        return plain | {"recipe": self.recipe.model_dump(mode="json")}


@dataclass(frozen=True)
class Selection:
    """Which of the recipe's frames to render. None takes all.

    sequences  at most so many sequences of each spacecraft
    every      frames first, first + every, ... of each sequence
    frames     at most so many frames of each sequence
    shard      (i, n): every n-th of the selected sequences, from the i-th
    """

    spacecraft: tuple[str, ...] | None = None
    split: str | None = None
    sequences: int | None = None
    every: int = 1
    first: int = 0
    frames: int | None = None
    shard: tuple[int, int] = (0, 1)

    def __post_init__(self) -> None:
        if self.split not in (None, "train", "val", "test"):
            raise GknetError(f"split: expected train, val or test, got '{self.split}'")
        for name, value in (("every", self.every), ("frames", self.frames), ("sequences", self.sequences)):
            if value is not None and value < 1:
                raise GknetError(f"{name}: expected 1 or more, got {value}")
        if self.first < 0:
            raise GknetError(f"first: expected 0 or more, got {self.first}")
        i, n = self.shard
        if not 0 <= i < n:
            raise GknetError(f"shard: expected i/n with 0 <= i < n, got {i}/{n}")


@dataclass(frozen=True)
class SequencePlan:
    """The frames of one sequence to render."""

    sequence: int
    spacecraft: str
    indices: tuple[int, ...]


def plan_sequences(recipe: Recipe, selection: Selection) -> list[SequencePlan]:
    """The selected sequences in the recipe's order; an empty selection is an error."""
    for name in selection.spacecraft or ():
        if name not in recipe.spacecraft:
            raise GknetError(f"spacecraft: expected some of {', '.join(recipe.spacecraft)}, got '{name}'")
    indices = tuple(range(selection.first, recipe.frames, selection.every))[: selection.frames]
    taken: dict[str, int] = {}
    plans = []
    for sequence in range(recipe.sequences):
        spacecraft = recipe.spacecraft_of(sequence)
        if selection.spacecraft and spacecraft not in selection.spacecraft:
            continue
        if selection.split and recipe.split_of(sequence) != selection.split:
            continue
        taken[spacecraft] = taken.get(spacecraft, 0) + 1
        if selection.sequences is None or taken[spacecraft] <= selection.sequences:
            plans.append(SequencePlan(sequence, spacecraft, indices))
    if not plans or not indices:
        raise GknetError(
            f"recipe {recipe.name}: the selection has no frame; it has {recipe.sequences} sequences of {recipe.frames}"
        )
    i, n = selection.shard
    return plans[i::n]


def window_of(options: Options, shot: Shot, points_m: Float[ndarray, "n 3"]) -> Crop:
    """The square of the sensor to render for a shot."""
    whole = Crop(0, 0, max(shot.camera.width, shot.camera.height), options.size)
    if options.window == "frame":
        return whole
    pixels = shot.camera.project(shot.cam_from_body.transform(points_m))
    box = Box.around(pixels).clipped(shot.camera.width, shot.camera.height)
    return whole if box is None else target_window(box, options.size, shot.seed)


def target_window(box: Box, size: int, seed: int) -> Crop:
    """A jittered square around `box` at about native resolution, at most `size` pixels; the same for the same seed."""
    random = np.random.default_rng([seed, 0x7A6])
    side = max(8, round(box.side * random.uniform(*TARGET_MARGIN)))
    shift_x, shift_y = random.uniform(-TARGET_SHIFT, TARGET_SHIFT, 2) * side
    centre_x, centre_y = box.centre
    x0, y0 = round(centre_x + shift_x - side / 2), round(centre_y + shift_y - side / 2)
    return Crop(x0, y0, side, film_size(side, size))


def film_size(side: int, largest: int) -> int:
    """The smallest of the film sizes that holds a window of `side` native pixels, `largest` when none does."""
    return next((s for s in FILM_SIZES if min(side, largest) <= s <= largest), largest)


def parse_names(spacecraft: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Spacecraft names from one name, a comma-separated list or a sequence."""
    if spacecraft is None:
        return None
    names = spacecraft.split(",") if isinstance(spacecraft, str) else spacecraft
    return tuple(name.strip().lower() for name in names if name.strip()) or None


def parse_shard(text: str) -> tuple[int, int]:
    """'0/4' -> (0, 4): the first of four parts."""
    parts = text.split("/")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise GknetError(f"shard: expected i/n such as 0/4, got '{text}'")
    return int(parts[0]), int(parts[1])


def spacecraft_path(root: Path, name: str) -> Path:
    return root / "spacecraft" / f"{name}.toml"
