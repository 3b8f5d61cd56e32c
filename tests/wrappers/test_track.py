"""Track: what it takes, what it makes of it, what it refuses, and that it is plain data."""

import json

import numpy as np
import pytest

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.occlusion import Track, track_from


def test_a_number_holds_for_every_coordinate_a_list_is_one_each_a_matrix_is_itself():
    for given, expected in (
        (0.3, [[0.3, 0], [0, 0.3]]),
        ([0.3, 0.0], [[0.3, 0], [0, 0]]),
        ([[0.3, 0.1], [0.1, 0.4]], [[0.3, 0.1], [0.1, 0.4]]),
    ):
        motion = Track("car*", acceleration_noise=given).motion(2)
        np.testing.assert_array_equal(motion.intensity, expected)
    assert motion.reversion_s == np.inf and (motion.mean_velocity == 0.0).all()
    motion = Track("a", acceleration_noise=0, reversion_s=2, mean_velocity=(1, -1, 0.5)).motion(3)
    assert motion.reversion_s == 2.0 and motion.mean_velocity.tolist() == [1.0, -1.0, 0.5]


def test_the_start_is_a_number_or_one_per_coordinate():
    track = Track("a", acceleration_noise=0, start_position_std=[0.1, 0.0], start_velocity_std=0.7)
    assert track.start(2, 4).tolist() == [0.1, 0.0, 0.7, 0.7]
    assert track.start(2, 5).tolist() == [0.1, 0.0, 0.7, 0.7, 0.0]  # beside one that turns
    turning = Track("a", acceleration_noise=0, turn_noise=0.1, start_turn_std=0.2)
    assert turning.start(2, 5).tolist() == [0.1, 0.1, 0.5, 0.5, 0.2]
    assert turning.motion(2).turn_noise == 0.1 and track.motion(2).turn_noise is None


@pytest.mark.parametrize(
    "given",
    [
        {"acceleration_noise": np.float32(0.5)},
        {"acceleration_noise": np.array([0.5, 0.25])},
        {"acceleration_noise": (np.float32(0.5), 0)},
        {"acceleration_noise": ((0.5, 0), (0, 0.25))},
        {"acceleration_noise": 1, "mean_velocity": np.ones(2), "start_position_std": np.float32(0.25)},
        {"acceleration_noise": 1, "reversion_s": np.float64(3), "start_velocity_std": (0.5, 1)},
    ],
)
def test_it_is_plain_data(given):
    track = Track(bodies="car*", **given)
    again = track_from(json.loads(json.dumps(track.data())))
    assert again == track and track_from(track) is track
    np.testing.assert_array_equal(again.motion(2).intensity, Track("x", **given).motion(2).intensity)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "by name or pattern"),
        ({"bodies": "a", "published": "b"}, "got bodies='a', published='b'"),
        ({"bodies": "a"}, "acceleration_noise.*m\\^2/s\\^3"),
        ({"bodies": 5, "acceleration_noise": 1}, "names, got 5"),
        ({"published": ["a"], "acceleration_noise": 1}, r"names, got \['a'\]"),
        ({"bodies": "a", "acceleration_noise": 1, "reversion_s": 0}, "reversion_s.*> 0 in s, got 0"),
        ({"bodies": "a", "acceleration_noise": 1, "reversion_s": np.nan}, "reversion_s"),
    ],
)
def test_what_is_wrong_by_itself_is_refused_at_once(given, words):
    with pytest.raises(ConfigurationError, match=words):
        Track(**given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"acceleration_noise": -1}, "acceleration_noise.*>= 0"),
        ({"acceleration_noise": [1, 2, 3]}, "a number or 2 numbers"),
        ({"acceleration_noise": np.nan}, "finite"),
        ({"acceleration_noise": "much"}, "a number or 2 numbers.*'much'"),
        ({"acceleration_noise": [[1, 0.5], [0, 1]]}, "acceleration_noise must be symmetric"),
        ({"acceleration_noise": [[1, 2], [2, 1]]}, "positive semidefinite.*-1"),
        ({"acceleration_noise": np.eye(3)}, "acceleration_noise"),
        ({"acceleration_noise": [[1, 2], [3]]}, "acceleration_noise"),
        ({"acceleration_noise": 1, "mean_velocity": [1, 2, 3]}, "mean_velocity is a number or 2"),
        ({"acceleration_noise": 1, "mean_velocity": np.inf}, "mean_velocity must be finite"),
        ({"acceleration_noise": 1, "start_position_std": -0.1}, "start_position_std.*>= 0"),
        ({"acceleration_noise": 1, "start_velocity_std": [1, -1]}, "start_velocity_std.*>= 0"),
        ({"acceleration_noise": 1, "start_velocity_std": [1, None]}, "start_velocity_std"),
    ],
)
def test_what_does_not_fit_the_coordinates_is_refused_by_name(given, words):
    track = Track("car*", **given)
    with pytest.raises(ConfigurationError, match=words):
        track.motion(2)
        track.start(2, 4)


def test_a_name_alone_says_what_is_missing_and_an_unknown_key_what_there_is():
    with pytest.raises(
        ConfigurationError, match=r"sw.occlusion.Track\('car\*', acceleration_noise=0.1\).*got 'car\*'"
    ):
        track_from("car*")
    with pytest.raises(ConfigurationError, match="no 'noise'; it has bodies, published, acceleration_noise"):
        track_from({"bodies": "a", "noise": 1})
