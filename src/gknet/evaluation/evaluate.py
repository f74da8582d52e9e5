"""A dataset through an estimator: the errors of the oracle's crop and of the detected crop, frame by frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.evaluation.metrics import FrameErrors, compute_errors, keypoint_errors_px, oracle_crop
from gknet.evaluation.summary import Summary, summarise
from gknet.frame import Estimate, Failure, FailureKind, Frame, Keypoints, PoseEstimator, Unreadable
from gknet.inference.crop import Crop
from gknet.spacecraft import Spacecraft

Protocol = Literal["oracle", "detected"]
SWAP_PX = 10.0
"""A detection within this of another keypoint, and not of its own, is a swap."""

PROTOCOL_WORDS: dict[Protocol, str] = {"oracle": "oracle crop", "detected": "detected crop"}

UNKNOWN_WORDS = {
    "visible": "which keypoints the spacecraft hides, so there are no errors of hidden ones",
    "sun_direction": "where the sun is, so there are no phase angles",
}
"""What a dataset without a column leaves unknown."""


@dataclass(frozen=True, eq=False)
class Case:
    """One frame's estimate and its errors.

    Attributes:
        index: The frame's place in the dataset.
        frame_name: Its name.
        estimate: The estimate.
        errors: Compared with the truth.
        keypoint_px: (n,) distances in pixels of the 256 oracle crop, NaN for keypoints out of view.
        taken_for: (n,) the true keypoint at which each detection lies (see the function).
        visible: (n,) bool: in view and not hidden; None when unknown.
        seconds: From the image to the pose, reading excluded.
    """

    index: int
    frame_name: str
    estimate: Estimate
    errors: FrameErrors
    keypoint_px: Float[ndarray, " n"]
    taken_for: Int[ndarray, " n"]
    visible: Bool[ndarray, " n"] | None
    seconds: float


@dataclass(frozen=True, eq=False)
class ProtocolRun:
    """All frames under one protocol.

    Attributes:
        protocol: Where the boxes come from: "oracle" (the truth) or "detected" (the locator).
        cases: The frames, in the dataset's order.
    """

    protocol: Protocol
    cases: tuple[Case, ...]

    @cached_property
    def summary(self) -> Summary:
        """The metrics over all frames."""
        return summarise([case.errors for case in self.cases])

    @property
    def median_ms(self) -> float:
        """Median duration of one estimate in ms, from the image to the pose, reading excluded."""
        return 1000 * float(np.median([case.seconds for case in self.cases]))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A dataset's frames under each protocol.

    Attributes:
        spacecraft: Whose poses they are.
        data: Where the frames come from, for people.
        runs: One for each protocol, over the same frames.
        skipped: Frames that could not be read or show no keypoint; they are in no mean.
    """

    spacecraft: Spacecraft
    data: str
    runs: tuple[ProtocolRun, ...]
    skipped: tuple[Unreadable, ...]

    @property
    def unknown(self) -> tuple[str, ...]:
        """The columns of UNKNOWN_WORDS that no frame has."""
        cases = self.runs[0].cases
        known = {
            "visible": any(case.visible is not None for case in cases),
            "sun_direction": any(case.errors.phase_angle_rad is not None for case in cases),
        }
        return tuple(column for column in UNKNOWN_WORDS if not known[column])

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON; lengths in metres or diameters, angles in radians, keypoints in pixels of the 256 crop."""
        return {
            "spacecraft": self.spacecraft.name,
            "data": self.data,
            "unknown": list(self.unknown),
            "skipped": [{"name": bad.name, "failure": bad.failure.to_dict()} for bad in self.skipped],
            "runs": {run.protocol: self._run_dict(run) for run in self.runs},
        }

    def _run_dict(self, run: ProtocolRun) -> dict[str, object]:
        names = self.spacecraft.keypoint_names
        keypoints = [keypoint_statistics(run, k) for k in range(len(names))]
        return {
            **run.summary.to_dict(),
            "median_ms": round(run.median_ms, 3),
            "keypoints": {name: found.to_dict() for name, found in zip(names, keypoints, strict=True)},
        }


@dataclass(frozen=True)
class KeypointStatistics:
    """The errors of one keypoint where it is in view, in px of the 256 oracle crop; None when it never is.

    Attributes:
        frames: How many frames have it in view.
        median_px: The median.
        high_px: The 90th percentile.
        hidden_median_px: The median where the spacecraft hides it.
    """

    frames: int
    median_px: float | None
    high_px: float | None
    hidden_median_px: float | None

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {
            "frames": self.frames,
            "median_px": self.median_px,
            "percentile_90_px": self.high_px,
            "hidden_median_px": self.hidden_median_px,
        }


def keypoint_statistics(run: ProtocolRun, k: int) -> KeypointStatistics:
    """Median and 90th percentile of a keypoint's error, and its median where the spacecraft hides it.

    Args:
        run: All frames under one protocol.
        k: Index of the keypoint.
    """
    distance = np.array([case.keypoint_px[k] for case in run.cases])
    hidden = np.array([case.visible is not None and not case.visible[k] for case in run.cases])
    in_view = np.isfinite(distance)
    if not in_view.any():
        return KeypointStatistics(0, None, None, None)
    median, high = np.percentile(distance[in_view], (50, 90))
    concealed = distance[in_view & hidden]
    return KeypointStatistics(
        int(in_view.sum()), float(median), float(high), float(np.median(concealed)) if len(concealed) else None
    )


def evaluate(
    dataset: SkdDataset,
    estimator: PoseEstimator,
    protocols: Sequence[Protocol] = ("oracle", "detected"),
    data: str = "",
    on_frame: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Estimate every frame under each protocol; a frame that cannot be read is recorded and skipped.

    Args:
        dataset: With true poses.
        estimator: Of the dataset's spacecraft; with a locator for the protocol "detected".
        protocols: Where the boxes come from.
        data: Where the frames come from, for the report; the dataset's folder when empty.
        on_frame: Called after each frame, for a progress bar.

    Raises:
        GknetError: No frame could be used.
    """
    cases: dict[Protocol, list[Case]] = {protocol: [] for protocol in protocols}
    skipped = []
    for i in range(len(dataset)):
        frame = _usable_frame(dataset, i, estimator.spacecraft)
        if isinstance(frame, Unreadable):
            skipped.append(frame)
        else:
            for protocol in protocols:
                cases[protocol].append(_case(i, frame, dataset.sequence_of(i), estimator, protocol))
        on_frame()
    if not any(cases.values()):
        first = f"; the first: {skipped[0].failure}" if skipped else ""
        raise GknetError(f"evaluation: none of {len(dataset)} frames could be used{first}")
    runs = tuple(ProtocolRun(protocol, tuple(cases[protocol])) for protocol in protocols)
    return Evaluation(estimator.spacecraft, data or str(dataset.root), runs, tuple(skipped))


