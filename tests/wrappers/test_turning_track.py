"""OcclusionPenalty with tracks that turn: a thing that drives a circle in a real world, seen and hidden."""

import json
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from occlusion_world import STILL, Turning, straight

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

RATE = 1.5  # rad/s
SPEED = 1.0  # m/s
WALLS = "".join(f'<geom type="box" pos="{x} 0 50" size="0.1 5 1"/>' for x in (1.5, -0.5))  # out of the way


class Circling(Turning):
    """`thing` drives a circle about (3, 0), `thing2` straight on."""

    def __init__(self):
        super().__init__(((0, 3, -SPEED / RATE, -1, 0), (0, SPEED, 0, 0, 0.1)), WALLS)

    def step(self, action):
        for _ in range(self.frame_skip):
            turn = RATE * self.data.time
            self.data.qvel[1:3] = SPEED * np.cos(turn), SPEED * np.sin(turn)
            mujoco.mj_step(self.model, self.data)
        return self.observed(), 1.0, False, False, {}


def tracked(turn_noise=0.01, **options):
    tracks = [
        straight(
            "thing",
            acceleration_noise=0.001,
            start_velocity_std=1.0,
            turn_noise=turn_noise,
            start_turn_std=1.0,
        ),
        straight("thing2"),
    ]
    sensor = sw.occlusion.Sensor(site="eye", position_std=0.02)
    return sw.OcclusionPenalty(Circling(), tracks, sensor, tolerance=0.5, **options)


def hidden(env):
    """From now on nothing is seen: the walls come down."""
    env.unwrapped.model.geom_pos[:2, 2] = 0.5


def test_the_turn_rate_is_found_and_carries_the_estimate_around_the_circle_unseen():
    ends = {}
    for turn_noise in (0.01, None):
        env = tracked(turn_noise)
        env.reset(seed=0)
        for _ in range(75):  # 3 s
            info = env.step(STILL)[4]
        assert info["occlusion/visible"].all()
        if turn_noise is not None:
            assert env.tracking.mean[:, 4] == pytest.approx([RATE, 0.0], abs=0.1)
        hidden(env)
        for _ in range(50):  # 2 s, 3 rad
            info = env.step(STILL)[4]
        assert not info["occlusion/visible"].any()
        off = env.tracking.positions - env.unwrapped.data.xpos[[2, 3], :2]
        ends[turn_noise] = np.hypot(*off.T), 3.0 * info["occlusion/sigma"]
    error, bound = ends[0.01]
    assert error[0] < bound[0] < 1.5 and error[1] < bound[1]
    error, bound = ends[None]
    assert (
        error[0] > 1.5 and error[0] > bound[0]
    )  # a straight track is where the thing would be without its turn


def test_what_the_sensor_cannot_tell_depends_on_whether_it_moves():
    env = tracked()
    assert env.unobservable == {"thing": ["turn rate"], "thing2": []}
    env.reset(seed=0)
    assert env.unobservable["thing"] == ["turn rate"]  # taken for standing still before it is seen to move
    for _ in range(25):
        env.step(STILL)
    assert env.unobservable == {"thing": [], "thing2": []}


def test_permissions_are_how_long_nothing_need_be_seen():
    env = tracked()
    env.reset(seed=0)
    for _ in range(50):
        env.step(STILL)
    told = env.permissions(horizon_s=20.0)
    hidden(env)
    lasted = np.zeros(2)
    for step in range(round(told.max() / 0.04) + 2 if np.isfinite(told).all() else 300):
        sigma = env.step(STILL)[4]["occlusion/sigma"]
        lasted = np.where((sigma <= 0.5 / 3.0) & (lasted >= step * 0.04 - 1e-9), (step + 1) * 0.04, lasted)
    for one, other in zip(told, lasted, strict=True):
        assert one == pytest.approx(other) if np.isfinite(one) else other >= 10.0


def test_the_observation_keeps_its_six_numbers():
    env = tracked()
    observation, _ = env.reset(seed=0)
    assert observation.shape == (1 + 12,)
    tracking = env.tracking
    np.testing.assert_array_equal(observation[3:5], tracking.velocities[0])
    np.testing.assert_allclose(observation[5:7], np.sqrt(np.diag(tracking.position_covariances[0])))


def test_it_is_plain_data_and_repeats_itself():
    spec = {"tracks": [t.data() for t in tracked().tracks]}
    again = sw.OcclusionPenalty(Circling(), json.loads(json.dumps(spec))["tracks"], {"site": "eye"}, 0.5)
    assert again.tracks == tracked().tracks
    envs = tracked(), pickle.loads(pickle.dumps(tracked()))
    for env in envs:
        env.reset(seed=3)
        for _ in range(10):
            env.step(STILL)
    np.testing.assert_array_equal(envs[0].tracking.covariance, envs[1].tracking.covariance)


def test_in_space_nothing_turns():
    with pytest.raises(ConfigurationError, match="in the plane"):
        tracked(axes="xyz")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"turn_noise": -1}, "turn_noise must be a finite number >= 0"),
        ({"turn_noise": np.inf}, "turn_noise must be a finite number >= 0"),
        ({"turn_noise": 1, "start_turn_std": -1}, "start_turn_std must be a finite number >= 0"),
        ({"start_turn_std": None}, "start_turn_std must be a number"),
    ],
)
def test_a_turn_that_cannot_be_is_refused(given, says):
    with pytest.raises(ConfigurationError, match=says):
        sw.occlusion.Track("thing", acceleration_noise=0.1, **given)


@pytest.mark.parametrize("turn_noise", [None, 0.05])
def test_the_crossing_s_filter_takes_tracks_that_turn(turn_noise):
    cars = sw.occlusion.Track(
        "car*", acceleration_noise=[0.0225, 0.0], start_position_std=[0.3, 0.0], turn_noise=turn_noise
    )
    env = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), [cars], "eye", tolerance=0.5)
    env = sw.protect(env)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        info = env.step(rng.uniform(-1, 1, 3).astype(env.action_space.dtype))[4]
        assert np.isfinite(info["executed_action"]).all() and np.isfinite(info["occlusion/sigma"]).all()
