"""The authors' layout both ways: our folders in a reader that knows its rules alone, and folders of theirs in ours."""

from __future__ import annotations

import ast
import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gknet.dataset.skd import SkdDataset
from gknet.dataset.skd_format import SPLITS, Annotation, row_of, sequence_name
from gknet.dataset.skd_write import (
    write_annotations,
    write_camera_matrix,
    write_frame_files,
    write_sequence_files,
    write_splits,
)
from gknet.errors import GknetError
from gknet.frame import Frame
from gknet.geometry import Camera, Pose
from gknet.io.torch_file import load_torch_file
from gknet.spacecraft import Spacecraft
from tests.dataset import authors

SIZE = 96
CAMERA = Camera.from_focal(120.0, SIZE, SIZE)
POINTS = np.random.default_rng(5).uniform(-2, 2, (11, 3)) * (2, 1, 0.5)
EDGES = ((0, 1), (1, 2), (3, 7), (0, 10))
CRAFTS = ("satellite_01", "satellite_02")


def pose(random: np.random.Generator) -> Pose:
    """Often cut off by the image's border, never with every keypoint outside; one in three is a half turn."""
    place = np.array([*random.uniform(-3, 3, 2), random.uniform(8, 14)])
    xyzw = random.normal(size=4)
    if random.random() < 1 / 3:
        xyzw[3] = random.choice([0.0, 1e-9])
    return Pose(Rotation.from_quat(xyzw).as_matrix(), place)


