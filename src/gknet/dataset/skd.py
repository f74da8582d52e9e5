"""The SKD dataset as a sequence of Frames: what `gknet render` writes, and the authors' own folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import overload

import numpy as np

from gknet.dataset.skd_format import SPLITS, Annotation, annotation_from, frame_stem, spelled_as
from gknet.dataset.skd_sequence import SkdSequence, read_sequence, read_skeleton
from gknet.errors import GknetError
from gknet.frame import Frame
from gknet.geometry import Camera
from gknet.io.image import read_image
from gknet.io.spacecraft_file import load_spacecraft
from gknet.io.text import quoted, read_json
from gknet.spacecraft import MAX_EXTENT_M, Spacecraft

SAME_POINT_M = 1e-3
"""Keypoints of one spacecraft may differ by rounding between its files, by no more than this."""


@dataclass(frozen=True)
class Extras:
    """What the folder knows of a frame beyond its Frame; None where it does not know.

    Attributes:
        index: The frame's place in its sequence, from 0.
        category: The spacecraft as the split file spells it.
        sequence: The sequence's folder as the split file spells it, such as data/000001.
        image_path: The image.
        mask_path: The mask of the spacecraft.
        depth_path: The depth map, in m.
        recipe: The recipe's name, of a rendered frame.
        seed: The seed that it was rendered with.
    """

    index: int
    category: str
    sequence: str
    image_path: Path
    mask_path: Path | None
    depth_path: Path | None
    recipe: str | None
    seed: int | None


class SkdDataset(Sequence[Frame]):
    """Frames in the order of the split files, sequences and rows.

    Args:
        root: The folder of train.json, val.json and test.json.
        split: train, val or test; None reads every split there is.
        spacecraft: A name as the split files spell it; the case of its first letter makes no difference (satellite_01
            is Satellite_01). None takes all.
        every: Keeps each `every`-th row of a sequence.

    Attributes:
        root: As given.
        categories: The spacecraft's names, as the split files spell them.

    Raises:
        GknetError: The folder, a split file or a sequence cannot be read, or there is no such spacecraft.
    """

    def __init__(
        self, root: str | Path, split: str | None = None, spacecraft: str | None = None, every: int = 1
    ) -> None:
        self.root = Path(root)
        if every < 1:
            raise GknetError(f"every: expected 1 or more, got {every}")
        listed = _listed_sequences(self.root, split)
        self.categories = tuple(sorted({category for category, _ in listed}))
        if spacecraft is not None:
            chosen = spelled_as(spacecraft, self.categories)
            if chosen is None:
                place = f" in the split '{split}'" if split else ""
                raise GknetError(f"{self.root}: no sequence of '{spacecraft}'{place}; it has: {_holdings(self.root)}")
            listed = [(category, name) for category, name in listed if category == chosen]
            self.categories = (chosen,)
        self._sequences = [read_sequence(self.root, name, category) for category, name in listed]
        self._rows = [(s, r) for s in range(len(listed)) for r in range(0, len(self._sequences[s].rows), every)]
        self._sizes: dict[int, tuple[int, int]] = {}
        self._spacecraft: Spacecraft | None = None

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, i: int) -> Frame: ...
    @overload
    def __getitem__(self, i: slice) -> list[Frame]: ...
    def __getitem__(self, i: int | slice) -> Frame | list[Frame]:
        if isinstance(i, slice):
            return [self.frame(k) for k in range(*i.indices(len(self)))]
        return self.frame(i)

    @property
    def spacecraft(self) -> Spacecraft:
        """The one spacecraft of this view, from spacecraft/*.toml of the root or else from the sequence's skeleton."""
        if self._spacecraft is None:
            if len(self.categories) != 1:
                have = ", ".join(self.categories) or "none"
                raise GknetError(f"{self.root}: choose one spacecraft; there are: {have}")
            self._spacecraft = _spacecraft(self.root, self._sequences)
        return self._spacecraft

    def sequence_of(self, i: int) -> str:
        """The sequence that frame `i` belongs to, such as data/000001."""
        return self._sequences[self._rows[i][0]].name

    def frame(self, i: int, image: bool = True) -> Frame:
        """Frame `i` of this view.

        Args:
            i: From 0.
            image: Whether the image is read too.

        Raises:
            GknetError: Its label or its image is damaged.
        """
        sequence, annotation = self._annotation(i)
        pixels = read_image(sequence.image_path(annotation.index)) if image else None
        camera = annotation.camera
        if camera is None:
            height, width = self._size(self._rows[i][0])
            camera = Camera(sequence.camera_matrix, width, height)
        if pixels is not None and pixels.shape[:2] != (camera.height, camera.width):
            raise GknetError(
                f"{sequence.image_path(annotation.index)}: expected {camera.width} x {camera.height} pixels as in "
                f"its label or its sequence, got {pixels.shape[1]} x {pixels.shape[0]}"
            )
        return Frame(
            name=f"{sequence.folder.name}/{frame_stem(annotation.index)}",
            image=pixels,
            camera=camera,
            cam_from_body=annotation.cam_from_body,
            visible=annotation.visible,
            sun_direction=annotation.sun_direction,
            time_s=annotation.time_s,
            earth_in_view=annotation.earth,
        )

    def extras(self, i: int) -> Extras:
        """What else the folder knows of frame `i`.

        Raises:
            GknetError: Its label is damaged.
        """
        sequence, annotation = self._annotation(i)
        stem = frame_stem(annotation.index)
        mask_path = sequence.folder / "mask" / f"{stem}.png"
        depth_path = sequence.folder / "depth" / f"{stem}.npz"
        return Extras(
            index=annotation.index,
            category=sequence.category,
            sequence=sequence.name,
            image_path=sequence.image_path(annotation.index),
            mask_path=mask_path if mask_path.exists() else None,
            depth_path=depth_path if depth_path.exists() else None,
            recipe=annotation.recipe,
            seed=annotation.seed,
        )

    def _annotation(self, i: int) -> tuple[SkdSequence, Annotation]:
        s, r = self._rows[i]
        sequence = self._sequences[s]
        place = f"{sequence.folder / 'annotations.csv'}: row {r + 1}"
        return sequence, annotation_from(sequence.rows[r], sequence.indices[r], len(sequence.points_m), place)

    def _size(self, s: int) -> tuple[int, int]:
        """Height and width of a sequence's images, where only the images know them."""
        if s not in self._sizes:
            self._sizes[s] = _first_size(self._sequences[s])
        return self._sizes[s]


def _first_size(sequence: SkdSequence) -> tuple[int, int]:
    """Height and width of the first image that can be read."""
    for index in sequence.indices:
        try:
            height, width = read_image(sequence.image_path(index)).shape[:2]
        except GknetError:
            continue
        return height, width
    raise GknetError(f"{sequence.folder / 'image'}: no image can be read, so their size is unknown")


def _listed_sequences(root: Path, split: str | None) -> list[tuple[str, str]]:
    """(category, data/000001) of the chosen splits."""
    if split is not None and split not in SPLITS:
        raise GknetError(f"split: expected one of {', '.join(SPLITS)}, got '{split}'")
    paths = [root / f"{name}.json" for name in ([split] if split else SPLITS)]
    try:
        if not root.is_dir():
            raise GknetError(f"{root}: no such dataset folder")
        present = [path for path in paths if path.exists()]
    except OSError as error:  # a folder above that may not be entered, a name that is too long
        raise GknetError(f"{root}: the dataset folder cannot be read ({error.strerror})") from error
    if not present:
        held = _holdings(root)
        remedy = f"it has: {held}" if held != "nothing" else "is it an SKD folder?"
        raise GknetError(f"{root}: expected {' or '.join(path.name for path in paths)}, found none; {remedy}")
    listed = [item for path in present for item in _read_split(path)]
    names = [name for _, name in listed]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise GknetError(f"{root}: sequence '{twice}' is listed twice in {', '.join(path.name for path in present)}")
    return listed


def _holdings(root: Path) -> str:
    """The splits of a dataset and whose sequences they list, for a message: "train (A, B), test (A)"."""
    words = []
    for name in SPLITS:
        try:
            categories = sorted({category for category, _ in _read_split(root / f"{name}.json")})
        except GknetError:  # absent or damaged
            continue
        if categories:
            words.append(f"{name} ({', '.join(categories)})")
    return ", ".join(words) or "nothing"


def _read_split(path: Path) -> list[tuple[str, str]]:
    listing = read_json(path)
    lists = listing.values() if isinstance(listing, dict) else [None]
    if not all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists):
        raise GknetError(f'{path}: expected {{"Satellite_01": ["data/000001", ...], ...}}, got something else')
    listed = [(category, name.rstrip("/")) for category, names in listing.items() for name in names]
    for _, name in listed:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise GknetError(f"{path}: expected sequences inside of the dataset's folder, got {quoted(name)}")
    return listed


def _spacecraft(root: Path, sequences: list[SkdSequence]) -> Spacecraft:
    """The spacecraft of sequences of one category, agreeing with the keypoints of each."""
    first = sequences[0]
    spacecraft = _declared_spacecraft(root, first.category) or _skeleton_spacecraft(first)
    for sequence in sequences:
        points = sequence.points_m
        if points.shape != spacecraft.points_m.shape:
            raise GknetError(
                f"{sequence.folder / 'keypoints.txt'}: expected the {spacecraft.keypoint_count} keypoints of "
                f"{spacecraft.name}, got {len(points)}"
            )
        if np.abs(points - spacecraft.points_m).max() > SAME_POINT_M:
            raise GknetError(f"{sequence.folder / 'keypoints.txt'}: the keypoints are not those of {spacecraft.name}")
    return spacecraft


def _declared_spacecraft(root: Path, category: str) -> Spacecraft | None:
    files = {path.stem: path for path in sorted((root / "spacecraft").glob("*.toml"))}
    stem = spelled_as(category, files)
    return None if stem is None else load_spacecraft(files[stem])


def _skeleton_spacecraft(sequence: SkdSequence) -> Spacecraft:
    points = sequence.points_m
    if np.abs(points).max() > MAX_EXTENT_M:
        raise GknetError(f"{sequence.folder / 'keypoints.txt'}: expected keypoints within {MAX_EXTENT_M:g} m")
    span = np.linalg.norm(points[:, None] - points[None], axis=2)
    if len(points) < 4 or span.max() < SAME_POINT_M:
        raise GknetError(f"{sequence.folder / 'keypoints.txt'}: expected 4 keypoints or more, apart from each other")
    skeleton = read_skeleton(sequence.folder, len(points))
    return Spacecraft(
        name=sequence.category,
        keypoint_names=skeleton.keypoint_names,
        points_m=points,
        edges=skeleton.edges,
        diameter_m=float(span.max()),
        description="from an SKD folder; the diameter is that of the keypoints",
    )


def open_dataset(path: Path, spacecraft: Spacecraft, split: str | None, every: int) -> SkdDataset:
    """The frames of a spacecraft, whose keypoints in the dataset must be the ones given.

    Args:
        path: The dataset's folder.
        spacecraft: Its name chooses the frames.
        split: train, val or test; None for all.
        every: Keeps each `every`-th row of a sequence.

    Raises:
        GknetError: The dataset cannot be read, has no frame of the spacecraft, or has other keypoints.
    """
    dataset = SkdDataset(path, split, spacecraft.name, every)
    if len(dataset) == 0:
        place = f"the split '{split}'" if split else "any split"
        raise GknetError(f"{path}: no frame of '{spacecraft.name}' in {place}")
    points = dataset.spacecraft.points_m
    if points.shape != spacecraft.points_m.shape or np.abs(points - spacecraft.points_m).max() > SAME_POINT_M:
        raise GknetError(f"{path}: its {spacecraft.name} has other keypoints than the model's; train a model for it")
    return dataset
