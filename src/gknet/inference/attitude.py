"""The attitude as one of many classes: soft labels, the attitude of a distribution, and where it puts keypoints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.inference.crop import CROP_MARGIN

LABEL_SIGMA_BINS = 0.6
"""Standard deviation of a soft label in bins. Less, and what lies between two bins is lost; more, and labels blur."""

CORRECTIONS = 4
"""Steps from the mean of the bins to the attitude whose label has that mean: 0.2 degrees in the mean, then 0.001."""


def rotation_of(wxyz: Float[ndarray, "*b 4"]) -> Rotation:
    """The rotation of a quaternion, scalar first."""
    return Rotation.from_quat(wxyz[..., [1, 2, 3, 0]])


def wxyz_of(rotation: Rotation) -> Float[ndarray, "4"]:
    """The unit quaternion of a rotation, scalar first, any sign."""
    return rotation.as_quat()[[3, 0, 1, 2]]


@dataclass(frozen=True)
class AttitudeBins:
    """Soft classes of attitude: the cells of a grid of Euler angles (z, y, x).

    y goes over half a turn, so there are per_turn^3 / 2 cells. A label weighs each cell by how near its centre is, as a
    rotation, and by its volume (cos y). Hence angles wrap, q and -q are one, and the poles, where a cell is narrow and
    z and x turn about one axis, need no special case: many small cells share what one would have.

    Attributes:
        per_turn: Cells to a full turn of an angle, even, 4 or more.
    """

    per_turn: int = 16

    def __post_init__(self) -> None:
        if self.per_turn < 4 or self.per_turn % 2:
            raise GknetError(f"attitude bins: expected an even number of 4 or more, got {self.per_turn}")

    @property
    def count(self) -> int:
        """The number of classes k."""
        return self.per_turn**3 // 2

    @cached_property
    def _angles_rad(self) -> Float[ndarray, "k 3"]:
        turn = (np.arange(self.per_turn) + 0.5) * 2 * np.pi / self.per_turn
        half = turn[: self.per_turn // 2] - np.pi / 2
        return np.stack(np.meshgrid(turn, half, turn, indexing="ij"), axis=-1).reshape(-1, 3)

    @cached_property
    def centres_wxyz(self) -> Float[ndarray, "k 4"]:
        """The attitude in the middle of each cell, as a unit quaternion, scalar first."""
        return Rotation.from_euler("ZYX", self._angles_rad).as_quat()[:, [3, 0, 1, 2]]

    @cached_property
    def _moments(self) -> Float[ndarray, "k 16"]:
        return (self.centres_wxyz[:, :, None] * self.centres_wxyz[:, None, :]).reshape(-1, 16)

    def soft_label(self, attitude_wxyz: Float[ndarray, "*b 4"]) -> Float[ndarray, "*b k"]:
        """The probability of each cell for a known attitude: volume times exp(2 (<q, q_cell>^2 - 1) / sigma^2).

        For a small angle a between the two that is a Gaussian, exp(-a^2 / (2 sigma^2)).

        Args:
            attitude_wxyz: (..., 4) unit quaternions, scalar first, any sign.

        Returns:
            (..., k), summing to 1.
        """
        sigma = LABEL_SIGMA_BINS * 2 * np.pi / self.per_turn
        nearness = 2 / sigma**2 * ((attitude_wxyz @ self.centres_wxyz.T) ** 2 - 1)
        label = np.cos(self._angles_rad[:, 1]) * np.exp(nearness)
        return label / label.sum(axis=-1, keepdims=True)

    def attitude_wxyz(self, probability: Float[ndarray, " k"]) -> Float[ndarray, "4"]:
        """The expected attitude; of a soft label, the attitude that it was made of.

        The mean of quaternions is the first eigenvector of sum p q q^T (Markley et al. 2007). Attitudes half a turn
        apart are orthogonal, so the less probable of two symmetric counterparts does not draw the mean away from the
        other.

        Args:
            probability: (k,) of each cell, summing to 1.

        Returns:
            (4,) unit quaternion, scalar first, any sign.
        """
        wanted = self._mean(probability)
        found = wanted
        for _ in range(CORRECTIONS):
            found = wanted * self._mean(self.soft_label(wxyz_of(found))).inv() * found
        return wxyz_of(found)

    def _mean(self, probability: Float[ndarray, " k"]) -> Rotation:
        return rotation_of(np.linalg.eigh((probability @ self._moments).reshape(4, 4))[1][:, -1])

    def probability_near(
        self, probability: Float[ndarray, " k"], attitude_wxyz: Float[ndarray, "4"], angle_rad: float
    ) -> float:
        """The probability of the cells whose centres are within an angle of an attitude.

        Args:
            probability: (k,) of each cell, summing to 1.
            attitude_wxyz: (4,) unit quaternion, scalar first, any sign.
            angle_rad: The angle in radians.

        Returns:
            0 to 1.
        """
        near = np.abs(self.centres_wxyz @ attitude_wxyz) >= np.cos(angle_rad / 2)
        return min(1.0, float(probability[near].sum()))  # probabilities may sum to a little more

    def expected_keypoints(self, points_m: Float[ndarray, "n 3"]) -> Float[ndarray, "k n 2"]:
        """Where each attitude puts each keypoint in a crop about the keypoints' box, under weak perspective.

        Args:
            points_m: (n, 3) in the body frame.

        Returns:
            (k, n, 2) in sides of the crop: x to the right, y down, 0 to 1.
        """
        rotated = np.einsum("kij,nj->kni", rotation_of(self.centres_wxyz).as_matrix()[:, :2], points_m)
        low, high = rotated.min(axis=1, keepdims=True), rotated.max(axis=1, keepdims=True)
        side = CROP_MARGIN * (high - low).max(axis=2, keepdims=True)
        return (rotated - (low + high) / 2) / side + 0.5
