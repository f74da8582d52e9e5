"""One image in, one `Estimate` out: locate, crop, network, decode, pose; and the estimators that are on disk."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Keypoints
from gknet.geometry import Camera
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.decode import Decoding, decode_heatmaps, keypoints_to_image
from gknet.inference.direct_estimator import DirectEstimator, confidence_in
from gknet.inference.locate import CropEstimator, InferenceSettings, KeypointNetwork, Network, network_input
from gknet.inference.onnx_model import OnnxModel
from gknet.inference.pnp import PnpResult, PnpSettings, solve_pnp
from gknet.spacecraft import Spacecraft

SURE_SCORE = 0.3
"""Keypoints from this score on say where a crop should have been."""


@dataclass(frozen=True, eq=False)
class Estimator(CropEstimator):
    """Finds one known spacecraft by its keypoints. `load_estimator` makes one.

    Attributes:
        keypoint_network: (b, 3, s, s) -> heatmaps (b, n, s / stride, s / stride), channel k is keypoint k, and for some
            networks the probabilities of the attitude classes.
        spacecraft: The spacecraft that it finds.
        locator: (b, 3, s, s) -> (b, 5, s / stride, s / stride); None if boxes are always given.
        settings: Input sizes, crop refinement and test-time augmentation.
        decoding: Scales of the keypoints' covariance.
        pnp: Thresholds of the pose solver.
        bins: The attitude classes; None for a network without them.
    """

    keypoint_network: KeypointNetwork
    spacecraft: Spacecraft
    locator: Network | None = None
    settings: InferenceSettings = field(default_factory=InferenceSettings)
    decoding: Decoding = field(default_factory=Decoding)
    pnp: PnpSettings = field(default_factory=PnpSettings)
    bins: AttitudeBins | None = None

    def estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box) -> Estimate:
        crop = Crop.around(box, self.settings.input_size)
        keypoints, attitude = self.detect(image, crop)
        first = self.pose_of(keypoints, camera, box, crop, attitude)
        better_crop = self._better_crop(first, camera, crop)
        if better_crop is None:
            return first
        keypoints, attitude = self.detect(image, better_crop)
        second = self.pose_of(keypoints, camera, box, better_crop, attitude, trust_box=False)
        return second if _support(second) >= _support(first) else first

    def detect(self, image: UInt8[ndarray, "h w 3"], crop: Crop) -> tuple[Keypoints, Float32[ndarray, " k"] | None]:
        """The keypoints in a crop, in pixels of the full image, and the probabilities of the attitude classes, if any."""
        heatmaps, attitude = self._seen(network_input(image, crop))
        if len(heatmaps) != self.spacecraft.keypoint_count:
            raise GknetError(
                f"keypoint network: expected {self.spacecraft.keypoint_count} heatmaps for {self.spacecraft.name}, "
                f"got {len(heatmaps)}"
            )
        if attitude is not None and self.bins is not None and len(attitude) != self.bins.count:
            raise GknetError(f"keypoint network: expected {self.bins.count} classes of attitude, got {len(attitude)}")
        keypoints = decode_heatmaps(heatmaps, crop.size / heatmaps.shape[2], self.decoding)
        return keypoints_to_image(keypoints, crop), attitude

    def _seen(
        self, upright: Float32[ndarray, "1 3 s s"]
    ) -> tuple[Float32[ndarray, "n hs ws"], Float32[ndarray, " k"] | None]:
        """Heatmaps, the mean over quarter turns of the crop, each turned back: what errs in one of them is outvoted.

        The belief in the attitude is that of the upright crop.
        """
        rotations = range(0, 4, 4 // self.settings.tta_rotations)
        views = np.concatenate([np.rot90(upright, turn, (2, 3)) for turn in rotations])
        seen = self.keypoint_network(views)
        turned_back = [np.rot90(maps, -turn, (1, 2)) for maps, turn in zip(seen.heatmaps, rotations, strict=True)]
        return np.mean(turned_back, axis=0), None if seen.attitude is None else seen.attitude[0]

    def pose_of(
        self,
        keypoints: Keypoints,
        camera: Camera,
        box: Box,
        crop: Crop,
        attitude: Float32[ndarray, " k"] | None = None,
        trust_box: bool = True,
    ) -> Estimate:
        """The pose that explains the keypoints (image pixels) seen in a crop, or why there is none.

        attitude    the belief in its classes, seen in that crop
        trust_box   whether the box has a say; not one that the keypoints contradicted
        """
        measured = box if trust_box else None
        result = solve_pnp(keypoints, camera, self.spacecraft.points_m, 1 / crop.scale, self.pnp, measured)
        if not isinstance(result, PnpResult):
            return Estimate(keypoints, box=box, failure=result)
        contradiction = self.contradiction(result.cam_from_body, camera, crop)
        if contradiction is not None:
            return Estimate(keypoints, box=box, failure=contradiction)
        return Estimate(
            keypoints,
            result.cam_from_body,
            result.covariance,
            result.inliers,
            result.reprojection_rms_px,
            box,
            attitude_confidence=confidence_in(result.cam_from_body, attitude, self.bins),
        )

    def _better_crop(self, estimate: Estimate, camera: Camera, crop: Crop) -> Crop | None:
        """The crop about the keypoints found, when it overlaps little with the one they were found in."""
        if not self.settings.refine_crop or estimate.keypoints is None:
            return None
        if estimate.cam_from_body is not None:
            pixels = camera.project(estimate.cam_from_body.transform(self.spacecraft.points_m))
        else:
            pixels = estimate.keypoints.pixels[estimate.keypoints.score >= SURE_SCORE]
        if np.isfinite(pixels).all(axis=1).sum() < 4:
            return None
        inside = Box.around(pixels).clipped(camera.width, camera.height)
        if inside is None:
            return None
        better = Crop.around(inside, crop.size)
        return better if _square(better).iou(_square(crop)) < self.settings.refine_iou else None


def _square(crop: Crop) -> Box:
    return Box(crop.x0, crop.y0, crop.x0 + crop.side, crop.y0 + crop.side)


def _support(estimate: Estimate) -> float:
    """How much evidence a pose has: the scores of the keypoints that agree with it; -1 without a pose."""
    if estimate.keypoints is None or estimate.inliers is None:
        return -1.0
    return float(estimate.keypoints.score[estimate.inliers].sum())


KINDS = ("keypoints", "direct")
"""What a model's folder holds, as KIND.onnx: one of them, perhaps with a locator.onnx."""


