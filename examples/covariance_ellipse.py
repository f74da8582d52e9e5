"""Draw the error ellipses (2 sigma) of the keypoints, and print the standard deviations of the pose.

    python examples/covariance_ellipse.py [IMAGE] [--out ellipses.png]

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
SIGMAS = 2


def draw_ellipse(image: np.ndarray, centre: np.ndarray, covariance_px2: np.ndarray, colour: tuple[int, ...]) -> None:
    """The ellipse of SIGMAS standard deviations. OpenCV's pixel centres are integers: subtract 0.5."""
    variances, axes = np.linalg.eigh(covariance_px2)
    angle_deg = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
    long, short = 2 * SIGMAS * np.sqrt(variances[::-1])
    x, y = centre - 0.5
    cv2.ellipse(image, ((x, y), (long, short), angle_deg), colour, 1, cv2.LINE_AA)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("image", type=Path, nargs="?", default=BUNDLED)
    parser.add_argument("--spacecraft", default="satellite_01")
    parser.add_argument("--focal-px", type=float, default=1400.0)
    parser.add_argument("--out", type=Path, default=Path("ellipses.png"))
    arguments = parser.parse_args()

    pixels = cv2.imread(str(arguments.image))
    if pixels is None:
        raise SystemExit(f"{arguments.image}: cannot be read as an image")
    camera = gknet.Camera.from_focal(arguments.focal_px, pixels.shape[1], pixels.shape[0])
    estimate = gknet.load_estimator(arguments.spacecraft).estimate(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), camera)
    if estimate.keypoints is None or estimate.covariance is None or estimate.inliers is None:
        raise SystemExit(f"no pose: {estimate.failure}")

    for k, centre in enumerate(estimate.keypoints.pixels):
        colour = (80, 220, 80) if estimate.inliers[k] else (60, 60, 230)  # BGR: inliers green, outliers red
        draw_ellipse(pixels, centre, estimate.keypoints.covariance_px2[k], colour)
    cv2.imwrite(str(arguments.out), pixels)

    sigma, position_m2 = np.sqrt(np.diag(estimate.covariance)), estimate.covariance[3:, 3:]
    assert estimate.cam_from_body is not None
    direction = estimate.cam_from_body.translation_m / np.linalg.norm(estimate.cam_from_body.translation_m)
    print("attitude, deg about camera x, y, z:", np.degrees(sigma[:3]).round(3))
    print("position, m along camera x, y, z:  ", sigma[3:].round(4))
    print("range, m:                          ", round(float(np.sqrt(direction @ position_m2 @ direction)), 4))
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
