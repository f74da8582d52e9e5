"""A toy spacecraft, images of it that carry their own number, and an estimator that reads the number and knows."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy import ndarray

from gknet.dataset.skd_format import Annotation, row_of
from gknet.dataset.skd_write import write_annotations, write_frame_files, write_sequence_files, write_splits
from gknet.frame import Box, Estimate, Failure, FailureKind, Keypoints
from gknet.geometry import Camera, Pose
from gknet.io.atomic import write_text
from gknet.io.spacecraft_file import spacecraft_toml
from gknet.spacecraft import Spacecraft

SIZE, FOCAL_PX = 256, 350.0
CAMERA = Camera.from_focal(FOCAL_PX, SIZE, SIZE)
_CELL = 16
_STEP = 12


def toy_spacecraft() -> Spacecraft:
    """A box with two panels and a mast: 13 keypoints."""
    signs = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    points = [[0.8 * x, 0.7 * y, 1.0 * z] for x, y, z in signs]
    points += [[3.5, 0, 0.6], [3.5, 0, -0.6], [-3.5, 0, 0.6], [-3.5, 0, -0.6], [0.1, 0.3, 2.4]]
    names = [f"bus_{k}" for k in range(8)] + ["wing_a", "wing_b", "wing_c", "wing_d", "mast"]
    edges = [
        (i, j) for i in range(8) for j in range(i) if sum(a != b for a, b in zip(signs[i], signs[j], strict=True)) == 1
    ]
    edges += [(8, 9), (10, 11), (7, 8), (6, 9), (3, 10), (2, 11), (12, 7)]
    return Spacecraft("toycraft", tuple(names), np.array(points), tuple(edges), 7.2)


def toy_pose(number: int) -> Pose:
    random = np.random.default_rng([7, number])
    shift = random.uniform(-0.6, 0.6, 2)
    return Pose.from_rotation_vector(random.normal(0, 1, 3), [shift[0], shift[1], random.uniform(10, 20)])


def toy_picture(number: int, size: int = SIZE) -> ndarray:
    """The skeleton in grey, and the number as the brightness of the top-left square."""
    image = np.full((size, size, 3), 12, dtype=np.uint8)
    spacecraft, scale = toy_spacecraft(), size / SIZE
    pixels = CAMERA.project(toy_pose(number).transform(spacecraft.points_m)) * scale
    for i, j in spacecraft.edges:
        a, b = (tuple(int(v) for v in np.round(pixels[k])) for k in (i, j))
        cv2.line(image, a, b, (180, 170, 140), max(1, round(2 * scale)), cv2.LINE_AA)
    image[:_CELL, :_CELL] = number * _STEP
    return image


def picture_number(image: ndarray) -> int:
    return round(float(image[4 : _CELL - 4, 4 : _CELL - 4].mean()) / _STEP)


def write_toy_dataset(root: Path, sequences: int = 2, frames: int = 5) -> Path:
    """Test sequences of the toy in the SKD layout, numbered through; 20 frames at the most."""
    spacecraft = toy_spacecraft()
    (root / "spacecraft").mkdir(parents=True)
    write_text(root / "spacecraft" / "toycraft.toml", spacecraft_toml(spacecraft))
    for sequence in range(sequences):
        folder = root / "data" / f"{sequence + 1:06d}"
        write_sequence_files(folder, CAMERA, spacecraft)
        rows = []
        for index in range(frames):
            number = sequence * frames + index
            write_frame_files(folder, index, toy_picture(number), 95, None, None)
            rows.append(row_of(_annotation(index, number)))
        write_annotations(folder, rows)
    write_splits(root, lambda _: "test", lambda _: "toycraft")
    return root


def _annotation(index: int, number: int) -> Annotation:
    random = np.random.default_rng([8, number])
    sun = random.normal(size=3)
    visible = random.random(toy_spacecraft().keypoint_count) < 0.7
    return Annotation(
        category="Toycraft",
        index=index,
        cam_from_body=toy_pose(number),
        time_s=2.0 * index,
        visible=visible,
        sun_direction=sun / np.linalg.norm(sun),
        camera=CAMERA,
    )


@dataclass(frozen=True, eq=False)
class ToyEstimator:
    """Knows the truth of a toy image by its number; `error` shifts it, numbers in `blind` have no pose, and those in
    `ambiguous` one that is ambiguous."""

    error: float = 0.0
    blind: frozenset[int] = frozenset()
    ambiguous: frozenset[int] = frozenset()
    spacecraft: Spacecraft = field(default_factory=toy_spacecraft)
    has_locator: bool = True

    def estimate(self, image: ndarray, camera: Camera, box: Box | None = None) -> Estimate:
        number = picture_number(image)
        if number in self.blind:
            return Estimate(failure=Failure(FailureKind.NO_SPACECRAFT, "the locator finds no spacecraft"))
        truth, random = toy_pose(number), np.random.default_rng([9, number])
        pixels = camera.project(truth.transform(self.spacecraft.points_m))
        count = len(pixels)
        found = Box.around(pixels).clipped(camera.width, camera.height)
        turn = Pose.from_rotation_vector(self.error * random.normal(0, 0.02, 3), self.error * random.normal(0, 0.05, 3))
        moved = Pose(turn.rotation @ truth.rotation, truth.translation_m + turn.translation_m)
        keypoints = Keypoints(
            pixels + self.error * random.normal(0, 1, (count, 2)),
            random.uniform(0.3, 1, count),
            np.tile(np.eye(2), (count, 1, 1)),
        )
        covariance = np.diag([4e-4, 4e-4, 4e-4, 2.5e-3, 2.5e-3, 2.5e-3])
        inliers, confidence = np.ones(count, dtype=bool), 0.2 if number in self.ambiguous else 0.9
        return Estimate(keypoints, moved, covariance, inliers, self.error, box or found, attitude_confidence=confidence)


@dataclass(frozen=True, eq=False)
class Noting(ToyEstimator):
    """Notes the boxes that it is given."""

    given: list[Box | None] = field(default_factory=list)

    def estimate(self, image: ndarray, camera: Camera, box: Box | None = None) -> Estimate:
        self.given.append(box)
        return super().estimate(image, camera, box)
