"""Light and materials: radiance in numbers, textures, normal maps, colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.geometry import Pose
from gknet.inference.crop import Crop
from tests.render.glb import QUAD, QUAD_FACES, Glb

pytest.importorskip("mitsuba")
pytest.importorskip("trimesh")

from gknet.render.scenario import EARTH_RADIUS_M, EarthView
from gknet.render.scene import light_of
from gknet.render.shading import EARTH_ALBEDO, STARLIGHT, sky_radiance
from tests.render.state import FULL, quad, quad_renderer, shot, white


def test_radiance_one_is_a_white_surface_in_full_sun(tmp_path: Path) -> None:
    renderer = quad_renderer(tmp_path)
    middle = renderer.render(shot(sun=(0, 0, -1)), FULL).radiance[90:110, 90:110]
    assert middle.mean() == pytest.approx(1, abs=0.08)
    slanted = renderer.render(shot(sun=(0, np.sqrt(3), -1)), FULL).radiance[90:110, 90:110]
    assert slanted.mean() == pytest.approx(0.5, abs=0.08)
    unlit = renderer.render(shot(sun=(0, 0, 1)), FULL).radiance[90:110, 90:110]
    assert unlit.mean() == pytest.approx(STARLIGHT, rel=0.2)


def test_the_lit_earth_lights_the_dark_side(tmp_path: Path) -> None:
    renderer = quad_renderer(tmp_path, spp=64)
    distance = 1.1
    earth = EarthView(np.array([0, 0, -distance * EARTH_RADIUS_M]), np.eye(3))
    lit = renderer.render(shot(sun=(0, 0, 1), earth=earth), FULL).radiance[90:110, 90:110].mean(axis=(0, 1))
    # A sphere overhead fills 1 / d^2 of a hemisphere weighted by its cosine; its rim is darker than its middle.
    np.testing.assert_array_less(lit, 1.1 * np.array(EARTH_ALBEDO) / distance**2)
    np.testing.assert_array_less(0.5 * np.array(EARTH_ALBEDO) / distance**2, lit)
    new = renderer.render(shot(sun=(0, 0.2, 1), earth=EarthView(-earth.centre_cam_m, np.eye(3))), FULL)
    assert new.radiance[90:110, 90:110].mean() == pytest.approx(STARLIGHT, rel=0.2)


def test_earthlight_in_numbers() -> None:
    earth = EarthView(np.array([0, 0, 2 * EARTH_RADIUS_M]), np.eye(3))
    light = light_of(shot(Pose(np.eye(3), np.array([0, 0, 1e-3])), sun=(0, 0, -1), earth=earth))
    assert light.earth_centre == pytest.approx([0, 0, 2])
    towards, away, beside = sky_radiance(light, np.array([[0, 0, 1.0], [0, 0, -1], [0.6, 0, 0.8]]))
    np.testing.assert_allclose(towards, np.array(EARTH_ALBEDO) + STARLIGHT)
    np.testing.assert_allclose(away, STARLIGHT)
    np.testing.assert_allclose(beside, STARLIGHT)
    with pytest.raises(GknetError, match="inside the Earth"):
        light_of(shot(earth=EarthView(np.zeros(3), np.eye(3))))


def test_a_texture_is_upright(tmp_path: Path) -> None:
    image = np.zeros((64, 64, 3), dtype=np.uint8)
    image[:32, :32] = 255, 0, 0
    image[:32, 32:] = 0, 255, 0
    image[32:, :32] = 0, 0, 255
    image[32:, 32:] = 188, 188, 188
    glb = Glb()
    rendered = quad_renderer(tmp_path, quad(glb, white(baseColorTexture=glb.texture(image)))).render(shot(), FULL)
    quarters = [rendered.radiance[y : y + 10, x : x + 10].mean(axis=(0, 1)) for y in (70, 120) for x in (70, 120)]
    assert np.argmax(quarters[:3], axis=1).tolist() == [0, 1, 2]
    assert quarters[3].mean() == pytest.approx(0.5, abs=0.06)  # sRGB 188 is half of the light


def test_factors_scale_linear_light(tmp_path: Path) -> None:
    half = quad_renderer(tmp_path, quad(Glb(), white(baseColorFactor=[0.5, 0.5, 0.5, 1]))).render(shot(), FULL)
    assert half.radiance[90:110, 90:110].mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    ("tilt", "bright"),
    [((255, 128, 128), (1, 0)), ((0, 128, 128), (-1, 0)), ((128, 255, 128), (0, 1)), ((128, 0, 128), (0, -1))],
)
def test_a_normal_map_tilts_as_in_gltf(tmp_path: Path, tilt: tuple[int, int, int], bright: tuple[int, int]) -> None:
    """Red is +u (the body's +x here), green is up (+y)."""
    leaning = (np.array(tilt) + (128, 128, 255)) / 2
    glb = Glb()
    material = white() | {"normalTexture": glb.texture(np.full((4, 4, 3), leaning, dtype=np.uint8))}
    renderer = quad_renderer(tmp_path, quad(glb, material), spp=4)
    window = Crop(0, 0, 200, 20)

    def light_from(x: int, y: int) -> float:
        return float(renderer.render(shot(sun=(x, -y, -1)), window).radiance[9:11, 9:11].mean())

    assert light_from(*bright) > 1.3 * light_from(-bright[0], -bright[1])


def test_roughness_and_metal_come_from_green_and_blue(tmp_path: Path) -> None:
    def mirrored(green: int, blue: int) -> float:
        glb = Glb()
        image = np.full((4, 4, 3), (0, green, blue), dtype=np.uint8)
        material = {"pbrMetallicRoughness": {"metallicRoughnessTexture": glb.texture(image)}}
        window = Crop(0, 0, 200, 20)
        return float(
            quad_renderer(tmp_path, quad(glb, material), spp=4).render(shot(), window).radiance[9:11, 9:11].mean()
        )

    shiny_metal, rough_metal, rough_paint = mirrored(80, 255), mirrored(255, 255), mirrored(255, 0)
    assert shiny_metal > 5 * rough_metal
    assert rough_metal < 0.7 * rough_paint  # at a right angle a rough metal gives back less than paint
    assert rough_paint == pytest.approx(1.1, abs=0.1)


def test_vertex_colours_and_bare_meshes(tmp_path: Path) -> None:
    red = np.tile([1.0, 0, 0], (4, 1))
    coloured = quad_renderer(tmp_path, Glb().mesh(QUAD, QUAD_FACES, COLOR_0=red)).render(shot(), FULL)
    middle = coloured.radiance[90:110, 90:110].mean(axis=(0, 1))
    assert middle[0] > 5 * middle[1]
    bare = quad_renderer(tmp_path, Glb().mesh(QUAD, QUAD_FACES)).render(shot(), FULL)
    assert 0.3 < bare.radiance[90:110, 90:110].mean() < 0.8


def test_smooth_normals_are_kept(tmp_path: Path) -> None:
    normals = QUAD / np.sqrt(3) + [0, 0, 1 / np.sqrt(3)]
    smooth = quad_renderer(tmp_path, quad(Glb(), white(), NORMAL=normals)).render(shot(sun=(1, 0, -1)), FULL)
    assert smooth.radiance[100, 130].mean() > 1.2 * smooth.radiance[100, 70].mean()


def test_a_mirrored_node_keeps_its_light(tmp_path: Path) -> None:
    normals = np.tile([0, 0, 1.0], (4, 1))
    mirrored = Glb().mesh(QUAD, QUAD_FACES, white(), np.diag([-1.0, 1, 1, 1]), NORMAL=normals)
    rendered = quad_renderer(tmp_path, mirrored).render(shot(), FULL)
    assert rendered.radiance[90:110, 90:110].mean() == pytest.approx(1, abs=0.08)