def _kinds_in(folder: Traversable) -> list[str]:
    return [kind for kind in KINDS if (folder / f"{kind}.onnx").is_file()]


def shipped_models() -> tuple[str, ...]:
    """Names that `load_estimator` knows without a path."""
    folder = resources.files("gknet") / "models"
    if not folder.is_dir():
        return ()
    return tuple(sorted(entry.name for entry in folder.iterdir() if _kinds_in(entry)))


def load_estimator(
    name_or_folder: str | Path, threads: int | None = None, device: str = "cpu", tta_rotations: int = 1
) -> Estimator | DirectEstimator:
    """Load a model.

    Args:
        name_or_folder: The name of a shipped model, such as satellite_01, or a folder with keypoints.onnx or
            direct.onnx. With a locator.onnx beside it the estimator needs no box.
        threads: Threads of onnxruntime; all cores by default.
        device: "cpu" or "cuda".
        tta_rotations: In how many orientations (1, 2 or 4) a keypoint network sees each crop: more is more accurate and
            takes as many times the work.

    Returns:
        An estimator by keypoints, or by direct pose regression where the folder has a direct.onnx. Both have
        `estimate(image, camera, box=None)`.

    Raises:
        GknetError: There is no such model, or a file is damaged.
    """
    folder = Path(name_or_folder)
    if str(name_or_folder) in shipped_models():
        folder = Path(str(resources.files("gknet") / "models" / str(name_or_folder)))
    kinds = _kinds_in(folder)
    if len(kinds) != 1:
        known = ", ".join(shipped_models()) or "none"
        got = "; it has both, remove one" if kinds else ""
        raise GknetError(
            f"model '{name_or_folder}': expected a shipped model ({known}) "
            f"or a folder with keypoints.onnx or direct.onnx{got}"
        )
    network = _open(folder, kinds[0], threads, device)
    has_locator = (folder / "locator.onnx").is_file()
    locator = _open(folder, "locator", threads, device) if has_locator else None
    about = network.metadata
    locator_size = locator.metadata.input_size if locator else InferenceSettings.locator_size
    settings = InferenceSettings(about.input_size, locator_size, tta_rotations=tta_rotations)
    bins = None if about.bins is None else AttitudeBins(about.bins)
    if kinds[0] == "direct":
        assert bins is not None  # by its metadata
        if tta_rotations > 1:
            raise GknetError(
                f"tta_rotations: only a keypoint network sees a crop in several orientations, got {tta_rotations}"
            )
        return DirectEstimator(network, network.spacecraft, bins, locator, settings)
    return Estimator(
        network.predict,
        network.spacecraft,
        locator,
        settings,
        Decoding(about.floor_cells, about.spread_scale),
        PnpSettings(covariance_scale=about.pose_scale),
        bins,
    )


def _open(folder: Path, kind: str, threads: int | None, device: str) -> OnnxModel:
    network = OnnxModel(folder / f"{kind}.onnx", threads, device)
    if network.metadata.kind != kind:
        raise GknetError(f"{network.path}: expected a network of kind '{kind}', got '{network.metadata.kind}'")
    return network
