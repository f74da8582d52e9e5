"""The SKD layout: what we write comes back, and what is damaged is named."""

from __future__ import annotations

import ast
import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gknet.dataset.skd import SkdDataset, open_dataset
from gknet.dataset.skd_format import SPLITS, Annotation, row_of, sequence_name
from gknet.dataset.skd_write import write_annotations, write_frame_files, write_sequence_files, write_splits
from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.io.spacecraft_file import save_spacecraft
from gknet.spacecraft import Spacecraft

POINTS = np.array([[1.2, 0.1, -0.3], [-1.1, 0.7, 0.2], [0.3, -1.4, 0.9], [0.5, 0.4, 1.7], [-0.6, -0.8, -1.3]])
EDGES = ((0, 1), (1, 2), (2, 3), (0, 4))
SIZE = 96


Written = tuple[Path, dict[tuple[int, int], Annotation]]
"""A dataset's folder, and the truth by sequence and frame."""


def craft(name: str, points: np.ndarray = POINTS) -> Spacecraft:
    names = tuple(f"{name}_point_{k}" for k in range(len(points)))
    return Spacecraft(name, names, points, EDGES, diameter_m=3.5)


def annotation(category: str, index: int, random: np.random.Generator, count: int = len(POINTS)) -> Annotation:
    rotation = Rotation.random(random_state=random).as_matrix()
    window = Crop(int(random.integers(-20, 40)), int(random.integers(-20, 40)), 60 + index, SIZE)
    full = Camera.from_focal(140.0, 128, 128)
    sun = random.normal(size=3)
    return Annotation(
        category=category,
        index=index,
        cam_from_body=Pose(rotation, np.array([random.normal(), random.normal(), 9 + random.random()])),
        time_s=2.5 * index,
        visible=random.random(count) > 0.5,
        sun_direction=sun / np.linalg.norm(sun),
        earth=bool(index % 2),
        camera=full.warped(window.input_from_image, SIZE, SIZE),
        recipe="skd",
        seed=7,
    )


def spacecraft_of(sequence: int) -> str:
    return ("satellite_01", "satellite_02")[sequence % 2]


def split_of(sequence: int) -> str:
    return SPLITS[sequence // 2]


@pytest.fixture
def written(tmp_path: Path) -> Written:
    """Six sequences of two spacecraft, frames 0, 2 and 5 of each."""
    random = np.random.default_rng(3)
    truth = {}
    (tmp_path / "spacecraft").mkdir()
    for name in ("satellite_01", "satellite_02"):
        save_spacecraft(craft(name), tmp_path / "spacecraft" / f"{name}.toml")
    for sequence in range(6):
        name = spacecraft_of(sequence)
        folder = tmp_path / sequence_name(sequence)
        write_sequence_files(folder, Camera.from_focal(140.0, 128, 128), craft(name))
        rows = []
        for index in (5, 0, 2):
            truth[sequence, index] = annotation(name.capitalize(), index, random)
            rgb = random.integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8)
            write_frame_files(folder, index, rgb, 95, rgb[..., 0] > 100, None)
            rows.append(row_of(truth[sequence, index]))
        write_annotations(folder, rows)
    write_splits(tmp_path, split_of, spacecraft_of)
    return tmp_path, truth


