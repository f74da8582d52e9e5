"""What a rendering job is asked for: how its frames are made, and which of a recipe's frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gknet.errors import GknetError

WINDOWS = ("frame", "target")
DEFAULT_SIZE = {"frame": 1024, "target": 320}
"""Pixels of an image's side, for each kind of window."""

LARGEST_SEED = 2**53
LARGEST_SIZE_PX = 4096
LARGEST_SPP = 1024


def _check_range(name: str, value: int | None, low: int, high: int | None = None) -> None:
    if value is not None and (value < low or (high is not None and value > high)):
        expected = f"{low} or more" if high is None else f"{low} to {high}"
        raise GknetError(f"{name}: expected {expected}, got {value}")


@dataclass(frozen=True)
class Options:
    """How frames are rendered: with the recipe, what makes one rendered folder differ from another.

    Attributes:
        seed: The same seed gives the same frames.
        window: frame: the whole image; target: a square around the spacecraft, with its own camera.
        size: Pixels of a side; by default 1024, for target at most 320.
        spp: Samples per pixel: 4, 8, 16 or 64.
        mask: Write masks; by default for frame only.
        depth: Write depth maps.

    Raises:
        GknetError: A value is out of its range.
    """

    seed: int = 0
    window: str = "frame"
    size: int | None = None
    spp: int = 8
    mask: bool | None = None
    depth: bool = False

    def __post_init__(self) -> None:
        if self.window not in WINDOWS:
            raise GknetError(f"window: expected one of {', '.join(WINDOWS)}, got '{self.window}'")
        _check_range("seed", self.seed, 0, LARGEST_SEED)
        _check_range("size", self.size, 16, LARGEST_SIZE_PX)
        _check_range("spp", self.spp, 1, LARGEST_SPP)

    @property
    def side_px(self) -> int:
        """Pixels of the image's side; for target windows the largest."""
        return DEFAULT_SIZE[self.window] if self.size is None else self.size

    @property
    def has_masks(self) -> bool:
        """Whether masks are written."""
        return self.window == "frame" if self.mask is None else self.mask

    def recorded(self) -> dict[str, object]:
        """As it is written beside the data, in JSON's types."""
        return {
            "seed": self.seed,
            "window": self.window,
            "size": self.side_px,
            "spp": self.spp,
            "mask": self.has_masks,
            "depth": self.depth,
        }


@dataclass(frozen=True)
class Selection:
    """Which of a recipe's frames to render.

    Attributes:
        spacecraft: Names, separated by commas; all by default.
        split: train, val or test; all by default.
        sequences: At most so many sequences of each spacecraft.
        every: Render every n-th frame of a sequence.
        first: The first frame of each sequence, from 0.
        frames: At most so many frames of each sequence.
        shard: i/n: only the i-th of n parts, i from 0, for job arrays; all by default.

    Raises:
        GknetError: A value is out of its range.
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
        for name in ("every", "frames", "sequences"):
            _check_range(name, getattr(self, name), 1)
        _check_range("first", self.first, 0)
        i, n = self.shard
        if not 0 <= i < n:
            raise GknetError(f"shard: expected i/n with 0 <= i < n, got {i}/{n}")


def parse_names(spacecraft: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Spacecraft names from one name, a comma-separated list or a sequence; None when there is none."""
    if spacecraft is None:
        return None
    names = spacecraft.split(",") if isinstance(spacecraft, str) else spacecraft
    return tuple(name.strip() for name in names if name.strip()) or None


def parse_shard(text: str) -> tuple[int, int]:
    """'0/4' -> (0, 4): the first of four parts."""
    parts = text.split("/")
    if len(parts) != 2 or not all(part.strip().isdecimal() and len(part.strip()) <= 9 for part in parts):
        raise GknetError(f"shard: expected i/n such as 0/4, got '{text[:80]}'")
    return int(parts[0]), int(parts[1])
