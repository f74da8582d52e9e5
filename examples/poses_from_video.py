"""Print the pose in each frame of a video.

python examples/poses_from_video.py VIDEO --spacecraft satellite_01 --focal-px 1400
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import cv2
import numpy as np

import gknet


def frames_of(path: str) -> Iterator[tuple[float, np.ndarray]]:
    """Time in s and RGB image of each frame."""
    video = cv2.VideoCapture(path)
    if not video.isOpened():
        raise SystemExit(f"{path}: cannot be read as a video")
    while True:
        time_s = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
        read, image = video.read()
        if not read:
            return
        yield time_s, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("video")
    parser.add_argument("--spacecraft", default="satellite_01")
    parser.add_argument("--focal-px", type=float, default=1400.0)
    arguments = parser.parse_args()

    estimator = gknet.load_estimator(arguments.spacecraft)
    for time_s, image in frames_of(arguments.video):
        camera = gknet.Camera.from_focal(arguments.focal_px, image.shape[1], image.shape[0])
        estimate = estimator.estimate(image, camera)
        if estimate.cam_from_body is None:
            print(f"{time_s:8.3f} s  no pose: {estimate.failure}")
        else:
            x, y, z = estimate.cam_from_body.translation_m
            print(f"{time_s:8.3f} s  {x:8.3f} {y:8.3f} {z:8.3f} m")


if __name__ == "__main__":
    main()
