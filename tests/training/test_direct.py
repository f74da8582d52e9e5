"""A direct network's labels follow the augmentation, its training learns, and what is exported is what was trained."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")

import torch

from gknet.cli.main import run as command
from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.frame import Frame
from gknet.geometry import Camera, Pose
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.crop_pose import CropPose
from gknet.inference.direct_estimator import DirectEstimator, decode_output
from gknet.inference.load import load_estimator
from gknet.network.build import build
from gknet.network.direct_pose import PoseBranches
from gknet.network.dmanet import DMANet, DMANetConfig
from gknet.training.augment import Augmentation, craft_warp, rotation
from gknet.training.batch import Loader, draw_box, draw_keypoints
from gknet.training.cache import Cache, build_cache, cached_row, craft_window
from gknet.training.export import export_run
from gknet.training.loss import direct_loss
from gknet.training.schedule import Stage
from gknet.training.settings import TrainSettings
from gknet.training.setup import check_cameras, make_task
from gknet.training.tasks import DirectTask
from gknet.training.train import train
from gknet.training.validation import validate_direct
from tests.training.toy import POINTS, drawn, toy_spacecraft

CRAFT = toy_spacecraft()
CACHE_SIZE, INPUT_SIZE = 160, 64
SETTINGS = TrainSettings(
    network="dmanet-xs",
    epochs=1,
    stages=(Stage(1.0, 64, 4),),
    precision="32-true",
    device="cpu",
    cache_size=96,
    val_frames=2,
    validations=1,
)


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "direct"
    train(data, "satellite_01", out, SETTINGS, quiet=True)
    return out


@pytest.fixture(scope="module")
def model(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("models") / "direct"
    export_run(finished, out)
    return out


def a_frame(k: int, distortion: float = 0.0) -> Frame:
    """Aside in the image, so that the line of sight is not the axis."""
    lens = np.array([distortion, 0, 0, 0, 0])
    camera = Camera(np.array([[600.0, 0, 230], [0, 600, 290], [0, 0, 1]]), 512, 512, lens)
    rng = np.random.default_rng(k)
    pose = Pose.from_quaternion(rng.normal(size=4), [*rng.uniform(-3, 3, 2), rng.uniform(11, 25)])
    return Frame(f"frame {k}", drawn(camera, pose), camera, pose)


def cache_of(frame: Frame) -> Cache:
    row = cached_row(frame, CRAFT, "craft", CACHE_SIZE)
    assert row is not None
    return Cache(row.image[None], row.points_px[None], row.in_view[None], row.box_px[None], row.pose[None])


@pytest.mark.parametrize("seed", range(12))
def test_the_pose_of_a_sample_puts_the_keypoints_where_they_are(seed: int) -> None:
    """The camera of a turned, scaled and shifted crop is K' = warp K R_z^T; the told pose must project through it."""
    frame = a_frame(seed)
    box = frame.true_box(POINTS)
    assert box is not None
    cache = cache_of(frame)
    sample = draw_keypoints(np.random.default_rng(seed), cache, 0, INPUT_SIZE)
    points = cache.points_px[0]
    warp = craft_warp(np.random.default_rng(seed), points, cache.in_view[0], INPUT_SIZE, Augmentation())
    turn = rotation(math.atan2(warp[1, 0], warp[0, 0]))
    window = craft_window(frame, box, CACHE_SIZE)
    matrix = warp @ window.input_from_image @ frame.camera.matrix @ turn.T
    rolled = Camera(matrix, INPUT_SIZE, INPUT_SIZE)
    told = CropPose.from_vector(sample.pose.astype(float)).pose(
        rolled, Crop(0, 0, INPUT_SIZE, INPUT_SIZE), CRAFT.diameter_m
    )
    seen = sample.weight > 0
    assert told is not None
    assert seen.sum() >= 8
    np.testing.assert_allclose(rolled.project(told.transform(POINTS))[seen], sample.points_px[seen], atol=1e-3)


