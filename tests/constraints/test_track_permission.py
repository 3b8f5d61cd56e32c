"""TrackPermission: its rows against the model itself, and that the machine stands when it says so."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError

NOTHING_SEEN = sw.occlusion.Sensor("eye", range_m=0.01)
FAR_CARS = {"layout": {"cars": [[-9.0 - i, 0.0] for i in range(6)], "agent": [0.0, 1.0, 0.0]}}


def tracked(tolerance, sensor=NOTHING_SEEN, noise=0.1, start=0.1):
    cars = sw.occlusion.Track(
        "car*", acceleration_noise=noise, start_position_std=start, start_velocity_std=0.0
    )
    return sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), [cars], sensor, tolerance)


def stopping(tolerance):
    return sw.CBFActionFilter(tracked(tolerance), [sw.constraints.TrackPermission("robot", 3.0)])


def test_while_permissions_are_in_force_the_action_passes_bit_for_bit():
    env = stopping(tolerance=1e3)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(100):
        action = rng.uniform(-1, 1, 3).astype(np.float32)
        info = env.step(action)[4]
        assert not info["occlusion/expired"].any() and not info["cbf/intervened"]
        assert info["executed_action"].tobytes() == action.astype(np.float64).tobytes()


def test_when_they_expire_it_slows_down_as_declared_and_turns_as_it_likes():
    env = stopping(tolerance=0.45)
    env.reset(seed=0, options=FAR_CARS)
    speed, stopped_for, expired = 0.0, 0, False
    for k in range(110):
        info = env.step(np.array([0.3, 0.0 if k < 5 else -0.9, 1.0], np.float32))[4]
        now = float(np.linalg.norm(env.unwrapped.agent_velocity))
        assert not info["cbf/infeasible"] and not info["cbf/fallback"]
        if expired:
            # 3 m/s^2 over 0.04 s, up to what damping adds within the held step.
            assert now <= max(speed - 3.0 * 0.04, 0.0) + 0.02, (k, now, speed)
            assert info["executed_action"][2] == 1.0
            stopped_for += now <= 1e-3
        speed, expired = now, bool(info["occlusion/expired"].any())
    assert stopped_for > 10 and abs(env.unwrapped.data.qvel[2]) > 3.0


def test_only_the_tracks_that_count_stop_it():
    def env(tracks):
        unsure = sw.occlusion.Track("car0", acceleration_noise=1.0, start_position_std=2.0)
        sure = sw.occlusion.Track(
            "car[1-5]", acceleration_noise=0.0, start_position_std=0.01, start_velocity_std=0.0
        )
        inside = sw.OcclusionPenalty(
            gym.make("OccludedCrossing-v0"), [unsure, sure], NOTHING_SEEN, tolerance=0.5
        )
        return sw.CBFActionFilter(inside, [sw.constraints.TrackPermission("robot", 3.0, tracks=tracks)])

    for tracks, stops in ((["car1", "car4"], False), (["car0"], True), (None, True)):
        filtered = env(tracks)
        filtered.reset(seed=0)
        for _ in range(10):
            info = filtered.step(np.array([0.0, 1.0, 0.0]))[4]
        assert info["occlusion/expired"].tolist() == [True] + 5 * [False]
        assert info["cbf/intervened"] == stops


def test_what_it_is_given_is_checked():
    for words, given in (
        ("braking.*m/s", {"braking": 0.0}),
        ("list of names", {"braking": 1.0, "tracks": "car0"}),
        ("tracks is a list of names, or None for all", {"braking": 1.0, "tracks": []}),
    ):
        with pytest.raises(ConfigurationError, match=words):
            sw.constraints.TrackPermission("robot", **given)
    with pytest.raises(UnknownNameError, match="no track 'car9'; there are car0, car1"):
        sw.CBFActionFilter(tracked(1.0), [sw.constraints.TrackPermission("robot", 3.0, tracks=["car9"])])
    with pytest.raises(UnknownNameError, match="robo"):
        sw.CBFActionFilter(tracked(1.0), [sw.constraints.TrackPermission("robo", 3.0)])
    with pytest.raises(UnknownNameError, match="track_names"):
        sw.CBFActionFilter(gym.make("OccludedCrossing-v0"), [sw.constraints.TrackPermission("robot", 3.0)])
    plant = sw.AnalyticPlant(
        f=lambda x: x, g=lambda x: np.ones((3, 1)), state=lambda env: env.state, control_dt=0.05
    )
    with pytest.raises(UnsupportedEnvError, match="MujocoPlant"):
        sw.CBFActionFilter(
            gym.make("Pendulum-v1"), [sw.constraints.TrackPermission("robot", 3.0)], plant=plant
        )
