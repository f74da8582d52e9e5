"""Estimate the pose of a spacecraft in one image.

    python examples/pose_from_image.py IMAGE [--spacecraft satellite_01] [--focal-px 1400]

Without IMAGE, a bundled test frame is used.
"""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np

import gknet

BUNDLED = Path(str(files("gknet") / "demo_data")) / "data" / "000115" / "image" / "000121.jpg"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("image", type=Path, nargs="?", default=BUNDLED)
    parser.add_argument("--spacecraft", default="satellite_01")
    parser.add_argument("--focal-px", type=float, default=1400.0)
    arguments = parser.parse_args()

    pixels = cv2.imread(str(arguments.image))
    if pixels is None:
        raise SystemExit(f"{arguments.image}: cannot be read as an image")
    image = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    camera = gknet.Camera.from_focal(arguments.focal_px, image.shape[1], image.shape[0])

    estimator = gknet.load_estimator(arguments.spacecraft)
    estimate = estimator.estimate(image, camera)
    if estimate.cam_from_body is None or estimate.covariance is None:
        raise SystemExit(f"no pose: {estimate.failure}")
    sigma = np.sqrt(np.diag(estimate.covariance))
    print("translation, m:      ", estimate.cam_from_body.translation_m.round(3), "+-", sigma[3:].round(3))
    print("quaternion, w x y z: ", estimate.cam_from_body.quaternion_wxyz.round(4))
    print("sigma of attitude:   ", np.degrees(sigma[:3]).round(2), "deg")
    if estimate.is_ambiguous:
        print("ambiguous: the pose may be that of a symmetric counterpart")


if __name__ == "__main__":
    main()
