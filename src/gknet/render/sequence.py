"""One sequence of a recipe, sampled as a whole: candidates are drawn until every frame obeys the recipe's limits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.render import trajectory
from gknet.render.recipe import LightLimits, Motion, Recipe
from gknet.render.sequence_spec import Scene, SequenceSpec, sequence_spec
from gknet.spacecraft import Spacecraft

CAMERA = Camera.from_focal(1400.0, 1024, 1024)
"""The whole sensor at its native resolution."""

EARTH_RADIUS_M = 6_371_000.0
EARTH_RATE_RAD_S = 7.2921159e-5

_ATTEMPTS = 4000
_HALF_DIAGONAL_DEG = 29.0
"""Half of the field's diagonal with the pointing error's share."""

_DAYLIGHT = 0.15
"""Where the Earth is in view, a sun this high (sine) over the ground is preferred, so that there is one to see."""


@dataclass(frozen=True, eq=False)
class SequenceMotion:
    """The geometry of a sequence's `t` frames, camera frame in OpenCV axes.

    Attributes:
        spec: What was asked for.
        time_s: (t,) since the first frame, in s.
        cam_from_body: (t, 3, 3) rotations.
        body_cam_m: (t, 3) origin of the body frame in the camera frame, in m.
        cam_from_inertial: (t, 3, 3) rotations from equatorial axes.
        cam_from_earth: (t, 3, 3) rotations from Earth-fixed axes.
        earth_centre_cam_m: (t, 3) in the camera frame, in m.
        earth_in_view: (t,) whether a part of the Earth is in the full image.
        sun_direction: (t, 3) unit vectors to the sun in the camera frame.
        phase_rad: (t,) angles at the spacecraft between the sun and the camera, in rad.
    """

    spec: SequenceSpec
    time_s: Float[ndarray, " t"]
    cam_from_body: Float[ndarray, "t 3 3"]
    body_cam_m: Float[ndarray, "t 3"]
    cam_from_inertial: Float[ndarray, "t 3 3"]
    cam_from_earth: Float[ndarray, "t 3 3"]
    earth_centre_cam_m: Float[ndarray, "t 3"]
    earth_in_view: Bool[ndarray, " t"]
    sun_direction: Float[ndarray, "t 3"]
    phase_rad: Float[ndarray, " t"]


@dataclass(frozen=True, eq=False)
class _Orbit:
    """The spacecraft's orbit: LVLH at each time, and the Earth's angular radius there."""

    time_s: Float[ndarray, " t"]
    rate: float
    radius_m: float
    inertial_from_lvlh: Float[ndarray, "t 3 3"]

    @property
    def earth_angle(self) -> float:
        """The Earth's angular radius, in rad."""
        return float(np.arcsin(EARTH_RADIUS_M / self.radius_m))


@lru_cache(maxsize=8)
def sample_sequence(recipe: Recipe, spacecraft: Spacecraft, seed: int, sequence: int) -> SequenceMotion:
    """The first candidate that obeys the recipe's limits. The same arguments give the same sequence.

    Args:
        recipe: The ranges.
        spacecraft: Its keypoints are what must stay in view.
        seed: Of the dataset.
        sequence: From 0.

    Raises:
        GknetError: None of 4,000 candidates obeys.
    """
    spec = sequence_spec(recipe, seed, sequence)
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, recipe.key, sequence, attempt])
        candidate = _candidate(recipe, spacecraft, spec, rng)
        if candidate is not None:
            return candidate
    raise GknetError(
        f"recipe {recipe.name}, sequence {sequence}: no motion of {spacecraft.name} obeys its limits after {_ATTEMPTS} "
        "tries; widen span, whole_fraction or phase_deg"
    )


