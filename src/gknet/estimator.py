"""One image in, one `Estimate` out: locate, crop, network, decode, pose. Networks are plain callables on numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from gknet.crop import Crop
from gknet.decode import Decoding, decode_heatmaps, decode_locator, keypoints_to_image
from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Keypoints
from gknet.geometry import Camera, Pose
from gknet.onnx_network import OnnxNetwork
from gknet.pnp import PnpResult, PnpSettings, solve_pnp
from gknet.spacecraft import Spacecraft

Network = Callable[[Float32[ndarray, "b 3 size size"]], Float32[ndarray, "b c h w"]]

PLAUSIBLE_SIZE = (0.25, 6.0)
"""Projected diameter of the craft over the crop's side: less when it is seen end-on, more when it is cut off."""

SURE_SCORE = 0.3
"""Keypoints from this score on say where a crop should have been."""


@dataclass(frozen=True)
class Looking:
    """How an image is looked at.

    input_size     side of the keypoint network's input in pixels
    locator_size   side of the locator's
    min_located    the locator's peak below which there is no spacecraft
    relook_below   a first box smaller than this part of the locator's view is located again in a crop about it
    refine_crop    look once more where the keypoints say that the crop was off ...
    refine_iou     ... which is when the two crops overlap less than this
    """

    input_size: int = 256
    locator_size: int = 256
    min_located: float = 0.1
    relook_below: float = 0.0
    refine_crop: bool = True
    refine_iou: float = 0.75


def check_image(image: object) -> UInt8[ndarray, "h w 3"]:
    """The image as RGB; grey ones are repeated into three channels."""
    if not isinstance(image, ndarray) or image.dtype != np.uint8:
        kind = image.dtype if isinstance(image, ndarray) else type(image).__name__
        raise GknetError(f"image: expected a uint8 array, got {kind}")
    if image.ndim == 2 and image.size > 0:
        return np.repeat(image[:, :, None], 3, axis=2)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise GknetError(f"image: expected RGB of shape (h, w, 3) or grey of (h, w), got {image.shape}")
    return image


def network_input(image: UInt8[ndarray, "h w 3"], crop: Crop) -> Float32[ndarray, "1 3 size size"]:
    """The crop as a network sees it: RGB in [0, 1], channels first."""
    cut = crop.cut(image).transpose(2, 0, 1)[None]
    return np.ascontiguousarray(cut, dtype=np.float32) / np.float32(255)