def picture(random: np.random.Generator) -> np.ndarray:
    return random.integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six sequences of four frames, two spacecraft in each split, with everything that a row of ours can hold."""
    root, random = tmp_path_factory.mktemp("ours"), np.random.default_rng(6)
    for sequence in range(6):
        name, folder = CRAFTS[sequence % 2], root / sequence_name(sequence)
        craft = Spacecraft(name, tuple(f"k{k}" for k in range(11)), POINTS + sequence % 2, EDGES, diameter_m=9.0)
        write_sequence_files(folder, CAMERA, craft)
        rows = []
        for index in range(4):
            visible, sun = random.random(11) > 0.4, np.array([0.6, 0.0, -0.8])
            category, cam_from_body = name.capitalize(), pose(random)
            label = Annotation(category, index, cam_from_body, 2.0 * index, visible, sun, True, CAMERA, "skd", 3)
            write_frame_files(folder, index, picture(random), 95, None, None)
            rows.append(row_of(label))
        write_annotations(folder, rows)
    write_camera_matrix(root / "camera_matrix.txt", CAMERA)
    write_splits(root, lambda sequence: SPLITS[sequence // 2], lambda sequence: CRAFTS[sequence % 2])
    return root


def assert_same(record: authors.Record, frame: Frame, image_path: Path, points_m: np.ndarray) -> None:
    """The other reader and ours agree on a frame."""
    assert frame.cam_from_body is not None
    assert record.image_path == image_path
    np.testing.assert_allclose(record.matrix, frame.camera.matrix, atol=1e-6)
    np.testing.assert_allclose(record.points, points_m, atol=1e-8)
    np.testing.assert_allclose(record.rotation, frame.cam_from_body.rotation, atol=1e-7)
    np.testing.assert_allclose(record.translation, frame.cam_from_body.translation_m, atol=1e-7)
    np.testing.assert_allclose(record.keypoints, frame.keypoints_px(points_m), atol=1e-4)
    box = frame.true_box(points_m)
    assert (box is None) == (record.box is None)
    if box is not None:
        assert record.box is not None
        np.testing.assert_allclose(record.box, np.array([box.x0, box.y0, box.x1, box.y1]), atol=1e-4)


def test_the_other_reader_agrees_with_ours_on_a_folder_of_ours(ours: Path) -> None:
    records = authors.read(ours, SIZE)
    cut_off = [r for r in records if ((r.keypoints < 0) | (r.keypoints > SIZE)).any()]
    assert (len(records), len({r.category for r in records})) == (24, 2)
    assert 4 < len(cut_off) < 24
    compared = 0
    for split in SPLITS:
        for name in CRAFTS:
            dataset = SkdDataset(ours, split, name)
            theirs = [r for r in records if (r.split, r.category) == (split, name.capitalize())]
            for i, (record, frame) in enumerate(zip(theirs, dataset, strict=True)):
                assert_same(record, frame, dataset.extras(i).image_path, dataset.spacecraft.points_m)
                image = cv2.imread(str(record.image_path))
                assert image is not None
                assert frame.image is not None
                np.testing.assert_array_equal(image[:, :, ::-1], frame.image)
                compared += 1
    assert compared == 24


def test_the_skeletons_of_our_folders_load_as_theirs(ours: Path) -> None:
    torch = pytest.importorskip("torch")
    for name in ("skeleton.pth", "skeleton_pres.pth"):
        edges = torch.load(ours / "data/000001" / name, weights_only=True)
        assert isinstance(edges, list)  # their loader appends to it
        assert sorted(map(tuple, edges)) == sorted(EDGES)


def write_theirs(root: Path) -> dict[str, list[authors.Shot]]:
    """Three frames of one spacecraft in each split."""
    pytest.importorskip("torch")
    random = np.random.default_rng(8)
    shots = {}
    for split in SPLITS:
        poses = [pose(random) for _ in range(3)]
        shots[split] = [authors.Shot(picture(random), p.rotation, p.translation_m) for p in poses]
    authors.write(root, "Satellite_03", CAMERA.matrix, POINTS, list(EDGES), shots)
    return shots


def test_a_folder_of_theirs_reads_as_it_was_written(tmp_path: Path) -> None:
    shots = write_theirs(tmp_path)
    for split, written in shots.items():
        dataset = SkdDataset(tmp_path, split, "satellite_03")
        assert dataset.spacecraft.edges == tuple(sorted(EDGES))
        np.testing.assert_allclose(dataset.spacecraft.points_m, POINTS)
        for i, (shot, frame) in enumerate(zip(written, dataset, strict=True)):
            assert frame.cam_from_body is not None
            np.testing.assert_allclose(frame.cam_from_body.rotation, shot.rotation, atol=1e-9)
            np.testing.assert_allclose(frame.cam_from_body.translation_m, shot.translation, atol=1e-9)
            np.testing.assert_allclose(frame.camera.matrix, CAMERA.matrix)
            assert (frame.camera.width, frame.camera.height) == (SIZE, SIZE)
            assert frame.visible is frame.sun_direction is frame.time_s is None
            extras = dataset.extras(i)
            assert frame.earth_in_view is extras.recipe is extras.seed is extras.mask_path is extras.depth_path is None
    for record in authors.read(tmp_path, SIZE):
        dataset = SkdDataset(tmp_path, record.split)
        i = int(record.image_path.stem) - 1
        assert_same(record, dataset.frame(i), dataset.extras(i).image_path, dataset.spacecraft.points_m)


def test_a_quaternion_and_its_negative_are_one_pose(tmp_path: Path) -> None:
    write_theirs(tmp_path)
    before = [frame.cam_from_body for frame in SkdDataset(tmp_path)]
    for table in tmp_path.glob("data/*/annotations.csv"):
        with open(table, newline="") as file:
            rows = list(csv.DictReader(file))
        with open(table, "w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            for row in rows:
                row["orientation"] = str([-value for value in ast.literal_eval(row["orientation"])])
                writer.writerow(row)
    for one, frame in zip(before, SkdDataset(tmp_path), strict=True):
        assert one is not None
        assert frame.cam_from_body is not None
        np.testing.assert_array_equal(one.rotation, frame.cam_from_body.rotation)


def test_row_i_is_the_picture_i_plus_1_whatever_pictures_are_lost(tmp_path: Path) -> None:
    shots = write_theirs(tmp_path)
    images = tmp_path / "data/000001/image"
    (images / "000001.jpg").unlink()
    dataset = SkdDataset(tmp_path, "train")
    with pytest.raises(GknetError, match=r"000001.jpg"):
        dataset.frame(0)
    for i in (1, 2):
        frame = dataset.frame(i)
        assert frame.cam_from_body is not None
        np.testing.assert_allclose(frame.cam_from_body.translation_m, shots["train"][i].translation, atol=1e-9)
        assert dataset.extras(i).image_path.name == f"00000{i + 1}.jpg"
    assert dataset.frame(0, image=False).camera.width == SIZE
    cv2.imwrite(str(images / "000002.jpg"), np.zeros((SIZE, SIZE + 8, 3), np.uint8))
    with pytest.raises(GknetError, match=r"000002.jpg: expected 96 x 96 pixels"):
        dataset.frame(1)
    (images / "000003.jpg").rename(images / "000007.jpg")
    with pytest.raises(GknetError, match=r"3 rows, yet there is an image 000007"):
        SkdDataset(tmp_path, "train")


def test_a_skeleton_is_read_once_and_not_for_each_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_theirs(tmp_path)
    read: list[Path] = []

    def counted(path: Path) -> object:
        read.append(path)
        return load_torch_file(path)

    monkeypatch.setattr("gknet.dataset.skd_sequence.load_torch_file", counted)
    dataset = SkdDataset(tmp_path)
    assert len([(frame, dataset.spacecraft) for frame in dataset]) == 9
    assert len(read) == 1