def strip_to_original(root: Path) -> None:
    """Leave only what the authors' layout has, with frames numbered without a gap."""
    for path in (root / "spacecraft").glob("*"):
        path.unlink()
    for folder in (root / "data").iterdir():
        (folder / "skeleton.json").unlink(missing_ok=True)
        with open(folder / "annotations.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        with open(folder / "annotations.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, ["category", "position", "orientation"], extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        for rank, image in enumerate(sorted((folder / "image").glob("*.jpg"))):
            image.rename(image.with_name(f"{rank + 1:06d}.jpg"))


def test_poses_points_cameras_and_extras_come_back(written: Written) -> None:
    root, truth = written
    dataset = SkdDataset(root, spacecraft="satellite_02")
    assert len(dataset) == 9
    np.testing.assert_allclose(dataset.spacecraft.points_m, POINTS, atol=1e-4)
    assert dataset.spacecraft.keypoint_names[3] == "satellite_02_point_3"
    assert dataset.spacecraft.edges == tuple(sorted(EDGES))
    for i, frame in enumerate(dataset):
        extras = dataset.extras(i)
        expected = truth[int(dataset.sequence_of(i).split("/")[1]) - 1, extras.index]
        assert frame.cam_from_body is not None
        assert expected.camera is not None
        assert frame.image is not None
        assert frame.sun_direction is not None
        assert expected.sun_direction is not None
        np.testing.assert_allclose(frame.cam_from_body.rotation, expected.cam_from_body.rotation, atol=1e-8)
        np.testing.assert_allclose(frame.cam_from_body.translation_m, expected.cam_from_body.translation_m, rtol=1e-8)
        np.testing.assert_allclose(frame.camera.matrix, expected.camera.matrix, rtol=1e-8)
        np.testing.assert_allclose(frame.sun_direction, expected.sun_direction, atol=1e-8)
        np.testing.assert_array_equal(frame.visible, expected.visible)
        assert (frame.time_s, frame.earth_in_view, extras.recipe, extras.seed) == (
            expected.time_s,
            expected.earth,
            "skd",
            7,
        )
        assert frame.image.shape == (SIZE, SIZE, 3)
        assert extras.mask_path is not None
        assert extras.depth_path is None


def test_stored_axes_are_unreals(tmp_path: Path) -> None:
    """A craft 5 m ahead, 1 m to the right and 2 m up, unturned."""
    camera = Camera.from_focal(140.0, 128, 128)
    pose = Pose(np.eye(3), np.array([1.0, -2.0, 5.0]))
    row = row_of(
        Annotation(
            "Satellite_01", 0, pose, visible=np.ones(5, bool), sun_direction=np.array([0.0, 0.0, 1.0]), camera=camera
        )
    )
    assert ast.literal_eval(row["position"]) == [5, 1, -2]
    assert ast.literal_eval(row["orientation"]) == [0, 0, 0, 1]
    assert ast.literal_eval(row["sun_direction"]) == [1, 0, 0]
    write_sequence_files(tmp_path, camera, craft("satellite_01"))
    stored = np.loadtxt(tmp_path / "camera_matrix.txt", delimiter=",")
    np.testing.assert_array_equal(stored, [[64, 140, 0], [64, 0, 140], [1, 0, 0]])


def test_original_layout_reads_without_our_extras(written: Written) -> None:
    root, truth = written
    pytest.importorskip("torch")
    strip_to_original(root)
    dataset = SkdDataset(root, "val", spacecraft="Satellite_01")
    assert [dataset.extras(i).index for i in range(len(dataset))] == [0, 1, 2]
    frame = dataset.frame(1, image=False)
    assert frame.visible is None
    assert frame.image is None
    assert frame.cam_from_body is not None
    np.testing.assert_allclose(frame.camera.matrix, Camera.from_focal(140.0, 128, 128).matrix)
    assert (frame.camera.width, frame.camera.height) == (SIZE, SIZE)
    np.testing.assert_allclose(
        frame.cam_from_body.translation_m, truth[2, 2].cam_from_body.translation_m, rtol=1e-8, atol=1e-8
    )
    assert dataset.spacecraft.keypoint_names[:2] == ("keypoint_01", "keypoint_02")
    assert dataset.spacecraft.edges == tuple(sorted(EDGES))


def test_skeleton_json_serves_where_the_toml_is_absent(written: Written) -> None:
    root, _ = written
    for path in (root / "spacecraft").glob("*"):
        path.unlink()
    spacecraft = SkdDataset(root, spacecraft="satellite_01").spacecraft
    assert spacecraft.keypoint_names[0] == "satellite_01_point_0"
    assert spacecraft.edges == tuple(sorted(EDGES))


def test_splits_partition_and_every_thins(written: Written) -> None:
    root, _ = written
    names = {split: {SkdDataset(root, split).sequence_of(i) for i in range(6)} for split in SPLITS}
    assert set.union(*names.values()) == {sequence_name(s) for s in range(6)}
    assert sum(len(part) for part in names.values()) == 6
    thin = SkdDataset(root, "train", "satellite_01", every=2)
    assert [thin.extras(i).index for i in range(len(thin))] == [0, 5]
    assert [frame.name for frame in thin[:2]] == ["000001/000001", "000001/000006"]


def test_several_spacecraft_need_a_choice(written: Written) -> None:
    root, _ = written
    with pytest.raises(GknetError, match=r"Satellite_01, Satellite_02"):
        _ = SkdDataset(root).spacecraft
    with pytest.raises(GknetError, match=r"Satellite_01, Satellite_02"):
        SkdDataset(root, spacecraft="satellite_09")


def edit_cell(root: Path, column: str, text: str) -> None:
    """Change a cell of the second row of the first sequence."""
    path = root / "data/000001/annotations.csv"
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    rows[1][column] = text
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


@pytest.mark.parametrize(
    ("column", "text"),
    [
        ("position", "[nan, 0, 1]"),
        ("position", "[1e999, 0, 1]"),
        ("position", "__import__('os')"),
        ("orientation", "[0, 0, 1]"),
        ("orientation", "[0, 0, 0, 0]"),
        ("orientation", ""),
        ("visible", "[1, 0]"),
        ("camera", "[0, 1, 2, 3, 4, 5]"),
        ("time_s", "soon"),
    ],
)
def test_a_bad_cell_is_named(written: Written, column: str, text: str) -> None:
    root, _ = written
    edit_cell(root, column, text)
    dataset = SkdDataset(root, "train", "satellite_01")
    dataset.frame(0)
    with pytest.raises(GknetError, match=r"000001/annotations.csv: row 2"):
        dataset.frame(1)


def damage_json(root: Path) -> None:
    (root / "train.json").write_text('{"Satellite_01": "data/000001"}')


def cut_json(root: Path) -> None:
    (root / "train.json").write_text('{"Satellite_01": [')


def list_twice(root: Path) -> None:
    (root / "val.json").write_text(json.dumps({"Satellite_01": ["data/000001"]}))


def drop_column(root: Path) -> None:
    path = root / "data/000001/annotations.csv"
    path.write_text(path.read_text().replace("orientation", "attitude"))


def drop_cells(root: Path) -> None:
    path = root / "data/000001/annotations.csv"
    path.write_text(path.read_text() + "Satellite_01\n")


def opencv_matrix(root: Path) -> None:
    (root / "data/000001/camera_matrix.txt").write_text("1400, 0, 512\n0, 1400, 512\n0, 0, 1\n")


def flat_matrix(root: Path) -> None:
    (root / "data/000001/camera_matrix.txt").write_text("512, 1400, 0\n512, 0, 1400\n")


def nan_keypoint(root: Path) -> None:
    (root / "data/000001/keypoints.txt").write_text("1, 2, 3\n1, nan, 3\n")


def lose_annotations(root: Path) -> None:
    (root / "data/000001/annotations.csv").unlink()


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (damage_json, "train.json"),
        (cut_json, "train.json"),
        (list_twice, "data/000001"),
        (drop_column, "'orientation'"),
        (drop_cells, "row 4"),
        (opencv_matrix, "camera_matrix.txt"),
        (flat_matrix, "3 x 3"),
        (nan_keypoint, "keypoints.txt: row 2"),
        (lose_annotations, "annotations.csv"),
    ],
)
def test_damaged_files_are_named(written: Written, damage: Callable[[Path], None], named: str) -> None:
    root, _ = written
    damage(root)
    with pytest.raises(GknetError, match=named) as caught:
        SkdDataset(root)
    assert "\n" not in str(caught.value)


