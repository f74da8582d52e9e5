"""The loop of a prediction: images through an estimator into files."""

from __future__ import annotations

from collections.abc import Iterable

import cv2

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, FailureKind, Frame, PoseEstimator, Unreadable
from gknet.io.interrupt import Interruption
from gknet.io.text import counted
from gknet.predict.results import PredictionWriter


def predict_all(
    pictures: Iterable[Frame | Unreadable],
    estimator: PoseEstimator,
    writer: PredictionWriter,
    box: Box | None = None,
    oracle: bool = False,
) -> None:
    """Estimate the pose in each image and hand it to the writer.

    An image that cannot be read, or that the estimator refuses, is recorded and skipped. An image that the writer
    has from an earlier run is skipped.

    Args:
        images: Frames with images, in order, such as a `gknet.predict.source.Source`.
        estimator: Of the spacecraft that is sought.
        writer: Entered by the caller.
        box: Where the spacecraft is in every image, in px; None has the estimator find it.
        oracle: Take each box from the image's labels instead. An image that shows no keypoint by its labels is
            recorded as a failure of the kind `no_keypoint_in_view`.

    Raises:
        GknetError: With `oracle`, an image has no true pose.
        OSError: The poses cannot be written.
        gknet.io.interrupt.Interrupted: A stop signal came. The poses of all images before it are recorded.
    """
    with Interruption() as interruption:
        for picture in pictures:
            interruption.raise_if_requested(_kept_words(writer))
            if writer.is_kept(picture.name):
                continue
            if isinstance(picture, Unreadable):
                writer.add_unreadable(picture)
                continue
            if oracle and picture.cam_from_body is None:
                raise GknetError("--oracle: expected a dataset with true poses; give --box, or let it be found")
            try:
                estimate = _estimate(picture, estimator, box, oracle)
            except (GknetError, cv2.error, MemoryError) as error:
                writer.add_unreadable(Unreadable.because(picture.name, str(error) or type(error).__name__))
            else:
                writer.add(picture, estimate)
        interruption.raise_if_requested(_kept_words(writer))


def _estimate(frame: Frame, estimator: PoseEstimator, box: Box | None, oracle: bool) -> Estimate:
    if frame.image is None:
        raise GknetError(f"frame {frame.name}: the image is missing")
    if oracle:
        box = frame.true_box(estimator.spacecraft.points_m)
        if box is None:
            return Estimate(failure=Failure(FailureKind.NO_KEYPOINT_IN_VIEW, "the image shows no keypoint"))
    return estimator.estimate(frame.image, frame.camera, box)


def _kept_words(writer: PredictionWriter) -> str:
    if writer.count == 0:
        return ""
    return f"{writer.folder} holds the results of {counted(writer.count, 'image')}; --resume goes on with them"
