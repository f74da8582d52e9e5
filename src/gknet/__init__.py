"""gknet: the pose of a known spacecraft from one picture.

    estimator = gknet.load_estimator("satellite_01")
    estimate = estimator.estimate(image, gknet.Camera.from_focal(1400, 1024, 1024))

The names below are loaded when they are first used, so that importing gknet costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gknet.errors import GknetError
    from gknet.frame import Box, Estimate, Frame, Keypoints
    from gknet.geometry import Camera, Pose
    from gknet.inference.crop import Crop
    from gknet.inference.estimator import Estimator, load_estimator
    from gknet.spacecraft import Spacecraft, load_spacecraft

__version__ = "0.1.0"

__all__ = [
    "Box",
    "Camera",
    "Crop",
    "Estimate",
    "Estimator",
    "Frame",
    "GknetError",
    "Keypoints",
    "Pose",
    "Spacecraft",
    "load_estimator",
    "load_spacecraft",
]

_HOMES = {
    "Box": "frame",
    "Camera": "geometry",
    "Crop": "inference.crop",
    "Estimate": "frame",
    "Estimator": "inference.estimator",
    "Frame": "frame",
    "GknetError": "errors",
    "Keypoints": "frame",
    "Pose": "geometry",
    "Spacecraft": "spacecraft",
    "load_estimator": "inference.estimator",
    "load_spacecraft": "spacecraft",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'gknet' has no attribute '{name}'")
    value = getattr(import_module(f"gknet.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
