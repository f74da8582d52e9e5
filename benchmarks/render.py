"""Our renderer against bare Mitsuba: `python benchmarks/render.py satellite_01.glb --size 1024 --spp 8 --frames 10`.

Bare Mitsuba is `mi.render` of the same meshes and materials under the same sun, with its path integrator at depth 2,
a box filter and the multijitter sampler, whose camera and sun move by `mi.traverse` from frame to frame; no labels.
Ours renders the same frames with all labels. Both take turns, so that a busy machine slows both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy import ndarray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.render import film
from gknet.render.bsdf import build_shapes
from gknet.render.mesh import read_glb
from gknet.render.scenario import Sensor, Shot
from gknet.render.scene import Renderer, choose_variant, light_of
from gknet.render.variant import load_engine
from gknet.spacecraft import Spacecraft, diameter

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


class Bare:
    """Mitsuba as its manual has it."""

    def __init__(self, mesh: Path, variant: str, size: int, spp: int, first: Shot) -> None:
        engine = load_engine(variant)
        self._mi, self._spp = engine.mi, spp
        sensor = film.sensor(engine, camera_of(first, size), first.cam_from_body.inverse())
        sampler = {"type": "multijitter", "sample_count": spp}
        parts: dict[str, Any] = {
            **build_shapes(engine.mi, read_glb(mesh)),
            **film.emitters(engine, light_of(first)),
            "integrator": {"type": "path", "max_depth": 2, "hide_emitters": True},
            "camera": {**sensor, "sampler": sampler},
        }
        self._scene = engine.mi.load_dict({"type": "scene", **parts})
        self._parameters = engine.mi.traverse(self._scene)
        self._engine = engine

    def render(self, shot: Shot) -> ndarray:
        to_scene = (-light_of(shot).sun).tolist()
        sun = self._mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=to_scene, up=[0.12, 0.34, 0.93])
        sensor = film.sensor(self._engine, shot.camera, shot.cam_from_body.inverse())
        self._parameters["sun.to_world"] = sun
        self._parameters["camera.to_world"] = sensor["to_world"]
        self._parameters.update()
        return np.array(self._mi.render(self._scene, spp=self._spp, seed=shot.seed))


def camera_of(shot: Shot, size: int) -> Camera:
    window = Crop(0, 0, shot.camera.width, size)
    return shot.camera.warped(window.input_from_image, size, size)


def shots(frames: int, span: float, centre_m: ndarray, diameter_m: float) -> list[Shot]:
    """Random attitudes and suns; the mesh's diameter fills `span` of the frame."""
    rng = np.random.default_rng(0)
    distance = 1400 * diameter_m / (1024 * span)
    out = []
    for k in range(frames):
        rotation = Rotation.random(rng=rng).as_matrix()
        pose = Pose(rotation, np.array([0, 0, distance]) - rotation @ centre_m)
        sun = rng.normal(size=3) - (0, 0, 1.5)
        camera = Camera.from_focal(1400, 1024, 1024)
        sun /= np.linalg.norm(sun)
        out.append(Shot("benchmark", "mesh", 0, k, 0.0, camera, pose, sun, None, np.eye(3), SENSOR, k))
    return out


def craft_of(mesh: Path) -> Spacecraft:
    """The mesh with 16 of its vertices as keypoints."""
    vertices = np.concatenate([part.vertices_m for part in read_glb(mesh)])
    points = vertices[np.linspace(0, len(vertices) - 1, 16).astype(int)]
    names = tuple(f"point_{k}" for k in range(16))
    return Spacecraft(mesh.stem, names, points, ((0, 1),), diameter(vertices), mesh_path=mesh)


def main(
    mesh: Annotated[Path, typer.Argument(help="a GLB, such as `gknet fleet FOLDER` writes")],
    size: Annotated[int, typer.Option(help="pixels of the image's side")] = 1024,
    spp: Annotated[int, typer.Option(help="samples a pixel")] = 8,
    frames: Annotated[int, typer.Option(help="frames to time")] = 8,
    span: Annotated[float, typer.Option(help="part of the frame that the mesh spans")] = 0.6,
    threads: Annotated[int | None, typer.Option(help="threads, all cores by default")] = None,
    variant: Annotated[str | None, typer.Option(help="Mitsuba's variant")] = None,
) -> None:
    variant = variant or choose_variant()
    craft = craft_of(mesh)
    vertices = np.concatenate([part.vertices_m for part in read_glb(mesh)])
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    plan = shots(frames + 2, span, centre, craft.diameter_m)
    ours, bare = Renderer(craft, variant, spp, threads), Bare(mesh, variant, size, spp, plan[0])
    window = Crop(0, 0, 1024, size)
    seconds = np.array(
        [(timed(partial(ours.render, shot, window)), timed(partial(bare.render, shot))) for shot in plan]
    )
    table = Table(title=f"{mesh.name}: {size} x {size}, {spp} spp, {variant}, {frames} frames after 2 to warm up")
    for column in ("", "median s/frame", "ratio"):
        table.add_column(column, justify="right" if column else "left")
    mine, theirs = np.median(seconds[2:], axis=0)
    table.add_row("bare Mitsuba, image only", f"{theirs:.3f}", "1.00")
    table.add_row("gknet, image and labels", f"{mine:.3f}", f"{mine / theirs:.2f}")
    Console().print(table)


def timed(render: Callable[[], object]) -> float:
    start = time.perf_counter()
    render()
    return time.perf_counter() - start


if __name__ == "__main__":
    typer.run(main)