def test_a_truncated_image_is_refused(written: Written) -> None:
    root, _ = written
    path = root / "data/000001/image/000001.jpg"
    path.write_bytes(path.read_bytes()[:-200])
    dataset = SkdDataset(root, "train", "satellite_01")
    with pytest.raises(GknetError, match=r"000001.jpg.*truncated"):
        dataset.frame(0)
    assert dataset.frame(0, image=False).image is None
    path.unlink()
    with pytest.raises(GknetError, match=r"000001.jpg"):
        dataset.frame(0)


def test_another_spacecrafts_keypoints_are_refused(written: Written) -> None:
    root, _ = written
    write_sequence_files(root / "data/000003", Camera.from_focal(140.0, 128, 128), craft("x", POINTS + 0.1))
    with pytest.raises(GknetError, match=r"000003/keypoints.txt"):
        _ = SkdDataset(root, spacecraft="satellite_01").spacecraft


def test_a_split_without_the_spacecraft_is_named_with_what_there_is(written: Written) -> None:
    root, _ = written
    (root / "train.json").write_text('{"Satellite_01": []}')
    (root / "val.json").write_text("{")
    (root / "test.json").write_text('{"Satellite_01": ["data/000001"], "Satellite_02": ["data/000002"]}')
    with pytest.raises(GknetError) as caught:
        SkdDataset(root, "train", "satellite_01")
    held = "test (Satellite_01, Satellite_02)"
    assert str(caught.value) == f"{root}: no sequence of 'satellite_01' in the split 'train'; it has: {held}"
    (root / "val.json").unlink()
    with pytest.raises(GknetError, match=r"no sequence of 'satellite_07'; it has: test \(Satellite_01, Satellite_02\)"):
        SkdDataset(root, None, "satellite_07")
    (root / "train.json").unlink()
    with pytest.raises(GknetError, match=r"expected train.json, found none; it has: test \(Satellite_01"):
        SkdDataset(root, "train", "satellite_01")