def _usable_frame(dataset: SkdDataset, index: int, spacecraft: Spacecraft) -> Frame | Unreadable:
    """A frame that shows a keypoint at least, or why it cannot be used."""
    name = f"{dataset.sequence_of(index)}, frame {index}"
    try:
        frame = dataset.frame(index)
        if frame.true_box(spacecraft.points_m) is not None:
            return frame
    except GknetError as error:
        return Unreadable.because(name, error)
    return Unreadable(name, Failure(FailureKind.NO_KEYPOINT_IN_VIEW, f"frame {frame.name}: no keypoint is in view"))


def _case(index: int, frame: Frame, sequence: str, estimator: PoseEstimator, protocol: Protocol) -> Case:
    spacecraft = estimator.spacecraft
    if frame.image is None:
        raise GknetError(f"frame {frame.name}: an evaluation needs its image")
    box = frame.true_box(spacecraft.points_m) if protocol == "oracle" else None
    start = time.perf_counter()
    estimate = estimator.estimate(frame.image, frame.camera, box)
    seconds = time.perf_counter() - start
    crop = oracle_crop(frame, spacecraft)
    true_px = frame.keypoints_px(spacecraft.points_m)
    in_view = frame.camera.contains(true_px)
    distance = np.where(in_view, keypoint_errors_px(estimate.keypoints, true_px, crop), np.nan)
    found = compute_errors(frame, estimate, spacecraft, crop, sequence)
    taken = taken_for(estimate.keypoints, true_px, in_view, crop)
    return Case(index, frame.name, estimate, found, distance, taken, frame.visible, seconds)


def taken_for(
    keypoints: Keypoints | None, true_px: Float[ndarray, "n 2"], in_view: Bool[ndarray, " n"], crop: Crop
) -> Int[ndarray, " n"]:
    """The true keypoint at which each detection lies.

    A detection within `SWAP_PX` (pixels of the 256 oracle crop) of its own keypoint is at that one; else it is at the
    nearest other one within `SWAP_PX`. What has no peak (score 0) is no detection.

    Args:
        keypoints: As detected; None without a detection.
        true_px: (n, 2) true keypoints in image pixels.
        in_view: (n,) bool.
        crop: The 256 oracle crop.

    Returns:
        (n,) indices; -1 for a detection at no keypoint, for none, and for a keypoint out of view.
    """
    count = len(true_px)
    if keypoints is None:
        return np.full(count, -1)
    distance = np.linalg.norm(keypoints.pixels[:, None] - true_px[None], axis=2) * crop.scale
    distance[:, ~in_view] = np.inf
    own = np.arange(count)
    taken = np.where(np.diag(distance) < SWAP_PX, own, distance.argmin(axis=1))
    return np.where(in_view & (keypoints.score > 0) & (distance[own, taken] < SWAP_PX), taken, -1)


def confusion(run: ProtocolRun) -> Int[ndarray, "n n"]:
    """(n, n) how often keypoint i (row) in view was detected at keypoint j: off the diagonal are swaps."""
    taken = np.stack([case.taken_for for case in run.cases])
    matrix = np.zeros((taken.shape[1], taken.shape[1]), dtype=np.int64)
    for row, column in enumerate(taken.T):
        matrix[row] = np.bincount(column[column >= 0], minlength=len(matrix))
    return matrix
