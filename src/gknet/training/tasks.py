"""What is trained: keypoints, a pose or the locator. A task draws samples, computes the loss and validates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gknet.frame import Frame
from gknet.inference.attitude import AttitudeBins
from gknet.network.direct_pose import DirectNetwork
from gknet.network.gknet import GKNet
from gknet.network.heatmap import SIGMA_CELLS, HeatmapBranches, HeatmapNetwork, KeypointPrompts
from gknet.spacecraft import Spacecraft
from gknet.training.batch import Batch, Draw, draw_box, draw_keypoints
from gknet.training.loss import (
    attitude_loss,
    direct_loss,
    gaussian_targets,
    heatmap_loss,
    likelihood_loss,
    locator_loss,
)
from gknet.training.validation import Validation, validate_direct, validate_keypoints, validate_locator

FIRST_PASS_WEIGHT = 0.5
"""Of the loss on the maps of a first pass."""

ATTITUDE_WEIGHT = 0.5
"""Of the loss on the attitude of a keypoint network."""

LOSSES = {"likelihood": likelihood_loss, "squared": heatmap_loss}


@runtime_checkable
class Task(Protocol):
    """What the loop needs to know about the kind of a network."""

    @property
    def draw(self) -> Draw:
        """Makes one sample from a row of the cache."""

    def loss(self, network: nn.Module, batch: Batch, device: torch.device) -> Float[Tensor, ""]:
        """The loss of one batch, with its graph."""

    def validate(
        self, network: nn.Module, device: torch.device, frames: Sequence[Frame], rows: Sequence[int]
    ) -> Validation:
        """The errors on `rows` of `frames`, with the deployed code."""


def labelled(
    batch: Batch, bins: AttitudeBins, device: torch.device
) -> tuple[Float[Tensor, "b 7"], Float[Tensor, "b k"], Float[Tensor, " b"]]:
    """Poses, soft labels of their attitudes, and 1 where there is a pose; 0 where there is none."""
    known = batch.pose.isfinite().all(dim=1)
    pose = torch.where(known[:, None], batch.pose, 0.0)
    label = torch.from_numpy(bins.soft_label(pose[:, 3:].numpy())).float()
    return pose.to(device), label.to(device), known.float().to(device)


@dataclass(frozen=True)
class KeypointTask:
    """Maps against Gaussians, and the attitude against its soft label.

    A two-pass network has a loss on its first pass too. Before the second pass it receives the true positions of some
    keypoints, so that it learns what the neighbours of a known keypoint can conclude; these keypoints have no loss in
    the second pass.

    Attributes:
        spacecraft: With its keypoints.
        input_size: Side of the crops to validate on, in pixels.
        auxiliary: Weight of the loss on the maps of each branch.
        bins: Of the network's attitude; None without one.
        draw: See `Task`.
    """

    spacecraft: Spacecraft
    input_size: int
    auxiliary: float
    bins: AttitudeBins | None = None
    draw: Draw = draw_keypoints

    def loss(self, network: nn.Module, batch: Batch, device: torch.device) -> Float[Tensor, ""]:
        keypoint_network = cast(HeatmapNetwork, network)
        measure = LOSSES[keypoint_network.loss]
        image = batch.network_input(device)
        height, width = (length // keypoint_network.stride for length in image.shape[2:])
        points, weight = batch.points_px.to(device), batch.weight.to(device)
        targets = gaussian_targets(points, keypoint_network.stride, height, width, SIGMA_CELLS)
        loss = torch.zeros((), device=device)
        if keypoint_network.two_pass:
            prompted = batch.prompted.to(device)
            branches = cast(GKNet, network).branches(image, KeypointPrompts(targets, prompted))
            loss = loss + FIRST_PASS_WEIGHT * measure(cast(Tensor, branches.first_pass), targets, weight)
            weight = weight * ~prompted
        else:
            branches = keypoint_network.branches(image)
        loss = loss + measure(branches.fused, targets, weight)
        if self.auxiliary > 0 and branches.nodes is not None:
            parts = measure(branches.pixels, targets, weight) + measure(branches.nodes, targets, weight)
            loss = loss + self.auxiliary * parts
        return loss + self._attitude_loss(branches, batch, device)

    def _attitude_loss(
        self, branches: HeatmapBranches, batch: Batch, device: torch.device
    ) -> Float[Tensor, ""] | float:
        if branches.attitude is None or self.bins is None:
            return 0.0
        _, label, known = labelled(batch, self.bins, device)
        return ATTITUDE_WEIGHT * attitude_loss(branches.attitude, label, known)

    def validate(
        self, network: nn.Module, device: torch.device, frames: Sequence[Frame], rows: Sequence[int]
    ) -> Validation:
        return validate_keypoints(cast(HeatmapNetwork, network), device, frames, rows, self.spacecraft, self.input_size)


@dataclass(frozen=True)
class DirectTask:
    """Offset, depth and attitude against the true pose relative to the crop.

    Attributes:
        spacecraft: With its keypoints.
        bins: Of the network's attitude.
        input_size: Side of the crops to validate on, in pixels.
        draw: See `Task`.
    """

    spacecraft: Spacecraft
    bins: AttitudeBins
    input_size: int
    draw: Draw = draw_keypoints

    def loss(self, network: nn.Module, batch: Batch, device: torch.device) -> Float[Tensor, ""]:
        branches = cast(DirectNetwork, network).branches(batch.network_input(device))
        return direct_loss(branches, *labelled(batch, self.bins, device))

    def validate(
        self, network: nn.Module, device: torch.device, frames: Sequence[Frame], rows: Sequence[int]
    ) -> Validation:
        return validate_direct(network, device, frames, rows, self.spacecraft, self.bins, self.input_size)


@dataclass(frozen=True)
class LocatorTask:
    """The box's centre and sides in the whole image.

    Attributes:
        spacecraft: With its keypoints, whose box is sought.
        stride: Of the network.
        input_size: Side of the images to validate on, in pixels.
        draw: See `Task`.
    """

    spacecraft: Spacecraft
    stride: int
    input_size: int
    draw: Draw = draw_box

    def loss(self, network: nn.Module, batch: Batch, device: torch.device) -> Float[Tensor, ""]:
        output = network(batch.network_input(device))
        corners, weight = batch.points_px.to(device), batch.weight.to(device)
        return locator_loss(output, corners, weight, self.stride, SIGMA_CELLS)

    def validate(
        self, network: nn.Module, device: torch.device, frames: Sequence[Frame], rows: Sequence[int]
    ) -> Validation:
        return validate_locator(network, device, frames, rows, self.spacecraft, self.input_size)
