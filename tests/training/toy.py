"""A drawn craft: a box and two wings as flat-coloured faces, painted from far to near, with exact poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.dataset.skd_format import Annotation, row_of
from gknet.dataset.skd_write import write_annotations, write_frame_files, write_sequence_files, write_splits
from gknet.errors import GknetError
from gknet.frame import Box, Frame
from gknet.geometry import Camera, Pose
from gknet.io.spacecraft_file import save_spacecraft
from gknet.spacecraft import Spacecraft

BOX = np.array([(x, y, z) for x in (-1, 1) for y in (-0.8, 0.8) for z in (-0.6, 0.6)], dtype=float)
WINGS = np.array([(s * x, y, 0.1) for s in (-1, 1) for x in (1.2, 3.2) for y in (-0.5, 0.5)], dtype=float)
MAST = np.array([(0.4, 0.3, 2.0)])
POINTS = np.concatenate([BOX, WINGS, MAST])
FACES = {
    (0, 1, 3, 2): (200, 150, 40),
    (4, 5, 7, 6): (160, 160, 170),
    (0, 1, 5, 4): (190, 130, 30),
    (2, 3, 7, 6): (120, 90, 30),
    (0, 2, 6, 4): (90, 90, 100),
    (1, 3, 7, 5): (220, 220, 220),
    (8, 9, 11, 10): (40, 50, 160),
    (12, 13, 15, 14): (60, 40, 150),
}
EDGES: tuple[tuple[int, int], ...] = (
    (0, 1),
    (0, 2),
    (1, 3),
    (2, 3),
    (4, 5),
    (4, 6),
    (5, 7),
    (6, 7),
    (0, 4),
    (1, 5),
    (2, 6),
    (3, 7),
)
EDGES += ((8, 9), (8, 10), (9, 11), (10, 11), (12, 13), (12, 14), (13, 15), (14, 15), (5, 16), (7, 16))


def toy_spacecraft() -> Spacecraft:
    names = tuple(f"point_{k:02d}" for k in range(len(POINTS)))
    return Spacecraft("satellite_01", names, POINTS, EDGES, diameter_m=6.5)


def drawn(camera: Camera, pose: Pose, light: float = 1.0) -> ndarray:
    """RGB uint8 of the craft; sub-pixel edges."""
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    points_cam = pose.transform(POINTS)
    pixels = camera.project(points_cam)
    far_first = sorted(FACES, key=lambda face: -points_cam[list(face), 2].mean())
    for face in far_first:
        corners = np.rint((pixels[list(face)] - 0.5) * 256).astype(np.int32)
        colour = tuple(float(c * light) for c in FACES[face])
        cv2.fillConvexPoly(image, corners, colour, cv2.LINE_AA, 8)
    mast = np.rint((np.stack([pixels[[5, 7]].mean(axis=0), pixels[16]]) - 0.5) * 256).astype(np.int32)
    cv2.line(image, mast[0].tolist(), mast[1].tolist(), (230.0, 230.0, 240.0), 2, cv2.LINE_AA, 8)
    return image


def random_pose(rng: np.random.Generator) -> Pose:
    place = np.array([rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), rng.uniform(9, 16)])
    return Pose(Rotation.random(rng=rng).as_matrix(), place)


def write_toy(root: Path, train: int, val: int, size: int = 128, seed: int = 0) -> Spacecraft:
    """An SKD folder with one sequence of `train` frames and one of `val`."""
    spacecraft = toy_spacecraft()
    camera = Camera.from_focal(size * 1.2, size, size)
    (root / "spacecraft").mkdir(parents=True, exist_ok=True)
    save_spacecraft(spacecraft, root / "spacecraft" / "satellite_01.toml")
    for sequence, count in enumerate((train, val)):
        folder = root / "data" / f"{sequence + 1:06d}"
        write_sequence_files(folder, camera, spacecraft)
        rows = []
        for index in range(count):
            rng = np.random.default_rng((seed, sequence, index))
            pose = random_pose(rng)
            image = drawn(camera, pose, rng.uniform(0.6, 1.0))
            write_frame_files(folder, index, image, 95, None, None)
            visible = np.ones(len(POINTS), dtype=bool)
            sun = np.array([0.0, 0.0, -1.0])
            rows.append(row_of(Annotation("Satellite_01", index, pose, 0.0, visible, sun, False, camera, "toy", seed)))
        write_annotations(folder, rows)
    write_splits(root, lambda sequence: ("train", "val")[sequence], lambda sequence: "satellite_01")
    return spacecraft


CRAFT = toy_spacecraft()


def a_frame(place: tuple[float, float, float] = (0.3, -0.2, 12.0), size: int = 512) -> Frame:
    camera = Camera.from_focal(1.2 * size, size, size)
    pose = Pose.from_rotation_vector([0.5, 0.2, -0.7], place)
    return Frame("one", drawn(camera, pose), camera, pose)


def box_of(frame: Frame) -> Box:
    box = frame.true_box(POINTS)
    assert box is not None
    return box


class Frames:
    """A dataset in memory; frame `bad` cannot be read."""

    def __init__(self, frames: list[Frame], bad: int = -1) -> None:
        self.frames, self.bad, self.reads = frames, bad, 0

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, i: int, image: bool = True) -> Frame:
        if image:
            self.reads += 1
            if i == self.bad:
                raise GknetError("frame 1: truncated")
        return self.frames[i] if image else replace(self.frames[i], image=None)