def _candidate(
    recipe: Recipe, spacecraft: Spacecraft, spec: SequenceSpec, rng: np.random.Generator
) -> SequenceMotion | None:
    """A sequence drawn from the recipe, or None when it breaks a limit. Cheap checks come first."""
    motion = recipe.motion
    spin = np.radians(_log_uniform(rng, motion.tumble_deg_s))
    orbit = _orbit(recipe, np.degrees(spin), rng)
    path = _path(spec, motion, orbit, rng)
    if path is None:
        return None
    sun = _sun(spec, recipe.light, orbit, path, rng)
    if sun is None:
        return None
    centre = (spacecraft.points_m.min(axis=0) + spacecraft.points_m.max(axis=0)) / 2
    points = spacecraft.points_m - centre
    inertial_from_body = _attitude(spin, orbit.time_s, rng)
    cam_from_lvlh = trajectory.look_at(-path, _up(path, rng))
    cam_from_body = cam_from_lvlh @ orbit.inertial_from_lvlh.transpose(0, 2, 1) @ inertial_from_body
    scale = _scale(cam_from_body @ points.T, path, motion, rng)
    if scale is None:
        return None
    path = path * scale
    mispoint = _mispointing(points, path, motion, orbit.time_s, rng)
    cam_from_lvlh, cam_from_body = mispoint @ cam_from_lvlh, mispoint @ cam_from_body
    body_cam = -_turn(cam_from_lvlh, path) - cam_from_body @ centre
    if not obeys(motion, spacecraft.points_m @ cam_from_body.transpose(0, 2, 1) + body_cam[:, None]):
        return None
    earth_cam = _turn(cam_from_lvlh, -path - orbit.radius_m * np.array([1.0, 0, 0]))
    in_view = earth_in_view(earth_cam)
    if in_view.any() if spec.scene == "sky" else in_view.mean() < 0.9:
        return None
    cam_from_inertial = cam_from_lvlh @ orbit.inertial_from_lvlh.transpose(0, 2, 1)
    chaser = _turn(orbit.inertial_from_lvlh, path / np.linalg.norm(path, axis=1, keepdims=True))
    return SequenceMotion(
        spec=spec,
        time_s=orbit.time_s,
        cam_from_body=cam_from_body,
        body_cam_m=body_cam,
        cam_from_inertial=cam_from_inertial,
        cam_from_earth=cam_from_inertial @ _inertial_from_earth(orbit.time_s, rng),
        earth_centre_cam_m=earth_cam,
        earth_in_view=in_view,
        sun_direction=cam_from_inertial @ sun,
        phase_rad=np.arccos(np.clip(chaser @ sun, -1, 1)),
    )


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))


def _turn(rotations: Float[ndarray, "t 3 3"], vectors: Float[ndarray, "t 3"]) -> Float[ndarray, "t 3"]:
    return np.einsum("tij,tj->ti", rotations, vectors)


def _orbit(recipe: Recipe, spin_deg_s: float, rng: np.random.Generator) -> _Orbit:
    """A circular orbit in a random plane; the time step is such that a step's turn stays in the recipe's range."""
    low = max(recipe.motion.step_s[0], recipe.motion.step_deg[0] / spin_deg_s)
    high = min(recipe.motion.step_s[1], recipe.motion.step_deg[1] / spin_deg_s)
    step = rng.uniform(min(low, high), max(low, high))
    time_s = step * np.arange(recipe.frames)
    radius = EARTH_RADIUS_M + 1e3 * rng.uniform(*recipe.light.altitude_km)
    rate = trajectory.mean_motion(radius)
    plane = trajectory.random_rotation(rng).as_matrix()
    return _Orbit(time_s, rate, radius, trajectory.orbit_frames(rate, time_s, plane))


def _path(spec: SequenceSpec, motion: Motion, orbit: _Orbit, rng: np.random.Generator) -> Float[ndarray, "t 3"] | None:
    """The chaser in LVLH, at a scale of its own, with the Earth where the scene has it."""
    if spec.kind == "fly_around":
        angles = rng.uniform(0, 2 * np.pi, size=2)
        path = trajectory.fly_around(orbit.rate, orbit.time_s, 1.0, rng.uniform(0, 2.5), (angles[0], angles[1]))
    else:
        direction = _direction(spec.scene, orbit.earth_angle, rng)
        if spec.kind == "hold":
            path = trajectory.hold(orbit.time_s, direction, rng.uniform(0.0, 0.1), rng)
        else:
            aside = np.cross(direction, trajectory.random_direction(rng)) * np.tan(np.radians(rng.uniform(0, 35)))
            start = (direction + aside) / np.linalg.norm(direction + aside) * _log_uniform(rng, motion.approach_ratio)
            path = trajectory.approach(orbit.rate, orbit.time_s, start, direction)
    return path if _scene_holds(spec.scene, orbit.earth_angle, path) else None


