"""Compare a model with the truth of a dataset, frame by frame.

    python examples/evaluate_dataset.py [DATASET] [--spacecraft satellite_01] [--split test]

Without DATASET, the bundled test frames are used.
"""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path

import numpy as np

import gknet
from gknet.dataset.skd import SkdDataset

BUNDLED = Path(str(files("gknet") / "demo_data"))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset", type=Path, nargs="?", default=BUNDLED)
    parser.add_argument("--spacecraft", default="satellite_01")
    parser.add_argument("--split", default="test")
    arguments = parser.parse_args()

    estimator = gknet.load_estimator(arguments.spacecraft)
    dataset = SkdDataset(arguments.dataset, arguments.split, arguments.spacecraft)
    errors = []  # E_t (eq. 7 of the paper) and E_q (eq. 8); a failure counts as 1 and pi
    for frame in dataset:
        if frame.image is None or frame.cam_from_body is None:
            continue
        found, truth = estimator.estimate(frame.image, frame.camera).cam_from_body, frame.cam_from_body
        if found is None:
            errors.append((1.0, np.pi))
        else:
            off_m = float(np.linalg.norm(found.translation_m - truth.translation_m))
            errors.append((off_m / float(np.linalg.norm(truth.translation_m)), found.angle_to(truth)))
        print(f"{frame.name}  E_t {errors[-1][0]:.4f}  E_q {errors[-1][1]:.4f} rad")
    e_t, e_q = np.median(errors, axis=0)
    print(f"median of {len(errors)} frames  E_t {e_t:.4f}  E_q {e_q:.4f} rad")


if __name__ == "__main__":
    main()
