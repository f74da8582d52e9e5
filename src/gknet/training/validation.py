"""Validation runs the deployed code: crop, decode and pose in numpy; only the network is torch."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
import torch
from jaxtyping import Float32
from numpy import ndarray
from torch import nn

from gknet.errors import GknetError
from gknet.evaluation import metrics
from gknet.evaluation.calibration import UNCALIBRATED, calibrated, collect_sample
from gknet.frame import Frame
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop_estimator import InferenceSettings
from gknet.inference.decode import Decoding
from gknet.inference.direct_estimator import DirectEstimator
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.network_io import NetworkOutput
from gknet.io.interrupt import Interruption
from gknet.network.heatmap import HeatmapNetwork
from gknet.spacecraft import Spacecraft

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Validation:
    """The result of a validation.

    Attributes:
        score: Decides which weights are the best: lower is better.
        values: What the tables show.
    """

    score: float
    values: dict[str, float]


@dataclass(frozen=True, eq=False)
class InterruptibleFrames(Sequence[Frame]):
    """Frames of which the next one is not read once a stop signal came: `Interrupted` is raised instead."""

    frames: Sequence[Frame]
    interruption: Interruption

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, i: int) -> Frame: ...
    @overload
    def __getitem__(self, i: slice) -> Sequence[Frame]: ...
    def __getitem__(self, i: int | slice) -> Frame | Sequence[Frame]:
        self.interruption.raise_if_requested()
        return self.frames[i]


def numpy_network(network: nn.Module, device: torch.device) -> Callable[[ndarray], ndarray]:
    """A torch network as the estimators call it: numpy in, numpy out, float32."""

    def run(images: Float32[ndarray, "b 3 s s"]) -> Float32[ndarray, "b c *cells"]:
        with torch.inference_mode():
            batch = torch.from_numpy(images).to(device).contiguous(memory_format=torch.channels_last)
            return network(batch).float().cpu().numpy()

    return run


def _usable(frames: Sequence[Frame], rows: Sequence[int], spacecraft: Spacecraft) -> Iterator[tuple[int, Frame]]:
    """The rows and frames that can be read and that show the spacecraft, one at a time; the others are logged."""
    found = 0
    for row in rows:
        try:
            frame = frames[row]
            metrics.oracle_crop(frame, spacecraft)
        except GknetError as error:
            logger.warning("left out: %s", error)
            continue
        found += 1
        yield row, frame
    if not found:
        raise GknetError("validation: no frame of the val split can be read and shows the spacecraft")


def usable_rows(frames: Sequence[Frame], rows: Sequence[int], spacecraft: Spacecraft) -> list[int]:
    """The rows that a validation can use, found before the training begins; the others are logged.

    Raises:
        GknetError: There are none.
    """
    return [row for row, _ in _usable(frames, rows, spacecraft)]


def validation_rows(count: int, wanted: int) -> list[int]:
    """At most `wanted` rows, evenly spread over the split, the same ones every time."""
    return sorted({int(row) for row in np.linspace(0, count - 1, min(count, wanted)).round()})


def validate_keypoints(
    network: HeatmapNetwork,
    device: torch.device,
    frames: Sequence[Frame],
    rows: Sequence[int],
    spacecraft: Spacecraft,
    input_size: int,
) -> Validation:
    """Errors in the oracle crop; the score is the mean RMSE in pixels of the 256 crop (eq. 6)."""
    network.eval()
    settings = InferenceSettings(input_size=input_size)
    run = numpy_network(network, device)
    uncalibrated = KeypointEstimator(
        lambda images: NetworkOutput(run(images)), spacecraft, settings=settings, decoding=UNCALIBRATED
    )
    samples = [collect_sample(frame, uncalibrated, network.stride) for _, frame in _usable(frames, rows, spacecraft)]
    try:
        estimator = calibrated(uncalibrated, samples)
    except GknetError:  # too few confident keypoints yet
        estimator = replace(uncalibrated, decoding=Decoding())
    errors = [metrics.compute_errors(s.frame, s.estimate(estimator), spacecraft) for s in samples]
    values = _means(errors) | {
        "floor_cells": estimator.decoding.floor_cells,
        "spread_scale": estimator.decoding.spread_scale,
        "pose_scale": estimator.pnp.covariance_scale,
    }
    return Validation(values["rmse_px"], values)


def _means(errors: Sequence[metrics.FrameErrors]) -> dict[str, float]:
    return {
        "rmse_px": float(np.mean([error.rmse_px for error in errors])),
        "median_px": float(np.median([error.rmse_px for error in errors])),
        "pck_5": float(np.mean([error.pck_5 for error in errors])),
        "e_t": float(np.mean([error.e_t for error in errors])),
        "e_q_rad": float(np.mean([error.e_q_rad for error in errors])),
        "failures": float(np.mean([error.failure is not None for error in errors])),
    }


def validate_direct(
    network: nn.Module,
    device: torch.device,
    frames: Sequence[Frame],
    rows: Sequence[int],
    spacecraft: Spacecraft,
    bins: AttitudeBins,
    input_size: int,
) -> Validation:
    """Errors in the oracle crop; the score is that of keypoint networks, with the keypoints projected by the pose."""
    network.eval()
    settings = InferenceSettings(input_size=input_size)
    estimator = DirectEstimator(numpy_network(network, device), spacecraft, bins, settings=settings)
    errors = []
    for _, frame in _usable(frames, rows, spacecraft):
        assert frame.image is not None
        estimate = estimator.estimate(frame.image, frame.camera, frame.true_box(spacecraft.points_m))
        errors.append(metrics.compute_errors(frame, estimate, spacecraft))
    values = _means(errors)
    return Validation(values["rmse_px"], values)


def validate_locator(
    network: nn.Module,
    device: torch.device,
    frames: Sequence[Frame],
    rows: Sequence[int],
    spacecraft: Spacecraft,
    input_size: int,
) -> Validation:
    """Overlap of found and true boxes; the score is 1 minus the share with an IoU of 0.7 or more, plus a tenth of
    1 minus the mean IoU."""
    network.eval()
    run = numpy_network(network, device)
    estimator = KeypointEstimator(
        lambda images: NetworkOutput(run(images)),
        spacecraft,
        locator=run,
        settings=InferenceSettings(locator_size=input_size),
    )
    overlaps = []
    for _, frame in _usable(frames, rows, spacecraft):
        assert frame.image is not None
        true_box, found = frame.true_box(spacecraft.points_m), estimator.locate(frame.image)
        overlaps.append(0.0 if found is None or true_box is None else found.iou(true_box))
    values = {
        "iou": float(np.mean(overlaps)),
        "iou_07": float(np.mean(np.array(overlaps) >= 0.7)),
        "iou_085": float(np.mean(np.array(overlaps) >= 0.85)),
    }
    return Validation(1 - values["iou_07"] + 0.1 * (1 - values["iou"]), values)