def _direction(scene: Scene, earth_angle: float, rng: np.random.Generator) -> Float[ndarray, "3"]:
    """From the spacecraft to the chaser in LVLH, such that the camera points off the nadir as suits the scene."""
    edge = np.degrees(earth_angle)
    limits = {
        "sky": (edge + _HALF_DIAGONAL_DEG, 180.0),
        "earth": (edge - 35.0, edge + 17.0),
        "earth_fills": (0.0, edge - _HALF_DIAGONAL_DEG),
    }[scene]
    cosine = rng.uniform(*np.sort(np.cos(np.radians(limits))))
    azimuth = rng.uniform(0, 2 * np.pi)
    sine = np.sqrt(1 - cosine**2)
    return np.array([cosine, sine * np.cos(azimuth), sine * np.sin(azimuth)])


def _scene_holds(scene: Scene, earth_angle: float, path: Float[ndarray, "t 3"]) -> bool:
    """Whether the angle between the line of sight and the nadir suits the scene throughout."""
    off_nadir = np.degrees(np.arccos(np.clip(path[:, 0] / np.linalg.norm(path, axis=1), -1, 1)))
    edge = np.degrees(earth_angle)
    if scene == "sky":
        return bool((off_nadir > edge + _HALF_DIAGONAL_DEG).all())
    if scene == "earth_fills":
        return bool((off_nadir < edge - _HALF_DIAGONAL_DEG).all())
    return bool((off_nadir < edge + 18.0).mean() > 0.6 and (off_nadir > edge - 40.0).all())


