"""What a rendering job consists of: its recipe and options, its frames, and the window of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.dataset.skd_format import sequence_name
from gknet.errors import GknetError
from gknet.frame import Box
from gknet.inference.crop import Crop
from gknet.render.options import Options, Selection
from gknet.render.recipe import Recipe
from gknet.render.scenario import Shot

FILM_SIZES = (96, 128, 192, 256, 320)
"""Sizes of target windows: a renderer needs about a second for each new film size, so there are few of them."""
TARGET_MARGIN = (1.35, 1.75)
"""A target window's side over the longer side of the keypoints' box: wider than a network's crop, for augmentation."""
TARGET_SHIFT = 0.08
"""How far the window's centre strays from the box's, at most, as a part of the window's side."""


@dataclass(frozen=True)
class Job:
    """A folder and what is rendered into it.

    Attributes:
        root: The dataset's folder.
        recipe: The ranges that sequences are drawn from.
        options: How frames are rendered.
    """

    root: Path
    recipe: Recipe
    options: Options

    def folder(self, sequence: int) -> Path:
        """The folder of a sequence, such as data/000001."""
        return self.root / sequence_name(sequence)

    def spacecraft_path(self, name: str) -> Path:
        """A spacecraft's .toml; its .glb is beside it."""
        return self.root / "spacecraft" / f"{name}.toml"

    def recorded(self) -> dict[str, object]:
        """As it is written beside the data, in JSON's types."""
        return {"recipe": self.recipe.model_dump(mode="json")} | self.options.recorded()


@dataclass(frozen=True)
class SequencePlan:
    """The frames of one sequence to render.

    Attributes:
        sequence: Its number in the recipe, from 0.
        spacecraft: The spacecraft's name.
        indices: The frames' numbers in the sequence, from 0.
    """

    sequence: int
    spacecraft: str
    indices: tuple[int, ...]


def plan_sequences(recipe: Recipe, selection: Selection) -> list[SequencePlan]:
    """The selected sequences in the recipe's order.

    Raises:
        GknetError: The recipe has no spacecraft of a name, or the selection has no frame.
    """
    chosen = {_name_in(recipe, name) for name in selection.spacecraft or recipe.spacecraft}
    indices = tuple(range(selection.first, recipe.frames, selection.every)[: selection.frames])
    taken: dict[str, int] = {}
    plans = []
    for sequence in range(recipe.sequences):
        spacecraft = recipe.spacecraft_of(sequence)
        if spacecraft not in chosen or selection.split not in (None, recipe.split_of(sequence)):
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


def _name_in(recipe: Recipe, name: str) -> str:
    """The recipe's own spelling of a spacecraft's name; capitals make no difference."""
    if name in recipe.spacecraft:
        return name
    alike = [known for known in recipe.spacecraft if known.lower() == name.lower()]
    if not alike:
        raise GknetError(f"spacecraft: expected some of {', '.join(recipe.spacecraft)}, got '{name[:80]}'")
    return alike[0]


def window_of(options: Options, shot: Shot, points_m: Float[ndarray, "n 3"]) -> Crop:
    """The square of the sensor to render for a shot.

    Args:
        options: Their window and size decide.
        shot: The frame.
        points_m: (n, 3) keypoints in the body frame.
    """
    whole = Crop(0, 0, max(shot.camera.width, shot.camera.height), options.side_px)
    if options.window == "frame":
        return whole
    pixels = shot.camera.project(shot.cam_from_body.transform(points_m))
    box = Box.around(pixels).clipped(shot.camera.width, shot.camera.height)
    return whole if box is None else target_window(box, options.side_px, shot.seed)


def target_window(box: Box, size: int, seed: int) -> Crop:
    """A jittered square around a box at about native resolution; the same for the same seed.

    Args:
        box: Of the keypoints, in pixels of the full image.
        size: The image has at most so many pixels a side.
        seed: Of the jitter.
    """
    random = np.random.default_rng([seed, 0x7A6])
    side = max(8, round(box.side * random.uniform(*TARGET_MARGIN)))
    shift_x, shift_y = random.uniform(-TARGET_SHIFT, TARGET_SHIFT, 2) * side
    centre_x, centre_y = box.centre
    x0, y0 = round(centre_x + shift_x - side / 2), round(centre_y + shift_y - side / 2)
    return Crop(x0, y0, side, film_size(side, size))


def film_size(side: int, largest: int) -> int:
    """The smallest of the film sizes that holds a window of `side` native pixels, `largest` when none does."""
    return next((s for s in FILM_SIZES if min(side, largest) <= s <= largest), largest)
