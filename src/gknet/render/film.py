"""The image and labels of `shading` by Mitsuba's own camera and film, for its scalar variants: they have no batches.

Some twenty times slower, and needs no LLVM.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from gknet.geometry import Camera, Pose
from gknet.render.shading import IncidentLight, sky_radiance
from gknet.render.variant import Engine

SUN_SAMPLING = 9.0
"""How much more often the sun is sampled than the light of the Earth and the sky."""

SKY_ROWS = 32
NEAR_M, FAR_M = 0.05, 1e5


def radiance(
    engine: Engine, shapes: dict[str, Any], sensor: dict[str, Any], light: IncidentLight, spp: int, seed: int
) -> Float32[ndarray, "s s 4"]:
    """Premultiplied linear RGB and alpha of the whole window."""
    scene = engine.mi.load_dict({"type": "scene", **emitters(engine, light), **shapes})
    camera = engine.mi.load_dict({**sensor, "sampler": {"type": "multijitter", "sample_count": spp}})
    integrator = engine.mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 1, "hide_emitters": True})
    image = integrator.render(scene, camera, seed=seed & 0xFFFFFFFF, spp=spp)
    return np.array(image, dtype=np.float32)


def depth(engine: Engine, scene: Any, sensor: dict[str, Any], body_from_cam: Pose) -> Float32[ndarray, "s s"]:
    """z in the camera frame of the surface at each pixel's centre, 0 where there is none."""
    camera = engine.mi.load_dict({**sensor, "sampler": {"type": "stratified", "sample_count": 1, "jitter": False}})
    integrator = engine.mi.load_dict({"type": "aov", "aovs": "distance:depth,point:position"})
    layers = np.array(integrator.render(scene, camera, seed=0, spp=1), dtype=np.float64)
    distance, point = layers[..., -4], layers[..., -3:]
    z = (point - body_from_cam.translation_m) @ body_from_cam.rotation[:, 2]
    return np.where(distance > 0, z, 0).astype(np.float32)


def unhidden(
    engine: Engine, scene: Any, body_from_cam: Pose, points_cam: Float[ndarray, "n 3"], tolerance_m: float
) -> Bool[ndarray, " n"]:
    """Which points nothing hides that is nearer to the camera by more than the tolerance."""
    origin = engine.mi.Point3f(body_from_cam.translation_m)
    free = np.ones(len(points_cam), dtype=bool)
    for k, point in enumerate(points_cam):
        length = float(np.linalg.norm(point))
        ray = engine.mi.Ray3f(origin, engine.mi.Vector3f(body_from_cam.rotation @ point / length))
        ray.maxt = max(length - tolerance_m, length / 2)
        free[k] = not scene.ray_test(ray)
    return free


def sensor(engine: Engine, camera: Camera, body_from_cam: Pose) -> dict[str, Any]:
    """Mitsuba's camera, whose axes are x left, y up, z forward; `camera` has square pixels and no skew."""
    to_world = np.eye(4)
    to_world[:3, :3] = body_from_cam.rotation * (-1, -1, 1)
    to_world[:3, 3] = body_from_cam.translation_m
    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "pixel_format": "rgba",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.matrix[0, 0])))),
        "principal_point_offset_x": float(0.5 - camera.matrix[0, 2] / camera.width),
        "principal_point_offset_y": float(0.5 - camera.matrix[1, 2] / camera.height),
        "to_world": engine.mi.ScalarTransform4f(to_world),
        "near_clip": NEAR_M,
        "far_clip": FAR_M,
        "film": film,
    }


def emitters(engine: Engine, light: IncidentLight) -> dict[str, Any]:
    """The sun, and the Earth and the sky as an environment map."""
    sun = {"type": "rgb", "value": [float(np.pi)] * 3}
    sky = sky_radiance(light, _directions(2 * SKY_ROWS)).reshape(SKY_ROWS, 2, 2 * SKY_ROWS, 2, 3).mean(axis=(1, 3))
    return {
        "sun": {
            "type": "directional",
            "direction": (-light.sun).tolist(),
            "irradiance": sun,
            "sampling_weight": SUN_SAMPLING,
        },
        "sky": {"type": "envmap", "bitmap": engine.mi.Bitmap(sky.astype(np.float32)), "sampling_weight": 1.0},
    }


def _directions(rows: int) -> Float[ndarray, "n 3"]:
    """Unit vectors of the centres of a latitude-longitude map, row by row, in Mitsuba's layout (y is the pole)."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = (np.arange(2 * rows) + 0.5) / rows * np.pi
    theta, phi = np.meshgrid(polar, azimuth, indexing="ij")
    vectors = [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)]
    return np.stack(vectors, axis=-1).reshape(-1, 3)
