"""Sensor: what it takes, what it makes of it, what it refuses, and that it is plain data."""

import json

import numpy as np
import pytest

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.occlusion import Sensor, sensor_from


def test_what_is_measured_and_how_well():
    matrix, noise = Sensor("eye").matrices(2)
    np.testing.assert_array_equal(matrix, np.eye(2, 4))
    np.testing.assert_allclose(noise, 0.05**2 * np.eye(2))
    matrix, noise = Sensor("eye", position_std=None, velocity_std=0.3).matrices(3)
    np.testing.assert_array_equal(matrix, np.eye(6)[3:])
    np.testing.assert_allclose(noise, 0.09 * np.eye(3))
    covariance = [[0.04, 0.01], [0.01, 0.09]]
    matrix, noise = Sensor(site="eye", position_std=covariance, velocity_std=0.1).matrices(2)
    np.testing.assert_array_equal(matrix, np.eye(4))
    np.testing.assert_allclose(noise[:2, :2], covariance)
    np.testing.assert_allclose(noise[2:, 2:], 0.01 * np.eye(2))
    assert not noise[:2, 2:].any() and not noise[2:, :2].any()


@pytest.mark.parametrize(
    "given",
    [
        {"position_std": np.float32(0.5)},
        {"position_std": ((0.25, 0), (0, 0.5))},
        {"velocity_std": np.eye(2), "lever_arm": np.bool_(False)},
        {"occluder_groups": np.arange(2), "view_deg": np.float64(90), "range_m": np.float32(4)},
        {"occluder_groups": (0, 5), "dropout": np.float32(0.25)},
    ],
)
def test_it_is_plain_data(given):
    sensor = Sensor(camera="eye", **given)
    again = sensor_from(json.loads(json.dumps(sensor.data())))
    assert again == sensor and sensor_from(sensor) is sensor
    for mine, theirs in zip(again.matrices(2), sensor.matrices(2), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_name_alone_is_a_camera():
    assert sensor_from("eye") == Sensor(camera="eye")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "camera or at a site"),
        ({"camera": "a", "site": "b"}, "got camera='a', site='b'"),
        ({"camera": 3}, "camera is a name, got 3"),
        ({"site": ["eye"]}, "site is a name"),
        ({"view_deg": 0}, "view_deg.*> 0 in degrees, got 0"),
        ({"view_deg": "wide"}, "view_deg"),
        ({"range_m": -1}, "range_m.*> 0 in m"),
        ({"range_m": np.inf}, "range_m"),
        ({"occluder_groups": 1}, "list of geom groups, 0 to 5.*got 1"),
        ({"occluder_groups": []}, "list of geom groups"),
        ({"occluder_groups": [6]}, "list of geom groups"),
        ({"occluder_groups": [-1]}, "list of geom groups"),
        ({"occluder_groups": [0.5]}, "list of geom groups"),
        ({"occluder_groups": "01"}, "list of geom groups"),
        ({"position_std": None}, "measures nothing"),
        ({"dropout": 1.0}, "below 1"),
        ({"dropout": -0.1}, "dropout"),
        ({"dropout": np.nan}, "dropout"),
        ({"lever_arm": "yes"}, "lever_arm is True or False, got 'yes'"),
        ({"lever_arm": None}, "lever_arm"),
    ],
)
def test_what_is_wrong_by_itself_is_refused_at_once(given, words):
    if given and not {"camera", "site"} & set(given):
        given = {"camera": "eye"} | given
    with pytest.raises(ConfigurationError, match=words):
        Sensor(**given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"position_std": 0.0}, "position_std.*> 0"),
        ({"position_std": -1.0}, "position_std.*> 0"),
        ({"position_std": "good"}, "position_std"),
        ({"position_std": [0.1, 0.2]}, "position_std as a covariance.*square"),
        ({"position_std": [[1, 0], [0, 0]]}, "position_std as a covariance.*positive definite"),
        ({"position_std": [[1, 1], [1, 1]]}, "positive definite"),
        ({"position_std": [[1, 0.5], [0, 1]]}, "symmetric"),
        ({"position_std": [[1, 2], [3]]}, "position_std as a covariance"),
        ({"position_std": np.eye(3)}, "position_std as a covariance"),
        ({"velocity_std": [[1, 2], [2, 1]]}, "velocity_std as a covariance.*-1"),
        ({"velocity_std": np.nan}, "velocity_std"),
    ],
)
def test_noise_that_is_none_is_refused_by_name(given, words):
    with pytest.raises(ConfigurationError, match=words):
        Sensor("eye", **given).matrices(2)


def test_what_is_no_sensor_and_an_unknown_key_are_refused():
    with pytest.raises(ConfigurationError, match=r"Sensor\(...\), or the name of a camera.*got 3"):
        sensor_from(3)
    with pytest.raises(ConfigurationError, match="no 'fov'; it has camera, site, view_deg"):
        sensor_from({"camera": "eye", "fov": 90})
