"""What is trained: keypoints, a direct pose or the locator. A task draws samples, computes the loss and validates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gknet.frame import Frame
from gknet.inference.attitude import AttitudeBins
from gknet.network.dmanet import DMANet
from gknet.network.gknet import GKNet
from gknet.network.heatmap import SIGMA_CELLS, HeatmapNetwork, KeypointPrompts
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

FIRST_LOOK = 0.5
"""Weight of the loss on a first look."""

ATTITUDE = 0.5
"""Weight of the loss on a keypoint network's belief in the attitude."""

LOSSES = {"likelihood": likelihood_loss, "squared": heatmap_loss}


@runtime_checkable
class Task(Protocol):
    @property
    def draw(self) -> Draw: ...

    def loss(self, network: nn.Module, batch: Batch, device: torch.device) -> Float[Tensor, ""]: ...
    def validate(
        self, network: nn.Module, device: torch.device, frames: Sequence[Frame], rows: Sequence[int]
    ) -> Validation: ...


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
    """Maps against Gaussians, and a belief in the attitude's `bins`; `auxiliary` weighs each branch's own loss.

    A network that looks twice answers for its first look too, and is told some of the places before the second, so
    that it learns what neighbours tell of a keypoint; for those that it was told it does not answer.
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
            told = batch.told.to(device)
            branches = cast(GKNet, network).branches(image, KeypointPrompts(targets, told))
            loss = loss + FIRST_LOOK * measure(cast(Tensor, branches.first), targets, weight)
            weight = weight * ~told
        else:
            branches = keypoint_network.branches(image)
        loss = loss + measure(branches.fused, targets, weight)
        if self.auxiliary > 0 and branches.nodes is not None:
            parts = measure(branches.pixels, targets, weight) + measure(branches.nodes, targets, weight)
            loss = loss + self.auxiliary * parts
        if branches.attitude is not None and self.bins is not None:
            _, label, known = labelled(batch, self.bins, device)
            loss = loss + ATTITUDE * attitude_loss(branches.attitude, label, known)
        return loss

    def validate(
        self, network: nn.Module, device: torch.device, frames: Sequence[Frame], rows: Sequence[int]
    ) -> Validation:
        return validate_keypoints(cast(HeatmapNetwork, network), device, frames, rows, self.spacecraft, self.input_size)


@dataclass(frozen=True)
class DirectTask:
    """Offset, depth and attitude against the true pose as the crop shows it."""

    spacecraft: Spacecraft
    bins: AttitudeBins
    input_size: int
    draw: Draw = draw_keypoints

    def loss(self, network: nn.Module, batch: Batch, device: torch.device) -> Float[Tensor, ""]:
        branches = cast(DMANet, network).branches(batch.network_input(device))
        return direct_loss(branches, *labelled(batch, self.bins, device))

    def validate(
        self, network: nn.Module, device: torch.device, frames: Sequence[Frame], rows: Sequence[int]
    ) -> Validation:
        return validate_direct(network, device, frames, rows, self.spacecraft, self.bins, self.input_size)


@dataclass(frozen=True)
class LocatorTask:
    """The box's centre and sides in the whole picture."""

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