@dataclass(frozen=True, eq=False)
class Estimator:
    """Finds one known spacecraft.

    keypoint_network   (b, 3, s, s) -> heatmaps (b, n, s / stride, s / stride), channel k is keypoint k
    locator            (b, 3, s, s) -> (b, 5, s / stride, s / stride), see `decode_locator`; None if boxes are given
    """

    keypoint_network: Network
    spacecraft: Spacecraft
    locator: Network | None = None
    looking: Looking = field(default_factory=Looking)
    decoding: Decoding = field(default_factory=Decoding)
    pnp: PnpSettings = field(default_factory=PnpSettings)

    def estimate(self, image: UInt8[ndarray, "h w *c"], camera: Camera, box: Box | None = None) -> Estimate:
        """The pose of the spacecraft in `image`, or why there is none. Without a `box` the locator finds it."""
        image = check_image(image)
        if image.shape[:2] != (camera.height, camera.width):
            raise GknetError(
                f"image: expected the camera's {camera.width} x {camera.height} pixels, "
                f"got {image.shape[1]} x {image.shape[0]}"
            )
        box = box or self.locate(image)
        if box is None:
            return Estimate(failure="the locator sees no spacecraft")
        if box.clipped(camera.width, camera.height) is None:
            return Estimate(box=box, failure="the box lies outside the image")
        crop = Crop.around(box, self.looking.input_size)
        first = self._estimate_in(image, camera, box, crop)
        better_crop = self._better_crop(first, camera, crop)
        if better_crop is None:
            return first
        second = self._estimate_in(image, camera, box, better_crop)
        return second if _support(second) >= _support(first) else first

    def locate(self, image: UInt8[ndarray, "h w *c"]) -> Box | None:
        """The spacecraft's box in pixels of the full image, None when the locator sees none."""
        if self.locator is None:
            raise GknetError("estimator: it has no locator; give a box")
        image = check_image(image)
        height, width = image.shape[:2]
        side = max(width, height)
        whole = Crop((width - side) // 2, (height - side) // 2, side, self.looking.locator_size)
        box = self._locate_in(image, whole)
        if box is None or box.side >= self.looking.relook_below * side:
            return box
        return self._locate_in(image, Crop.around(box, self.looking.locator_size, margin=3)) or box

    def _locate_in(self, image: UInt8[ndarray, "h w 3"], crop: Crop) -> Box | None:
        if self.locator is None:
            return None
        output = self.locator(network_input(image, crop))[0]
        found = decode_locator(output, crop.size / output.shape[2], crop.size, self.looking.min_located)
        if found is None:
            return None
        seen = found[0]
        (x0, y0), (x1, y1) = crop.to_image(np.array([[seen.x0, seen.y0], [seen.x1, seen.y1]]))
        return Box(float(x0), float(y0), float(x1), float(y1)).clipped(image.shape[1], image.shape[0])

    def detect(self, image: UInt8[ndarray, "h w 3"], crop: Crop) -> Keypoints:
        """The keypoints seen in a crop, in pixels of the full image."""
        heatmaps = self.keypoint_network(network_input(image, crop))[0]
        if len(heatmaps) != self.spacecraft.keypoint_count:
            raise GknetError(
                f"keypoint network: expected {self.spacecraft.keypoint_count} heatmaps for {self.spacecraft.name}, "
                f"got {len(heatmaps)}"
            )
        keypoints = decode_heatmaps(heatmaps, crop.size / heatmaps.shape[2], self.decoding)
        return keypoints_to_image(keypoints, crop)

    def _estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box, crop: Crop) -> Estimate:
        return self.pose_of(self.detect(image, crop), camera, box, crop)

    def pose_of(self, keypoints: Keypoints, camera: Camera, box: Box, crop: Crop) -> Estimate:
        """The pose that explains the keypoints (image pixels) seen in a crop, or why there is none."""
        result = solve_pnp(keypoints, camera, self.spacecraft.points_m, 1 / crop.scale, self.pnp)
        if not isinstance(result, PnpResult):
            return Estimate(keypoints, box=box, failure=result)
        ratio = self._projected_diameter(result.cam_from_body, camera) / crop.side
        if not PLAUSIBLE_SIZE[0] <= ratio <= PLAUSIBLE_SIZE[1]:
            return Estimate(keypoints, box=box, failure=f"the pose makes the spacecraft {ratio:.2g} crops large")
        return Estimate(
            keypoints, result.cam_from_body, result.covariance, result.inliers, result.reprojection_rms_px, box
        )

    def _projected_diameter(self, cam_from_body: Pose, camera: Camera) -> float:
        """Pixels that the spacecraft's diameter spans across the line of sight, at its range."""
        return float(camera.matrix[0, 0] * self.spacecraft.diameter_m / np.linalg.norm(cam_from_body.translation_m))

    def _better_crop(self, estimate: Estimate, camera: Camera, crop: Crop) -> Crop | None:
        """The crop about the keypoints found, when it overlaps little with the one they were found in."""
        if not self.looking.refine_crop or estimate.keypoints is None:
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
        return better if _square(better).iou(_square(crop)) < self.looking.refine_iou else None


def _square(crop: Crop) -> Box:
    return Box(crop.x0, crop.y0, crop.x0 + crop.side, crop.y0 + crop.side)


def _support(estimate: Estimate) -> float:
    """How much evidence a pose has: the scores of the keypoints that agree with it; -1 without a pose."""
    if estimate.keypoints is None or estimate.inliers is None:
        return -1.0
    return float(estimate.keypoints.score[estimate.inliers].sum())


def shipped_models() -> tuple[str, ...]:
    """Names that `load_estimator` knows without a path."""
    folder = resources.files("gknet") / "models"
    if not folder.is_dir():
        return ()
    return tuple(sorted(entry.name for entry in folder.iterdir() if (entry / "keypoints.onnx").is_file()))


def load_estimator(name_or_folder: str | Path, threads: int | None = None, device: str = "cpu") -> Estimator:
    """An estimator from a shipped model's name, or from a folder with keypoints.onnx and perhaps locator.onnx."""
    folder = Path(name_or_folder)
    if str(name_or_folder) in shipped_models():
        folder = Path(str(resources.files("gknet") / "models" / str(name_or_folder)))
    if not (folder / "keypoints.onnx").is_file():
        known = ", ".join(shipped_models()) or "none"
        raise GknetError(
            f"model '{name_or_folder}': expected a shipped model ({known}) or a folder with keypoints.onnx"
        )
    keypoint_network = OnnxNetwork(folder / "keypoints.onnx", threads, device)
    has_locator = (folder / "locator.onnx").is_file()
    locator = OnnxNetwork(folder / "locator.onnx", threads, device) if has_locator else None
    for network, kind in ((keypoint_network, "keypoints"), (locator, "locator")):
        if network is not None and network.metadata.kind != kind:
            raise GknetError(f"{network.path}: expected a network of kind '{kind}', got '{network.metadata.kind}'")
    return Estimator(
        keypoint_network,
        keypoint_network.spacecraft,
        locator,
        Looking(
            input_size=keypoint_network.metadata.input_size,
            locator_size=locator.metadata.input_size if locator else Looking.locator_size,
        ),
        Decoding(keypoint_network.metadata.floor_cells, keypoint_network.metadata.spread_scale),
        PnpSettings(covariance_scale=keypoint_network.metadata.pose_scale),
    )
