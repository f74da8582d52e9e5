"""A spacecraft in Mitsuba 3: radiance, and labels from the same geometry.

Mitsuba's world is the body frame: the geometry stands still, camera and lights move about it, and nothing is loaded or
compiled again from frame to frame. Radiance 1.0 is a white Lambertian surface that faces the full sun.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.render import film
from gknet.render.bsdf import build_shapes
from gknet.render.mesh import load_mesh
from gknet.render.scenario import EARTH_RADIUS_M, Shot
from gknet.render.shading import IncidentLight, Region, Shader
from gknet.render.variant import Engine, choose_variant, load_engine
from gknet.spacecraft import Spacecraft

OCCLUSION_TOLERANCE = 0.002
"""A keypoint is hidden by what is nearer than it by more than this part of the diameter (1 cm on 5 m)."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """The spacecraft alone in a square window of `s` pixels.

    Attributes:
        radiance: (s, s, 3) linear RGB, premultiplied by alpha: black where there is no spacecraft.
        alpha: (s, s) the part of the pixel that the spacecraft covers, 0 to 1.
        mask: (s, s) whether the ray of the pixel's centre meets the spacecraft.
        depth_m: (s, s) z of that point in the camera frame in m, 0 outside of the mask.
        visible: (n,) whether a keypoint is in front of the camera, inside the full image, and not hidden.
    """

    radiance: Float32[ndarray, "s s 3"]
    alpha: Float32[ndarray, "s s"]
    mask: Bool[ndarray, "s s"]
    depth_m: Float32[ndarray, "s s"]
    visible: Bool[ndarray, " n"]


class Renderer:
    """One spacecraft, loaded once, rendered from any pose.

    Args:
        spacecraft: Its mesh is in the body frame, in metres.
        variant: Mitsuba's, None for `choose_variant()`: llvm_ad_rgb, scalar_rgb, or cuda_ad_rgb (never tried).
        spp: Samples per pixel.
        threads: Threads of this process, None for all cores.

    Raises:
        GknetError: There is no mesh, it cannot be read or its scale is not the spacecraft's, or the variant cannot run.
    """

    def __init__(
        self, spacecraft: Spacecraft, variant: str | None = None, spp: int = 8, threads: int | None = None
    ) -> None:
        if spp < 1 or (threads is not None and threads < 1):
            raise GknetError(f"renderer: expected a positive spp and number of threads, got {spp} and {threads}")
        parts = load_mesh(spacecraft)
        self.spacecraft = spacecraft
        self.variant = variant or choose_variant()
        self.spp = spp
        engine = load_engine(self.variant)
        if threads is not None:
            engine.dr.set_thread_count(threads)
        self._hull_m = _hull(np.concatenate([part.vertices_m for part in parts]))
        self._shapes = build_shapes(engine.mi, parts)
        self._scene = engine.mi.load_dict({"type": "scene", **self._shapes})
        self._shader = None if engine.scalar else Shader(engine, self._scene, spp)

    def render(self, shot: Shot, window: Crop) -> Rendered:
        """The spacecraft in a part of a shot's image; the same shot gives the same bits.

        Args:
            shot: Poses are cam_from_body in the OpenCV camera frame, lengths in m.
            window: A square of the shot's full image, in its pixels; the image has `window.size` pixels a side.

        Raises:
            GknetError: The camera has skew or pixels that are not square, or the spacecraft is inside the Earth.
        """
        engine = load_engine(self.variant)
        camera = shot.camera.warped(window.input_from_image, window.size, window.size)
        _check_square(camera)
        rgba, depth = self._picture(engine, shot, camera)
        points_cam = shot.cam_from_body.transform(self.spacecraft.points_m)
        visible = shot.camera.contains(shot.camera.project(points_cam))
        tolerance = OCCLUSION_TOLERANCE * self.spacecraft.diameter_m
        visible &= self._unhidden(engine, shot.cam_from_body.inverse(), points_cam, tolerance)
        return Rendered(rgba[..., :3], rgba[..., 3], depth > 0, depth, visible)

    def _picture(
        self, engine: Engine, shot: Shot, camera: Camera
    ) -> tuple[Float32[ndarray, "s s 4"], Float32[ndarray, "s s"]]:
        """Premultiplied RGB with alpha, and depth."""
        body_from_cam, light = shot.cam_from_body.inverse(), light_of(shot)
        if self._shader is None:
            sensor = film.sensor(engine, camera, body_from_cam)
            rgba = film.radiance(engine, self._shapes, sensor, light, self.spp, shot.seed)
            return rgba, film.depth(engine, self._scene, sensor, body_from_cam)
        rgba = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
        depth = np.zeros((camera.height, camera.width), dtype=np.float32)
        region = region_of(camera, shot.cam_from_body.transform(self._hull_m))
        if region is not None:
            rgba[region.slices] = self._shader.radiance(camera, body_from_cam, region, light, shot.seed)
            depth[region.slices] = self._shader.depth(camera, body_from_cam, region)
        return rgba, depth

    def _unhidden(
        self, engine: Engine, body_from_cam: Pose, points_cam: Float[ndarray, "n 3"], tolerance_m: float
    ) -> Bool[ndarray, " n"]:
        if self._shader is None:
            return film.unhidden(engine, self._scene, body_from_cam, points_cam, tolerance_m)
        return self._shader.unhidden(body_from_cam, points_cam, tolerance_m)


def light_of(shot: Shot) -> IncidentLight:
    """The light that falls on the spacecraft of a shot, in its body frame.

    Raises:
        GknetError: The spacecraft is inside the Earth.
    """
    rotation = shot.cam_from_body.rotation
    sun = np.asarray(shot.sun_direction, dtype=np.float64)
    centre = None
    earth = shot.planet or shot.earth
    if earth is not None:
        # The Earth is so far that one centre serves all parts of the spacecraft.
        centre = (earth.centre_cam_m - shot.cam_from_body.translation_m) @ rotation / EARTH_RADIUS_M
        if centre @ centre <= 1:
            raise GknetError(f"shot: the spacecraft is inside the Earth ({np.linalg.norm(centre):.4f} radii away)")
    return IncidentLight(sun / np.linalg.norm(sun) @ rotation, centre)


def region_of(camera: Camera, hull_cam_m: Float[ndarray, "v 3"]) -> Region | None:
    """The part of a window that the convex hull of the mesh may cover, None when it is out of the image."""
    whole = Region(0, 0, camera.width, camera.height)
    if (hull_cam_m[:, 2] <= 0).all():
        return None
    if (hull_cam_m[:, 2] < 1e-3 * np.abs(hull_cam_m).max()).any():
        return whole
    pixels = camera.project(hull_cam_m)
    low = np.maximum(np.floor(pixels.min(axis=0)) - 1, 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + 1, (camera.width, camera.height)).astype(int)
    if (high <= low).any():
        return None
    return Region(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def _hull(vertices_m: Float[ndarray, "v 3"]) -> Float[ndarray, "h 3"]:
    """The corners of the convex hull, or all vertices of a flat mesh, which has none."""
    try:
        return vertices_m[ConvexHull(vertices_m).vertices]
    except QhullError:
        return vertices_m


def _check_square(camera: Camera) -> None:
    (fx, skew, _), (_, fy, _) = camera.matrix[:2]
    if abs(skew) > 1e-6 * fx or abs(fx - fy) > 1e-6 * fx:
        raise GknetError(f"camera: the renderer needs square pixels without skew, got fx {fx}, fy {fy}, skew {skew}")