def test_missing_root_split_and_bad_arguments(tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="no such dataset folder"):
        SkdDataset(tmp_path / "nowhere")
    with pytest.raises(GknetError, match=r"train.json"):
        SkdDataset(tmp_path)
    with pytest.raises(GknetError, match="expected one of train, val, test"):
        SkdDataset(tmp_path, "dev")
    with pytest.raises(GknetError, match="every"):
        SkdDataset(tmp_path, every=0)


def test_a_broken_skeleton_pth_is_named(written: Written) -> None:
    root, _ = written
    pytest.importorskip("torch")
    strip_to_original(root)
    (root / "data/000001/skeleton.pth").write_bytes(b"not a pickle")
    with pytest.raises(GknetError, match=r"skeleton.pth"):
        _ = SkdDataset(root, spacecraft="satellite_01").spacecraft


@pytest.mark.parametrize("category", ["envisat", "Envisat"])
@pytest.mark.parametrize("name", ["envisat", "Envisat"])
def test_the_case_of_a_names_first_letter_is_the_datasets(written: Written, category: str, name: str) -> None:
    root, _ = written
    listing = json.loads((root / "train.json").read_text())
    (root / "train.json").write_text(json.dumps({category: listing["Satellite_01"]}))
    (root / "spacecraft/satellite_01.toml").rename(root / f"spacecraft/{name}.toml")
    dataset = SkdDataset(root, "train", name)
    assert dataset.categories == (category,)
    assert dataset.spacecraft.keypoint_names[0] == "satellite_01_point_0"
    assert len(open_dataset(root, replace(craft("satellite_01"), name=name), "train", every=1)) == len(dataset) == 3


def test_the_exact_name_goes_first(written: Written) -> None:
    root, _ = written
    (root / "train.json").write_text(json.dumps({"Envisat": ["data/000001"], "envisat": ["data/000003"]}))
    for name, sequence in (("Envisat", "data/000001"), ("envisat", "data/000003")):
        assert SkdDataset(root, "train", name).sequence_of(0) == sequence


def test_byte_order_marks_are_no_fault(written: Written) -> None:
    root, _ = written
    for path in root.rglob("*"):
        if path.suffix in (".json", ".csv", ".txt", ".toml"):
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    dataset = SkdDataset(root, spacecraft="satellite_01")
    assert dataset.spacecraft.keypoint_count == len(POINTS)
    assert dataset.frame(0).image is not None


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("train.json", 100_000 * "[" + 100_000 * "]", "nested too deeply"),
        ("train.json", f'{{"Satellite_01": {"9" * 5000}}}', "digits"),
        ("train.json", '{"Satellite_01": ["../other/data/000001"]}', "inside of the dataset"),
        ("train.json", '{"Satellite_01": ["/etc"]}', "inside of the dataset"),
        ("data/000001/keypoints.txt", "1 2 3\n" * 8000, "at most"),
        ("data/000001/keypoints.txt", "1e308 2 3\n" * 5, "keypoints"),
        ("data/000001/skeleton.json", '{"keypoint_names": 3}', "keypoint_names"),
        ("data/000001/skeleton.json", 100_000 * "[" + 100_000 * "]", "nested too deeply"),
    ],
)
def test_files_beyond_all_bounds_are_one_line(written: Written, file: str, content: str, named: str) -> None:
    root, _ = written
    for path in (root / "spacecraft").glob("*"):
        path.unlink()
    (root / file).write_text(content)
    with pytest.raises(GknetError, match=rf"{file}.*{named}") as caught:
        _ = SkdDataset(root, "train", "satellite_01").spacecraft
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("cell", ["", "-1", "1.5", "soon", "9" * 5000])
def test_a_frame_that_is_no_number_is_named(written: Written, cell: str) -> None:
    root, _ = written
    edit_cell(root, "frame", cell)
    with pytest.raises(GknetError, match=r"annotations.csv: row 2: frame") as caught:
        SkdDataset(root, "train", "satellite_01")
    assert len(str(caught.value)) < 500


def test_linked_sequences_are_followed_and_a_bad_root_is_one_line(written: Written, tmp_path: Path) -> None:
    root, _ = written
    (root / "data/000001").rename(tmp_path / "elsewhere")
    (root / "data/000001").symlink_to(tmp_path / "elsewhere")
    assert SkdDataset(root, "train", "satellite_01").frame(0).image is not None
    for bad in ("x" * 300, "a" * 5000):
        with pytest.raises(GknetError, match="dataset folder"):
            SkdDataset(root / bad)