def test_a_symmetric_lens_rolls_with_the_camera() -> None:
    """The label of a turned image is the label of the image that a rolled camera would take."""
    frame = replace(a_frame(3, distortion=-0.2))
    matrix = frame.camera.matrix.copy()
    matrix[:2, 2] = 256
    camera = Camera(matrix, 512, 512, frame.camera.distortion)
    assert frame.cam_from_body is not None
    whole = Crop(0, 0, 512, 512)
    shown = CropPose.of(frame.cam_from_body, camera, whole, 6.5)
    roll = rotation(0.7)
    pose = Pose(roll @ frame.cam_from_body.rotation, roll @ frame.cam_from_body.translation_m)
    rolled = CropPose.of(pose, camera, whole, 6.5)
    about_centre = (
        np.array([[1, 0, 256], [0, 1, 256], [0, 0, 1.0]]) @ roll @ np.array([[1, 0, -256], [0, 1, -256], [0, 0, 1]])
    )
    assert shown is not None
    assert rolled is not None
    found = shown.warped(about_centre, 512, 512)
    np.testing.assert_allclose(found.offset, rolled.offset, atol=1e-6)
    np.testing.assert_allclose(found.log_depth, rolled.log_depth, atol=1e-9)
    assert abs(found.attitude_wxyz @ rolled.attitude_wxyz) == pytest.approx(1, abs=1e-12)


def test_the_whole_picture_of_the_locator_has_its_pose_too(data: Path) -> None:
    dataset = SkdDataset(data, "train", "satellite_01")
    cache = build_cache(dataset, dataset.spacecraft, data / "cache_image", 96, "image")
    sample = Loader(cache, draw_box, 0).sample(0, 64)
    assert np.isfinite(sample.pose).all()


def test_the_loss_is_nothing_at_the_truth_and_leaves_out_what_has_no_pose() -> None:
    bins = AttitudeBins(8)
    pose = torch.tensor([[0.1, -0.2, 0.3, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0, 1.0]])
    label = torch.from_numpy(bins.soft_label(pose[:, 3:].numpy())).float()
    true = PoseBranches(pose[:, :2], pose[:, 2], label.clamp(min=1e-30).log())
    both = torch.ones(2)
    assert direct_loss(true, pose, label, both).item() == pytest.approx(0, abs=1e-5)
    for moved in (
        true._replace(offset=true.offset + 0.01),
        true._replace(log_depth=true.log_depth - 0.02),
        true._replace(attitude=true.attitude.flip(1)),
    ):
        assert direct_loss(moved, pose, label, both) > 1e-3
    wild = true._replace(offset=true.offset + torch.tensor([[0.0], [9.0]]))
    assert direct_loss(wild, pose, label, torch.tensor([1.0, 0.0])).item() == pytest.approx(0, abs=1e-5)


def test_a_few_crops_are_learnt_by_heart() -> None:
    """Chance is 2.2 rad and about 0.3 of log_depth's spread; learnt crops are told to a few degrees."""
    torch.manual_seed(0)
    network = DMANet(DMANetConfig((8, 16, 24, 32), (8, 8, 16, 16), (1, 1, 1, 1), head=96, bins=8))
    frames = [a_frame(k) for k in range(6)]
    rows = [cached_row(frame, CRAFT, "craft", CACHE_SIZE) for frame in frames]
    fields = (
        np.stack([getattr(row, name) for row in rows]) for name in ("image", "points_px", "in_view", "box_px", "pose")
    )
    batch = Loader(Cache(*fields), draw_keypoints, 0).batch(0, Stage(1, INPUT_SIZE, 6))
    task = make_task(network, CRAFT, replace(SETTINGS, stages=(Stage(1, INPUT_SIZE, 6),)))
    assert isinstance(task, DirectTask)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    cpu = torch.device("cpu")
    losses = []
    for _ in range(120):
        loss = task.loss(network.train(), batch, cpu)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    with torch.inference_mode():
        outputs = network.eval()(batch.network_input(cpu)).numpy()
    for output, label in zip(outputs, batch.pose.double().numpy(), strict=True):
        told, truth = decode_output(output, task.bins), CropPose.from_vector(label)
        assert told is not None
        assert 2 * math.acos(min(1.0, abs(told.attitude_wxyz @ truth.attitude_wxyz))) < 0.25
        assert np.abs(told.offset - truth.offset).max() < 0.05
        assert abs(told.log_depth - truth.log_depth) < 0.1
    assert losses[-1] < 0.1 * losses[0]


def test_a_frame_whose_origin_is_behind_the_camera_counts_for_nothing(data: Path) -> None:
    dataset = SkdDataset(data, "train", "satellite_01")
    cache = build_cache(dataset, dataset.spacecraft, data / "cache_96", 96)
    blind = replace(cache, poses=np.full_like(cache.poses, np.nan))
    batch = Loader(blind, draw_keypoints, 0).batch(0, Stage(1, 64, 4))
    network = build("dmanet-xs", CRAFT.adjacency, CRAFT.points_m)
    loss = make_task(network, CRAFT, SETTINGS).loss(network, batch, torch.device("cpu"))
    assert loss.item() == 0


