"""A toy spacecraft, a camera and a renderer for the tests of scenes and of shading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.spacecraft import Spacecraft, diameter
from tests.render.glb import QUAD, QUAD_FACES, QUAD_UV, Glb

pytest.importorskip("mitsuba")
pytest.importorskip("trimesh")

from gknet.render.mesh import read_glb
from gknet.render.scenario import EarthView, Sensor, Shot
from gknet.render.scene import Renderer, choose_variant

VARIANT = choose_variant()
BATCHED = not VARIANT.startswith("scalar")
batched = pytest.mark.skipif(not BATCHED, reason="needs an LLVM that Mitsuba works with")

SENSOR = Sensor(
    psf_sigma_px=0.6,
    exposure=1,
    full_well_e=2e4,
    read_noise_e=10,
    bloom=0,
    veil=0,
    gamma=1,
    monochrome=False,
    jpeg_quality=95,
)
CAMERA = Camera.from_focal(280, 200, 200)
FULL = Crop(0, 0, 200, 200)
FACING = Pose(np.diag([1.0, -1, -1]), np.array([0, 0, 6.0]))
"""The camera looks at the +z side of the body from 6 m, +y of the body up in the image."""


def shot(
    pose: Pose = FACING, sun: tuple[float, ...] = (0, 0, -1), seed: int = 1, earth: EarthView | None = None
) -> Shot:
    return Shot(
        recipe="test",
        spacecraft="toy",
        sequence=0,
        index=0,
        time_s=0,
        camera=CAMERA,
        cam_from_body=pose,
        sun_direction=np.array(sun) / np.linalg.norm(sun),
        earth=earth,
        cam_from_inertial=np.eye(3),
        sensor=SENSOR,
        seed=seed,
    )


def spacecraft(path: Path | None, points: ndarray | None = None, diameter_m: float | None = None) -> Spacecraft:
    """A toy; by default its keypoints lie in the quad, and it is as large as its mesh where that can be read."""
    points = QUAD / 2 if points is None else points
    if diameter_m is None:
        diameter_m = mesh_diameter(path)
    names = tuple(f"point_{k}" for k in range(len(points)))
    return Spacecraft("toy", names, points, ((0, 1),), diameter_m, mesh_path=path)


def mesh_diameter(path: Path | None) -> float:
    try:
        return diameter(np.concatenate([part.vertices_m for part in read_glb(path or Path("none.glb"))]))
    except GknetError:
        return 3.0


def quad_renderer(folder: Path, glb: Glb | None = None, variant: str = VARIANT, spp: int = 16) -> Renderer:
    glb = glb or quad(Glb(), white())
    return Renderer(spacecraft(glb.write(folder / "quad.glb")), variant, spp, threads=1)


def white(**changes: object) -> dict:
    return {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1} | changes}


def quad(glb: Glb, material: dict | None, **attributes: ndarray) -> Glb:
    return glb.mesh(QUAD, QUAD_FACES, material, TEXCOORD_0=QUAD_UV, **attributes)
