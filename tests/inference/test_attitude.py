"""Classes of attitude: labels and their mean are inverse, wrap where angles do, and put keypoints in their place."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.frame import Box
from gknet.geometry import Camera, Pose
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.crop_pose import smallest_rotation_to
from tests.strategies import quaternions

BINS = AttitudeBins(16)
HALF_TURN = Pose.from_quaternion([0, 0, 1, 0], np.zeros(3))
POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)


@given(quaternions())
def test_the_attitude_of_a_soft_label_is_its_own(quaternion: np.ndarray) -> None:
    """Everywhere: where an Euler angle wraps, at its poles, and near half turns."""
    label = BINS.soft_label(quaternion)
    assert label.shape == (BINS.count,)
    assert label.sum() == pytest.approx(1)
    assert label.min() >= 0
    found = BINS.attitude_wxyz(label)
    assert Pose.from_quaternion(found, np.zeros(3)).angle_to(Pose.from_quaternion(quaternion, np.zeros(3))) < 1e-3


@pytest.mark.parametrize(
    "angles", [(math.pi, 0.2, -0.4), (0.3, 0.1, math.pi), (0.7, math.pi / 2, 0.2), (1.0, -math.pi / 2, -2.0)]
)
def test_labels_wrap_where_angles_do(angles: tuple[float, float, float]) -> None:
    """A step across an end of an angle, or through a pole, changes a label as little as any other step."""
    at = Rotation.from_euler("ZYX", angles)
    step = Rotation.from_rotvec([0.004, -0.006, 0.005])
    quaternion = [(turn * at).as_quat()[[3, 0, 1, 2]] for turn in (step.inv(), step)]
    before, after = (BINS.soft_label(each) for each in quaternion)
    assert np.abs(before - after).sum() < 0.1
    np.testing.assert_allclose(BINS.soft_label(-quaternion[0]), before)


def test_a_label_is_a_gaussian_of_the_angle_over_the_volume_of_rotations() -> None:
    """Its spread about the attitude is LABEL_SIGMA_BINS bins in each direction, poles or not."""
    for middle in Rotation.random(20, rng=0):
        label = BINS.soft_label(middle.as_quat()[[3, 0, 1, 2]])
        centres = Rotation.from_quat(BINS.centres_wxyz[:, [1, 2, 3, 0]])
        off = (centres * middle.inv()).as_rotvec()
        spread = np.sqrt(np.linalg.eigvalsh(np.einsum("k,ki,kj->ij", label, off, off)))
        assert (np.abs(spread / (0.6 * 2 * np.pi / 16) - 1) < 0.25).all()


def test_of_two_counterparts_half_a_turn_apart_the_likelier_is_the_mean() -> None:
    one = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], np.zeros(3))
    counterpart = one @ HALF_TURN
    probability = 0.6 * BINS.soft_label(one.quaternion_wxyz) + 0.4 * BINS.soft_label(counterpart.quaternion_wxyz)
    assert Pose.from_quaternion(BINS.attitude_wxyz(probability), np.zeros(3)).angle_to(one) < math.radians(2)


def test_probability_near_an_attitude() -> None:
    one = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], np.zeros(3)).quaternion_wxyz
    counterpart = (Pose.from_quaternion(one, np.zeros(3)) @ HALF_TURN).quaternion_wxyz
    probability = 0.6 * BINS.soft_label(one) + 0.4 * BINS.soft_label(counterpart)
    for attitude, share in ((one, 0.6), (-one, 0.6), (counterpart, 0.4)):
        assert BINS.probability_near(probability, attitude, math.radians(60)) == pytest.approx(share, abs=0.01)
    everything = np.full(BINS.count, 1 / BINS.count)
    assert BINS.probability_near(everything, one, math.pi) == pytest.approx(1)
    assert BINS.probability_near(everything, one, math.radians(60)) < 0.15


@pytest.mark.parametrize("chosen", [0, 300, 777, 1500, 2047])
def test_an_attitude_puts_keypoints_where_a_camera_far_away_sees_them(chosen: int) -> None:
    """Anywhere in the image, in the crop about them."""
    camera = Camera.from_focal(40_000, 8000, 8000)
    place_m = np.array([30.0, -20.0, 400.0])
    attitude = Rotation.from_quat(BINS.centres_wxyz[chosen, [1, 2, 3, 0]]).as_matrix()
    pixels = camera.project(Pose(smallest_rotation_to(place_m) @ attitude, place_m).transform(POINTS))
    seen = Crop.around(Box.around(pixels), 256).to_input(pixels) / 256
    assert np.abs(BINS.expected_keypoints(POINTS)[chosen] - seen).max() < 0.01


@pytest.mark.parametrize("count", [2, 7])
def test_bins_that_do_not_pair_are_refused(count: int) -> None:
    with pytest.raises(GknetError, match="attitude bins"):
        AttitudeBins(count)