def test_pixels_that_are_not_square_are_refused_to_a_direct_network_alone() -> None:
    frame = a_frame(0)
    wide = frame.camera.matrix * np.array([[1.1], [1], [1]])

    class Frames:
        def __len__(self) -> int:
            return 1

        def frame(self, i: int, image: bool = True) -> Frame:
            return replace(frame, camera=Camera(wide, 512, 512))

    with pytest.raises(GknetError, match=r"frame 0: expected square pixels, got fx / fy of 1\.100"):
        check_cameras(build("dmanet-xs", CRAFT.adjacency, CRAFT.points_m), Frames())
    check_cameras(build("gknet-s", CRAFT.adjacency, CRAFT.points_m), Frames())


def test_pixels_that_are_not_square_leave_the_attitude_unknown() -> None:
    """A turned image of them is of no pose, so nothing is to be learnt of it; the keypoints turn all the same."""
    frame = a_frame(0)
    wide = Camera(frame.camera.matrix * np.array([[1.1], [1], [1]]), 512, 512)
    square, stretched = (cached_row(replace(frame, camera=each), CRAFT, "craft", 96) for each in (frame.camera, wide))
    assert square is not None
    assert stretched is not None
    assert np.isfinite(square.pose).all()
    assert np.isnan(stretched.pose).all()
    assert np.isfinite(stretched.points_px).all()


def test_export_load_estimate(data: Path, finished: Path, model: Path) -> None:
    """The loaded estimator answers as the trained weights do, in the oracle's crop of a validation frame."""
    assert {path.name for path in model.iterdir()} == {"direct.onnx"}
    estimator = load_estimator(model, threads=1)
    assert isinstance(estimator, DirectEstimator)
    assert estimator.locator is None
    assert estimator.bins == AttitudeBins(16)
    assert estimator.settings.input_size == 64
    frames = SkdDataset(data, "val", "satellite_01")
    best = json.loads((finished / "run.json").read_text())["best"]
    found = validate_direct(exported(estimator), torch.device("cpu"), frames, [0, 1], CRAFT, estimator.bins, 64)
    assert found.score == pytest.approx(best["score"], rel=0.02)
    frame = frames.frame(0)
    assert frame.image is not None
    estimate = estimator.estimate(frame.image, frame.camera, frame.true_box(POINTS))
    assert (estimate.cam_from_body is None) == (estimate.failure is not None)
    assert (estimate.attitude_confidence is None) == (estimate.cam_from_body is None)


def exported(estimator: DirectEstimator) -> torch.nn.Module:
    """The exported network in the place of a torch one."""

    class Exported(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(estimator.network(np.ascontiguousarray(images.numpy())))

    return Exported()


def test_a_folder_holds_one_kind_of_model(model: Path, tmp_path: Path) -> None:
    (tmp_path / "keypoints.onnx").write_bytes((model / "direct.onnx").read_bytes())
    with pytest.raises(GknetError, match="kind 'keypoints', got 'direct'"):
        load_estimator(tmp_path)
    (tmp_path / "direct.onnx").write_bytes((model / "direct.onnx").read_bytes())
    with pytest.raises(GknetError, match="it has both, remove one"):
        load_estimator(tmp_path)


def test_the_commands_work_with_it(data: Path, model: Path, tmp_path: Path) -> None:
    arguments = ["--model", str(model), "--split", "val", "--out", str(tmp_path)]
    assert command(["eval", str(data), *arguments]) == 0
    content = json.loads((tmp_path / "metrics.json").read_text())
    oracle = content["runs"]["oracle"]
    assert oracle["frames"] == 2
    assert {"e_t", "e_q_rad"} <= set(oracle["metrics"])
    for layout in ("jsonl", "csv"):
        code = command(["predict", str(data), *arguments, "--oracle", "--format", layout])
        assert code in (0, 2)  # 2 where neither frame has a pose: it was trained on 12 images
    line = json.loads((tmp_path / "poses.jsonl").read_text().splitlines()[0])
    assert line["status"] in ("ok", "no pose")
    assert line["covariance"] is None
    assert line["inlier_count"] is None


@pytest.mark.parametrize(
    ("option", "said"),
    [(("--graph", "identity"), "graph: dmanet-xs has none"), (("--loss", "squared"), "loss: dmanet-xs has its own")],
)
def test_what_it_does_not_have_is_refused_in_one_line(
    option: tuple[str, str], said: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(data), "--spacecraft", "satellite_01", "--out", str(tmp_path / "run"), "--epochs", "1"]
    assert command([*words, "--network", "dmanet-xs", *option]) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"gknet: {said}")
    assert line.count("\n") == 1
    assert not (tmp_path / "run").exists()