def _sun(
    spec: SequenceSpec, light: LightLimits, orbit: _Orbit, path: Float[ndarray, "t 3"], rng: np.random.Generator
) -> Float[ndarray, "3"] | None:
    """Unit vector to the sun in the inertial frame: the phase angle of the spec at mid-sequence, no eclipse."""
    chaser = _turn(orbit.inertial_from_lvlh, path / np.linalg.norm(path, axis=1, keepdims=True))
    middle = chaser[len(chaser) // 2]
    aside = np.cross(middle, trajectory.random_direction(rng))
    aside /= np.linalg.norm(aside)
    azimuths = rng.permutation(32) * (2 * np.pi / 32)
    ring = np.outer(np.cos(azimuths), aside) + np.outer(np.sin(azimuths), np.cross(middle, aside))
    suns = np.cos(spec.phase_rad) * middle + np.sin(spec.phase_rad) * ring
    phase = np.degrees(np.arccos(np.clip(chaser @ suns.T, -1, 1)))
    height = orbit.inertial_from_lvlh[:, :, 0] @ suns.T
    lit = (height > 0) | (1 - height**2 > (EARTH_RADIUS_M / orbit.radius_m) ** 2)
    good = (lit & (phase >= light.phase_deg[0]) & (phase <= light.phase_deg[1])).all(axis=0)
    day = good & (height > _DAYLIGHT).all(axis=0)
    if spec.scene != "sky" and day.any():
        good = day
    return suns[np.argmax(good)] if good.any() else None


def _attitude(spin_rad_s: float, time_s: Float[ndarray, " t"], rng: np.random.Generator) -> Float[ndarray, "t 3 3"]:
    """inertial_from_body of a free tumble; the principal axes have a random direction in the body."""
    start = trajectory.random_rotation(rng).as_quat()[[3, 0, 1, 2]]
    spin = spin_rad_s * trajectory.random_direction(rng)
    wxyz, _ = trajectory.tumble(trajectory.random_inertia(rng), start, spin, time_s)
    principal_from_body = trajectory.random_rotation(rng).as_matrix()
    return Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix() @ principal_from_body


def _up(path: Float[ndarray, "t 3"], rng: np.random.Generator) -> Float[ndarray, "3"]:
    """A random image-up: square to the middle line of sight, so that the camera never points along it."""
    up = np.cross(path[len(path) // 2], trajectory.random_direction(rng))
    return up / np.linalg.norm(up)


def _scale(
    points: Float[ndarray, "t 3 n"], path: Float[ndarray, "t 3"], motion: Motion, rng: np.random.Generator
) -> float | None:
    """What to multiply the path with (Clohessy-Wiltshire is linear) so that the span stays within its limits."""
    extent = (points[:, :2].max(axis=2) - points[:, :2].min(axis=2)).max(axis=1)
    unit_span = CAMERA.matrix[0, 0] / CAMERA.width * extent / np.linalg.norm(path, axis=1)
    low, high = unit_span.max() / motion.span[1], unit_span.min() / motion.span[0]
    return _log_uniform(rng, (low, high)) if low < high else None


def _mispointing(
    points: Float[ndarray, "n 3"],
    path: Float[ndarray, "t 3"],
    motion: Motion,
    time_s: Float[ndarray, " t"],
    rng: np.random.Generator,
) -> Float[ndarray, "t 3 3"]:
    """Rotations of the camera: a smooth pointing error that uses the room beside the spacecraft, and some roll."""
    size = 2 * np.linalg.norm(points, axis=1).max() / np.linalg.norm(path, axis=1)
    room = np.maximum(0.5 * CAMERA.width / CAMERA.matrix[0, 0] - 0.5 * size, 0.02)
    part = rng.uniform(*motion.off_centre)
    wander = np.stack(
        [0.65 * rng.uniform(-1, 1) + 0.35 * trajectory.band_limited(time_s, rng, (20.0, 200.0)) for _ in range(2)],
        axis=1,
    )
    offset = part * room[:, None] * wander
    length = np.linalg.norm(offset, axis=1)
    axis = np.stack([-offset[:, 1], offset[:, 0], np.zeros_like(length)], axis=1) / np.maximum(length, 1e-12)[:, None]
    tilt = Rotation.from_rotvec(axis * np.arctan(length)[:, None])
    roll = np.radians(3.0) * trajectory.band_limited(time_s, rng, (60.0, 300.0))
    return (tilt * Rotation.from_rotvec(roll[:, None] * np.array([0.0, 0, 1]))).as_matrix()


def obeys(motion: Motion, points_cam_m: Float[ndarray, "t n 3"]) -> bool:
    """Whether the keypoints' projections stay within the recipe's limits on all frames."""
    depth = points_cam_m[..., 2:]
    if depth.min() < 0.1 * np.ptp(points_cam_m[0], axis=0).max():
        return False
    pixels = points_cam_m[..., :2] / depth * CAMERA.matrix[0, 0] + CAMERA.matrix[:2, 2]
    span = np.ptp(pixels, axis=1).max(axis=1) / CAMERA.width
    inside = ((pixels >= 0) & (pixels <= CAMERA.width)).all(axis=2)
    count = pixels.shape[1]
    needed = max(motion.keypoint_fraction * count, min(motion.keypoints_min, count))
    return bool(
        span.min() >= motion.span[0]
        and span.max() <= motion.span[1]
        and inside.all(axis=1).mean() >= motion.whole_fraction
        and inside.sum(axis=1).min() >= needed
    )


def earth_in_view(centre_cam_m: Float[ndarray, "t 3"]) -> Bool[ndarray, " t"]:
    """Whether a ray of the full image, on a grid that includes its border, meets the Earth or its lower atmosphere."""
    side = (np.linspace(0, CAMERA.width, 17) - CAMERA.matrix[0, 2]) / CAMERA.matrix[0, 0]
    rays = np.stack([*np.meshgrid(side, side), np.ones((17, 17))], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = centre_cam_m @ rays.T
    beside = (centre_cam_m**2).sum(axis=1, keepdims=True) - along**2
    return ((along > 0) & (beside < (EARTH_RADIUS_M + 40e3) ** 2)).any(axis=1)


def _inertial_from_earth(time_s: Float[ndarray, " t"], rng: np.random.Generator) -> Float[ndarray, "t 3 3"]:
    angle = rng.uniform(0, 2 * np.pi) + EARTH_RATE_RAD_S * time_s
    return Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0, 1])).as_matrix()
