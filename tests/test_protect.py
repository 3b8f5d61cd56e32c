"""protect: the recommended stack for known envs, and lines that work for the others."""

import textwrap

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError

KNOWN = {
    "SafePointGoal1-v0": sw.HeadingDriveClearance,
    "SafePointGoal2-v0": sw.HeadingDriveClearance,
    "InvertedPendulum-v5": sw.Clearance,
    "Reacher-v5": sw.JointSpeedLimit,
}


@pytest.mark.parametrize("env_id", KNOWN)
def test_known_envs_get_their_recipe(env_id):
    env = sw.protect(gym.make(env_id))
    assert isinstance(env, sw.CBFActionFilter)
    assert isinstance(env.constraints[0], KNOWN[env_id])
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[4]
    assert "cbf/intervened" in info


@pytest.mark.parametrize("version", ["v4", "v5"])
def test_the_version_does_not_matter(version):
    try:
        env = gym.make(f"Reacher-{version}")
    except Exception as missing:
        pytest.skip(f"this Gymnasium makes no Reacher-{version}: {missing}")
    assert isinstance(sw.protect(env).constraints[0], sw.JointSpeedLimit)


def test_a_namespace_does_not_matter():
    gym.register("lab/Reacher-v7", entry_point="gymnasium.envs.mujoco.reacher_v5:ReacherEnv")
    try:
        assert isinstance(sw.protect(gym.make("lab/Reacher-v7")).constraints[0], sw.JointSpeedLimit)
    finally:
        gym.registry.pop("lab/Reacher-v7")


def test_vases_are_obstacles_where_they_cost_and_only_there():
    at = {
        level: {
            o.attribute for o in sw.protect(gym.make(f"SafePointGoal{level}-v0")).constraints[0].obstacles
        }
        for level in (1, 2)
    }
    assert at == {1: {"hazard_positions"}, 2: {"hazard_positions", "vase_positions"}}


def test_hulls_are_as_large_as_the_geoms():
    from safe_wrappers.envs.levels import HAZARD_RADIUS, VASE_HALF_SIZE
    from safe_wrappers.envs.robot import POINT
    from safe_wrappers.recipes import POINT_HULL_RADIUS_M, VASE_HULL_RADIUS_M

    assert POINT.reach <= POINT_HULL_RADIUS_M < POINT.reach + 1e-3
    assert np.hypot(VASE_HALF_SIZE, VASE_HALF_SIZE) <= VASE_HULL_RADIUS_M < np.sqrt(2) * VASE_HALF_SIZE + 1e-3
    assert sw.protect(gym.make("SafePointGoal1-v0")).constraints[0].obstacles[0].radius == HAZARD_RADIUS


def test_options_reach_the_filter():
    narrow, wide = (sw.protect(gym.make("Reacher-v5"), margin=m) for m in (0.0, 0.5))
    assert wide.constraints[0].margin == pytest.approx(narrow.constraints[0].margin + 0.5)
    plant = sw.MujocoPlant()
    env = sw.protect(gym.make("Reacher-v5"), plant=plant, solver="clarabel", fallback="zero")
    assert env.plant is plant


@pytest.mark.parametrize("options", [{"fallbak": "zero"}, {"detour": True}, {"constraints": []}])
def test_unknown_options_are_refused_with_the_list(options):
    with pytest.raises(UnknownNameError, match=f"no option {next(iter(options))!r}.*fallback.*margin"):
        sw.protect(gym.make("Reacher-v5"), **options)


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Swimmer-v5"])
def test_an_unknown_env_is_refused_with_lines_that_work(env_id):
    env = gym.make(env_id)
    with pytest.raises(UnsupportedEnvError, match=rf"no recipe for '?{env_id}") as caught:
        sw.protect(env)
    message = str(caught.value)
    assert all(
        name in message for name in ("SafePointGoal1", "SafePointGoal2", "InvertedPendulum", "Reacher")
    )
    lines = textwrap.dedent("\n".join(message.splitlines()[1:]))
    assert len(lines.splitlines()) == 3
    scope = {"env": env}
    exec(lines, scope)
    assert isinstance(scope["env"], sw.CBFActionFilter)
    scope["env"].reset(seed=0)
    scope["env"].step(scope["env"].action_space.sample())


def test_an_env_without_a_spec_is_refused_and_not_a_crash():
    class Bare(gym.Env):
        action_space = gym.spaces.Box(-1, 1, (1,))
        observation_space = gym.spaces.Box(-1, 1, (1,))

    with pytest.raises(UnsupportedEnvError, match="no recipe for"):
        sw.protect(Bare())


def test_a_discrete_env_is_refused():
    with pytest.raises(ConfigurationError, match=r"no recipe for '?CartPole-v1"):
        sw.protect(gym.make("CartPole-v1"))


def test_protect_is_recorded_in_the_spec():
    env = sw.protect(gym.make("SafePointGoal1-v0"))
    again = gym.make(env.spec)
    assert isinstance(again, sw.CBFActionFilter) and again.constraints == env.constraints


@pytest.mark.parametrize("policy", [1.0, -1.0, "sway"])
def test_inverted_pendulum_stays_on_its_rail(policy):
    # The whole of what the rail has, whatever the pole does: it may fall, the cart must not hit the end.
    env = sw.protect(gym.make("InvertedPendulum-v5"))
    farthest = 0.0
    for seed in range(4):
        env.reset(seed=seed)
        for k in range(120):
            u = policy if policy != "sway" else float(np.sign(np.sin(0.15 * k + seed)))
            _, _, terminated, _, _ = env.step(np.array([3.0 * u], np.float32))
            farthest = max(farthest, abs(env.unwrapped.data.qpos[0]))
            if terminated:
                break
    assert farthest <= 0.95 + 1e-3


def test_reacher_stays_under_its_speed():
    env = sw.protect(gym.make("Reacher-v5"))
    fastest = 0.0
    for seed in range(3):
        env.reset(seed=seed)
        for k in range(150):
            env.step(np.sign([np.sin(0.2 * k), np.cos(0.13 * k)]).astype(np.float32))
            fastest = max(fastest, np.abs(env.unwrapped.data.qvel[:2]).max())
    assert 4.5 < fastest <= 5.0
