"""gknet: the pose of a known spacecraft from one image.

    estimator = gknet.load_estimator("satellite_01")
    estimate = estimator.estimate(image, gknet.Camera.from_focal(1400, 1024, 1024))
    if estimate.failure is None:
        print(estimate.cam_from_body.translation_m, estimate.covariance)

The names in `gknet.__all__` are the public API. They change only with a new minor version and an entry in the
changelog; everything else in the package may change in any version. Each name is loaded when it is first used, so
importing gknet is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gknet.errors import GknetError
    from gknet.frame import Box, Estimate, Failure, FailureKind, Frame, Keypoints, PoseEstimator
    from gknet.geometry import Camera, Pose
    from gknet.inference.load import load_estimator, shipped_models
    from gknet.inference.pnp import PnpResult, PnpSettings, solve_pnp
    from gknet.io.spacecraft_file import load_spacecraft
    from gknet.spacecraft import Spacecraft

__version__ = "0.2.0"

__all__ = [
    "Box",
    "Camera",
    "Estimate",
    "Failure",
    "FailureKind",
    "Frame",
    "GknetError",
    "Keypoints",
    "PnpResult",
    "PnpSettings",
    "Pose",
    "PoseEstimator",
    "Spacecraft",
    "load_estimator",
    "load_spacecraft",
    "shipped_models",
    "solve_pnp",
]

_HOMES = {
    "Box": "frame",
    "Camera": "geometry",
    "Estimate": "frame",
    "Failure": "frame",
    "FailureKind": "frame",
    "Frame": "frame",
    "GknetError": "errors",
    "Keypoints": "frame",
    "PnpResult": "inference.pnp",
    "PnpSettings": "inference.pnp",
    "Pose": "geometry",
    "PoseEstimator": "frame",
    "Spacecraft": "spacecraft",
    "load_estimator": "inference.load",
    "load_spacecraft": "io.spacecraft_file",
    "shipped_models": "inference.load",
    "solve_pnp": "inference.pnp",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'gknet' has no attribute '{name}'")
    value = getattr(import_module(f"gknet.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
