"""Labels, windows, seeds and errors of the renderer."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from tests.render.glb import QUAD, QUAD_FACES, Glb, box

pytest.importorskip("mitsuba")
pytest.importorskip("trimesh")

from gknet.render import shading
from gknet.render import variant as variants
from gknet.render.scenario import EarthView
from gknet.render.scene import Renderer, choose_variant
from tests.render.state import CAMERA, FULL, VARIANT, batched, quad, shot, spacecraft, white

BOX_SIZE = (1.0, 1.4, 0.8)
BOX_POINTS = np.array(
    [[0.3, 0.4, 0.4], [-0.3, 0.2, -0.4], [0.5, -0.5, 0.2], [-0.5, 0.1, 0.1], [0.1, 0.7, 0.2], [0.2, -0.7, -0.1]]
)
"""One inside of each side."""
SIDES = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])


@pytest.fixture(scope="module")
def box_renderer(tmp_path_factory: pytest.TempPathFactory) -> Renderer:
    path = Glb().mesh(*box(BOX_SIZE), white()).write(tmp_path_factory.mktemp("box") / "box.glb")
    return Renderer(spacecraft(path, BOX_POINTS, 1.9), VARIANT, 4, threads=1)


def random_pose(rng: np.random.Generator) -> Pose:
    rotation = Rotation.random(rng=rng).as_matrix()
    return Pose(rotation, np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(3.5, 9)]))


def test_labels_agree_with_the_projection_in_any_window(box_renderer: Renderer) -> None:
    rng = np.random.default_rng(0)
    corners = np.unique(box(BOX_SIZE)[0], axis=0)
    seen = 0
    for _ in range(12):
        pose, side = random_pose(rng), int(rng.integers(60, 260))
        window = Crop(int(rng.integers(-60, 120)), int(rng.integers(-60, 120)), side, 96)
        camera = CAMERA.warped(window.input_from_image, 96, 96)
        rendered = box_renderer.render(shot(pose), window)

        facing = np.einsum("ij,ij->i", SIDES, pose.inverse().translation_m - BOX_POINTS) > 0
        points = pose.transform(BOX_POINTS)
        inside = CAMERA.contains(CAMERA.project(points))
        assert rendered.visible.tolist() == (facing & inside).tolist()

        # A plane's inverse depth is linear in the pixel, so what four neighbours say of a point on it is exact.
        pixels = camera.project(points)
        for pixel, z in zip(pixels[rendered.visible], points[rendered.visible, 2], strict=True):
            x, y = np.floor(pixel - 0.5).astype(int)
            if not (0 <= x < 95 and 0 <= y < 95) or not rendered.mask[y : y + 2, x : x + 2].all():
                continue
            right, down = pixel - 0.5 - (x, y)
            rows = (1 / rendered.depth_m[y : y + 2, x : x + 2]) @ [1 - right, right]
            assert 1 / (rows @ [1 - down, down]) == pytest.approx(z, rel=3e-4)
            seen += 1

        outline = camera.project(pose.transform(corners))
        low, high = np.clip(outline.min(axis=0), 0, 96), np.clip(outline.max(axis=0), 0, 96)
        columns, rows = np.flatnonzero(rendered.mask.any(axis=0)), np.flatnonzero(rendered.mask.any(axis=1))
        if (high - low > 4).all() and len(columns) and len(rows):
            box_seen = np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]])
            whole = (outline.min() > 0) and (outline.max() < 96)
            assert not whole or np.abs(box_seen - [low, high]).max() <= 1.5
    assert seen > 8


def test_the_picture_covers_what_the_mask_covers(box_renderer: Renderer) -> None:
    rendered = box_renderer.render(
        shot(Pose(Rotation.from_euler("xyz", [0.4, 0.7, 0.2]).as_matrix(), np.array([0.3, -0.2, 5.0]))), FULL
    )
    assert (rendered.alpha[rendered.mask] > 0).all()
    assert rendered.alpha.sum() == pytest.approx(rendered.mask.sum(), rel=0.02)
    assert (rendered.radiance[rendered.alpha == 0] == 0).all()
    assert ((rendered.depth_m > 0) == rendered.mask).all()
    # The centroids agree to a tenth of a pixel: image and labels share one convention of pixels.
    grid = np.stack(np.meshgrid(np.arange(200), np.arange(200)), axis=-1)
    by_picture = np.average(grid.reshape(-1, 2), axis=0, weights=rendered.alpha.ravel())
    by_mask = grid[rendered.mask].mean(axis=0)
    np.testing.assert_allclose(by_picture, by_mask, atol=0.1)


def test_a_window_is_a_part_of_the_full_picture(box_renderer: Renderer) -> None:
    scene = shot(random_pose(np.random.default_rng(4)))
    whole, part = box_renderer.render(scene, FULL), box_renderer.render(scene, Crop(60, 70, 80, 80))
    np.testing.assert_array_equal(part.mask, whole.mask[70:150, 60:140])
    np.testing.assert_allclose(part.depth_m, whole.depth_m[70:150, 60:140], rtol=1e-4)
    np.testing.assert_array_equal(part.visible, whole.visible)


def test_the_seed_decides_the_samples(box_renderer: Renderer) -> None:
    pose = random_pose(np.random.default_rng(5))
    first, again, other = (box_renderer.render(shot(pose, (0.5, 0.2, -1), seed), FULL) for seed in (7, 7, 8))
    assert np.array_equal(first.radiance, again.radiance)
    assert np.array_equal(first.alpha, again.alpha)
    assert not np.array_equal(first.alpha, other.alpha)
    np.testing.assert_array_equal(first.depth_m, other.depth_m)


@batched
def test_neither_bands_nor_threads_show(box_renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    import drjit as dr

    scene = shot(random_pose(np.random.default_rng(6)), (0.5, 0.2, -1))
    whole = box_renderer.render(scene, FULL)
    monkeypatch.setattr(shading, "SAMPLES_AT_ONCE", 1000)
    dr.set_thread_count(2)
    try:
        pieces = box_renderer.render(scene, FULL)
    finally:
        dr.set_thread_count(1)
    np.testing.assert_array_equal(whole.radiance, pieces.radiance)
    np.testing.assert_array_equal(whole.depth_m, pieces.depth_m)


def test_out_of_the_picture_there_is_nothing(box_renderer: Renderer) -> None:
    behind = Pose(np.eye(3), np.array([0, 0, -5.0]))
    aside = Pose(np.eye(3), np.array([50.0, 0, 5.0]))
    for pose in (behind, aside):
        rendered = box_renderer.render(shot(pose), FULL)
        assert not rendered.mask.any()
        assert not rendered.alpha.any()
        assert not rendered.visible.any()


def test_inside_the_spacecraft_the_whole_window_is_covered(box_renderer: Renderer) -> None:
    rendered = box_renderer.render(shot(Pose(np.eye(3), np.zeros(3))), Crop(0, 0, 200, 32))
    assert rendered.mask.all()
    assert rendered.depth_m.max() == pytest.approx(0.4, rel=0.01)


def test_a_keypoint_outside_the_window_but_in_the_frame_is_visible(box_renderer: Renderer) -> None:
    corner = Crop(0, 0, 16, 16)
    rendered = box_renderer.render(shot(), corner)
    assert not rendered.mask.any()
    assert rendered.visible.tolist() == [True, False, False, False, False, False]


def test_another_part_hides_a_keypoint(tmp_path: Path) -> None:
    shield = np.eye(4)
    shield[:3, 3] = 0, 0, 1
    shield[0, 0] = shield[1, 1] = 0.5
    glb = quad(quad(Glb(), white()), white())
    glb.json["nodes"][1]["matrix"] = shield.T.ravel().tolist()
    points = np.array([[0, 0, 0], [0.9, 0.9, 0], [0, 0, 1], [0, 0, 0.999]])
    renderer = Renderer(spacecraft(glb.write(tmp_path / "two.glb"), points), VARIANT, 4, threads=1)
    assert renderer.render(shot(), FULL).visible.tolist() == [False, True, True, True]


@batched
def test_nothing_is_compiled_again(box_renderer: Renderer) -> None:
    import drjit as dr

    rng = np.random.default_rng(9)
    earth = EarthView(np.array([0, 9e6, 0]), np.eye(3))

    def render(k: int) -> None:
        window = Crop(
            int(rng.integers(-50, 50)), int(rng.integers(-50, 50)), int(rng.integers(100, 300)), 64 + 16 * (k % 3)
        )
        box_renderer.render(shot(random_pose(rng), tuple(rng.normal(size=3)), k, earth if k % 2 else None), window)

    render(0)
    render(1)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history()
        for k in range(12):
            render(k)
        history = dr.kernel_history()
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert all(entry.get("cache_hit", True) for entry in history)


@batched
def test_scalar_gives_the_same_picture(tmp_path: Path) -> None:
    path = Glb().mesh(*box(BOX_SIZE), white(baseColorFactor=[0.8, 0.5, 0.2, 1])).write(tmp_path / "box.glb")
    craft = spacecraft(path, BOX_POINTS, 1.9)
    earth = EarthView(np.array([7e6, 0, 0]), np.eye(3))
    scene = shot(
        Pose(Rotation.from_euler("xyz", [0.4, 0.7, 0.2]).as_matrix(), np.array([0.3, -0.2, 5.0])),
        (0.5, 0.8, 0.2),
        3,
        earth,
    )
    window = Crop(50, 40, 120, 48)
    fast, slow = (Renderer(craft, name, 64, threads=1).render(scene, window) for name in (VARIANT, "scalar_rgb"))
    np.testing.assert_array_equal(fast.visible, slow.visible)
    assert (fast.mask != slow.mask).sum() <= 2
    both = fast.mask & slow.mask
    np.testing.assert_allclose(fast.depth_m[both], slow.depth_m[both], rtol=1e-3)
    np.testing.assert_allclose(fast.radiance.mean(axis=(0, 1)), slow.radiance.mean(axis=(0, 1)), rtol=0.04)
    np.testing.assert_allclose(fast.alpha, slow.alpha, atol=0.15)


def test_bad_input_is_one_clear_line(tmp_path: Path) -> None:
    for path, words in ((None, "no mesh"), (tmp_path / "none.glb", "no such mesh")):
        with pytest.raises(GknetError, match=words):
            Renderer(spacecraft(path), VARIANT)
    good = quad(Glb(), white()).write(tmp_path / "good.glb")
    for content in (b"", b"not a mesh", good.read_bytes()[:300]):
        broken = tmp_path / "broken.glb"
        broken.write_bytes(content)
        with pytest.raises(GknetError, match=r"broken\.glb"):
            Renderer(spacecraft(broken), VARIANT)
    with pytest.raises(GknetError, match="variant: expected one of"):
        Renderer(spacecraft(good), "opengl")
    for options in ({"spp": 0}, {"threads": 0}):
        with pytest.raises(GknetError, match="positive spp"):
            Renderer(spacecraft(good), VARIANT, **options)
    nan = QUAD.copy()
    nan[0, 0] = np.nan
    with pytest.raises(GknetError, match="NaN"):
        Renderer(spacecraft(Glb().mesh(nan, QUAD_FACES).write(tmp_path / "nan.glb")), VARIANT)


def test_the_camera_must_have_square_pixels(box_renderer: Renderer) -> None:
    matrix = np.array([[280, 0, 100], [0, 300, 100], [0, 0, 1.0]])
    with pytest.raises(GknetError, match="square pixels"):
        box_renderer.render(replace(shot(), camera=Camera(matrix, 200, 200)), FULL)


def test_the_variant_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    choose_variant.cache_clear()
    monkeypatch.setenv(variants.VARIABLE, "cuda_ad_rgb")
    assert choose_variant() == "cuda_ad_rgb"
    choose_variant.cache_clear()
    monkeypatch.delenv(variants.VARIABLE)
    monkeypatch.setattr(variants, "variant_works", lambda variant: False)
    with pytest.warns(UserWarning, match="libllvm19"):
        assert choose_variant() == "scalar_rgb"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_variant() == "scalar_rgb"
    choose_variant.cache_clear()


def test_the_probe_renders_what_can_be_rendered() -> None:
    assert variants.variant_works("scalar_rgb")
    assert not variants.variant_works("no_such_variant")
