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
"""Of the centre's map in the locator's loss: its cross-entropy, summed over the cells, would outweigh the box."""


def gaussian_targets(
    points_px: Float[Tensor, "b n 2"], stride: int, height: int, width: int, sigma_cells: float
) -> Float[Tensor, "b n height width"]:
    """Gaussians of peak 1 around sub-pixel centres; cell (i, j) is centred at stride * (j + 0.5, i + 0.5) px.

    Args:
        points_px: (b, n, 2) in pixels of the input.
        stride: Input pixels per cell.
        height: Of the maps, in cells.
        width: Of the maps, in cells.
        sigma_cells: Standard deviation.
    """
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

    The sum is about the energy of a Gaussian at any resolution, so that one learning rate fits all.

    Args:
        heatmaps: (b, n, h, w).
        targets: (b, n, h, w) of `gaussian_targets`.
        weight: (b, n) 1 where the keypoint counts, else 0.
    """
    error = (heatmaps.float() - targets).square().sum(dim=(2, 3))
    return (error * weight).sum() / weight.sum().clamp(min=1)


def likelihood_loss(
    maps: Float[Tensor, "b n h w"], targets: Float[Tensor, "b n h w"], weight: Float[Tensor, "b n"]
) -> Float[Tensor, ""]:
    """Kullback-Leibler divergence of each map's distribution over its cells from the target Gaussian.

    0 at best. Its gradient does not vanish on maps without a peak, as that of the squared error nearly does, and it
    punishes a distribution that excludes the true cell.

    Args:
        maps: (b, n, h, w), see `gknet.network.heatmap.log_probability`.
        targets: (b, n, h, w) of `gaussian_targets`.
        weight: (b, n) 1 where the keypoint counts, else 0.

    Returns:
        The mean over the keypoints that count.
    """
    target = targets.flatten(2)
    target = target / target.sum(dim=2, keepdim=True).clamp(min=TINY)
    divergence = (target * (target.clamp(min=TINY).log() - log_probability(maps))).sum(dim=2)
    return (divergence * weight).sum() / weight.sum().clamp(min=1)


def attitude_loss(
    attitude: Float[Tensor, "b k"], label: Float[Tensor, "b k"], weight: Float[Tensor, " b"]
) -> Float[Tensor, ""]:
    """Kullback-Leibler divergence of the attitude's classes from their soft label. 0 at best.

    Args:
        attitude: (b, k) logits.
        label: (b, k) of `AttitudeBins.soft_label`.
        weight: (b,) 1 where there is a pose, else 0.

    Returns:
        The mean over the samples with a pose.
    """
    divergence = (label * (label.clamp(min=TINY).log() - attitude.log_softmax(dim=1))).sum(dim=1)
    return (divergence * weight).sum() / weight.sum().clamp(min=1)


def direct_loss(
    branches: PoseBranches, pose: Float[Tensor, "b 7"], label: Float[Tensor, "b k"], weight: Float[Tensor, " b"]
) -> Float[Tensor, ""]:
    """Loss of direct pose regression: smooth L1 of offset and log depth, and `attitude_loss`. 0 at best.

    Args:
        branches: Of the network.
        pose: (b, 7) of `CropPose.vector`, finite.
        label: (b, k) of `AttitudeBins.soft_label`.
        weight: (b,) 1 where there is a pose, else 0.

    Returns:
        The mean over the samples with a pose.
    """
    offset = functional.smooth_l1_loss(branches.offset, pose[:, :2], beta=SMOOTH, reduction="none").sum(dim=1)
    depth = functional.smooth_l1_loss(branches.log_depth, pose[:, 2], beta=SMOOTH, reduction="none")
    position = OFFSET_WEIGHT * offset + DEPTH_WEIGHT * depth
    mean_position = (position * weight).sum() / weight.sum().clamp(min=1)
    return mean_position + attitude_loss(branches.attitude, label, weight)


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
    """Cross-entropy of the centre's map, smooth L1 and 1 - IoU of the box at the cells near the centre.

    Args:
        output: (b, 5, h, w), the centre's map and the distances to the box's sides, in sides of the input.
        corners_px: (b, 2, 2) upper left and lower right corner in pixels of the input.
        weight: (b, 2) 1 where the box is there, else 0.
        stride: Input pixels per cell.
        sigma_cells: Standard deviation of the centre's target.
    """
    height, width = output.shape[2:]
    size = torch.tensor([width * stride, height * stride], device=output.device, dtype=torch.float32)
    is_there = weight[:, 0]
    centre = corners_px.mean(dim=1, keepdim=True)
    target = gaussian_targets(centre, stride, height, width, sigma_cells)[:, 0] * is_there[:, None, None]
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
    return CENTRE_WEIGHT * centre_loss + (box_loss * is_there).sum() / is_there.sum().clamp(min=1)
