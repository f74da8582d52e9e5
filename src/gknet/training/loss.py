"""Targets and losses, pure functions of tensors."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from gknet.network.direct_pose import PoseBranches
from gknet.network.heatmap import log_probability

TINY = 1e-12

OFFSET_WEIGHT, DEPTH_WEIGHT = 10.0, 5.0
"""Of the offset and the depth in a direct network's loss: at the start they count about as much as the attitude."""
SMOOTH = 0.02
"""Where the smooth L1 of offset (sides of the crop) and log_depth turns from square to linear."""

CENTRE_WEIGHT = 0.1
"""Of the centre's map in the locator's loss. Its cross-entropy, summed over the cells, would drown the box's part."""


def gaussian_targets(
    points_px: Float[Tensor, "b n 2"], stride: int, height: int, width: int, sigma_cells: float
) -> Float[Tensor, "b n height width"]:
    """Gaussians of peak 1 about sub-pixel centres; cell (i, j) is centred at stride * (j + 0.5, i + 0.5) input px."""
    x = (torch.arange(width, device=points_px.device) + 0.5) * stride
    y = (torch.arange(height, device=points_px.device) + 0.5) * stride
    scale = 1 / (2 * (sigma_cells * stride) ** 2)
    along_x = torch.exp(-scale * (points_px[..., 0:1] - x) ** 2)  # (b, n, width)
    along_y = torch.exp(-scale * (points_px[..., 1:2] - y) ** 2)  # (b, n, height)
    return along_y[..., :, None] * along_x[..., None, :]


def heatmap_loss(
    heatmaps: Float[Tensor, "b n h w"], targets: Float[Tensor, "b n h w"], weight: Float[Tensor, "b n"]
) -> Float[Tensor, ""]:
    """Squared error summed over the map and averaged over the keypoints in view: eq. 4 times W H.

    The sum makes the loss about the energy of a Gaussian, whatever the resolution, so one learning rate fits all.
    """
    error = (heatmaps.float() - targets).square().sum(dim=(2, 3))
    return (error * weight).sum() / weight.sum().clamp(min=1)


def likelihood_loss(
    maps: Float[Tensor, "b n h w"], targets: Float[Tensor, "b n h w"], weight: Float[Tensor, "b n"]
) -> Float[Tensor, ""]:
    """Divergence of the believed cells from the target Gaussian, averaged over the keypoints in view.

    0 at best. Unlike the squared error it is not nearly flat about maps without any peak, and it charges a belief
    for what it excludes.
    """
    wanted = targets.flatten(2)
    wanted = wanted / wanted.sum(dim=2, keepdim=True).clamp(min=TINY)
    divergence = (wanted * (wanted.clamp(min=TINY).log() - log_probability(maps))).sum(dim=2)
    return (divergence * weight).sum() / weight.sum().clamp(min=1)


def attitude_loss(
    attitude: Float[Tensor, "b k"], label: Float[Tensor, "b k"], weight: Float[Tensor, " b"]
) -> Float[Tensor, ""]:
    """Divergence of the belief in the attitude's classes from the soft label, averaged where `weight` is 1. 0 at best.

    attitude: logits; label: `AttitudeBins.soft_label`
    """
    divergence = (label * (label.clamp(min=TINY).log() - attitude.log_softmax(dim=1))).sum(dim=1)
    return (divergence * weight).sum() / weight.sum().clamp(min=1)


def direct_loss(
    branches: PoseBranches, pose: Float[Tensor, "b 7"], label: Float[Tensor, "b k"], weight: Float[Tensor, " b"]
) -> Float[Tensor, ""]:
    """Smooth L1 of the offset and of log_depth, and the divergence of the attitude's belief from its soft label.

    0 at best. pose: `CropPose.vector`, finite; label: `AttitudeBins.soft_label`; weight: 0 where there is no pose.
    """
    offset = functional.smooth_l1_loss(branches.offset, pose[:, :2], beta=SMOOTH, reduction="none").sum(dim=1)
    depth = functional.smooth_l1_loss(branches.log_depth, pose[:, 2], beta=SMOOTH, reduction="none")
    place = OFFSET_WEIGHT * offset + DEPTH_WEIGHT * depth
    placed = (place * weight).sum() / weight.sum().clamp(min=1)
    return placed + attitude_loss(branches.attitude, label, weight)


def box_iou(first: Float[Tensor, "*b 4"], second: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b"]:
    """Intersection over union of boxes x0, y0, x1, y1."""
    low = torch.maximum(first[..., :2], second[..., :2])
    high = torch.minimum(first[..., 2:], second[..., 2:])
    shared = (high - low).clamp(min=0).prod(dim=-1)
    areas = [(box[..., 2:] - box[..., :2]).clamp(min=0).prod(dim=-1) for box in (first, second)]
    return shared / (areas[0] + areas[1] - shared).clamp(min=1e-9)


def locator_loss(
    output: Float[Tensor, "b 5 h w"],
    corners_px: Float[Tensor, "b 2 2"],
    weight: Float[Tensor, "b 2"],
    stride: int,
    sigma_cells: float,
) -> Float[Tensor, ""]:
    """Cross-entropy of the centre's map, smooth L1 and 1 - IoU of the box at the cells near the centre."""
    height, width = output.shape[2:]
    size = torch.tensor([width * stride, height * stride], device=output.device, dtype=torch.float32)
    seen = weight[:, 0]
    centre = corners_px.mean(dim=1, keepdim=True)
    target = gaussian_targets(centre, stride, height, width, sigma_cells)[:, 0] * seen[:, None, None]
    heat = output[:, 0].float().clamp(1e-5, 1 - 1e-5)
    centre_loss = functional.binary_cross_entropy(heat, target, reduction="none").sum(dim=(1, 2)).mean()
    x = (torch.arange(width, device=output.device) + 0.5) / width
    y = (torch.arange(height, device=output.device) + 0.5) / height
    cell = torch.stack([x.expand(height, -1), y[:, None].expand(-1, width)])  # (2, h, w) in units of the input
    low, high = (corners_px[:, k] / size for k in (0, 1))  # (b, 2)
    true = torch.cat([cell - low[:, :, None, None], high[:, :, None, None] - cell], dim=1).clamp(min=0)
    distance = output[:, 1:].float()
    near = target * (target > 0.2)
    share = near / near.sum(dim=(1, 2), keepdim=True).clamp(min=1e-6)
    l1 = functional.smooth_l1_loss(distance, true, beta=0.02, reduction="none").sum(dim=1)
    boxes = [torch.cat([-d[:, :2], d[:, 2:]], dim=1).movedim(1, -1) for d in (distance, true)]
    overlap = 1 - box_iou(boxes[0], boxes[1])
    box_loss = ((10 * l1 + 2 * overlap) * share).sum(dim=(1, 2))
    return CENTRE_WEIGHT * centre_loss + (box_loss * seen).sum() / seen.sum().clamp(min=1)
