"""Compositions in which a filter would be wrong without saying so; each is refused, with the remedy."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError


def speed(limit=2.0):
    return sw.constraints.JointSpeedLimit(limit)


def test_one_plant_for_two_envs():
    plant = sw.MujocoPlant()
    sw.CBFActionFilter(gym.make("Reacher-v5"), [speed()], plant=plant)
    with pytest.raises(ConfigurationError, match=r"bound to another env already; give every filter a plant"):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [speed()], plant=plant)


def test_one_analytic_plant_in_a_vector_env():
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 15.0 * np.sin(x[0])]),
        g=lambda x: np.array([[0.0], [3.0]]),
        state=lambda env: env.state,
        control_dt=0.05,
    )
    barrier = sw.constraints.Barrier(lambda x: 16.0 - x[1] ** 2)
    with pytest.raises(ConfigurationError, match="bound to another env"):
        gym.vector.SyncVectorEnv(
            [lambda: sw.CBFActionFilter(gym.make("Pendulum-v1"), [barrier], plant=plant)] * 2
        )


def test_a_filter_on_a_filtered_env():
    inner = sw.CBFActionFilter(gym.make("Reacher-v5"), [speed(1.0)])
    with pytest.raises(ConfigurationError, match=r"filtered already; .* pass all of them to one filter"):
        sw.CBFActionFilter(gym.wrappers.TimeLimit(inner, 10), [speed(2.0)])
    with pytest.raises(ConfigurationError, match="filtered already"):
        sw.protect(sw.protect(gym.make("Reacher-v5")))


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: gym.wrappers.StickyAction(env, 0.5),
        lambda env: gym.wrappers.MaxAndSkipObservation(env, skip=4),
        lambda env: gym.wrappers.TransformAction(env, lambda a: -a, env.action_space),
    ],
)
def test_wrappers_inside_that_change_or_repeat_the_action(wrap):
    with pytest.raises(ConfigurationError, match=r"inside the filter changes the actions .* put it outside"):
        sw.CBFActionFilter(wrap(gym.make("Reacher-v5")), [speed()])
    wrap(sw.CBFActionFilter(gym.make("Reacher-v5"), [speed()]))  # outside is fine


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda e: sw.CBFActionFilter(e, [sw.constraints.JointSpeedLimit]),
            ConfigurationError,
            "expected a constraint",
        ),
        (
            lambda e: sw.CBFActionFilter(e, [speed()], plant=sw.MujocoPlant),
            ConfigurationError,
            "plant is a MujocoPlant",
        ),
        (
            lambda e: sw.CBFActionFilter(e, [{"kind": "JointSpeedLimit", "limti": 2.0}]),
            UnknownNameError,
            "JointSpeedLimit has no 'limti'; it has limit, joints, margin",
        ),
        (
            lambda e: sw.protect("Reacher-v5"),
            UnsupportedEnvError,
            r"write protect\(gym.make\('Reacher-v5'\)\)",
        ),
        (lambda e: sw.protect(e, magrin=1.0), UnknownNameError, "protect has no option 'magrin'"),
        (
            lambda e: sw.CBFActionFilter(
                e, [sw.constraints.Clearance([sw.constraints.Plane([0], [1])], 1.0, geoms=["arm"])]
            ),
            UnknownNameError,
            "no geom 'arm'; it has: .*link0",
        ),
        (lambda e: sw.AnalyticPlant(f=None, g=len, state=len), ConfigurationError, "f must be a function"),
        (
            lambda e: sw.AnalyticPlant(f=len, g=len, state=len, control_dt="a"),
            ConfigurationError,
            "control_dt must be a number in s, got 'a'",
        ),
    ],
)
def test_what_is_not_what_it_should_be(make, error, message):
    with pytest.raises(error, match=message):
        make(gym.make("Reacher-v5"))


def test_a_geom_is_kept_clear():
    limit = sw.constraints.Clearance([sw.constraints.Plane([-5.0], [1.0])], 1.0, geoms=["fingertip"])
    filtered = sw.CBFActionFilter(gym.make("Reacher-v5"), [limit])
    _, info = filtered.reset(seed=0)
    fingertip = filtered.unwrapped.data.geom("fingertip").xpos
    assert info["cbf/margin"] == pytest.approx(5.0 + fingertip[0], abs=1e-6)


def on_wheels(env):
    return sw.SlipLimiter(env, wheels=["front_left", "rear_right"])


def lease(env):
    return sw.LeaseExpiry(env, sw.StoppingBudget(lambda env: (9.0, 0.0), braking=1.0, acceleration=1.0))


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda env: on_wheels(on_wheels(env)), "filtered already"),
        (lambda env: on_wheels(sw.protect(env)), "filtered already"),
        (lambda env: sw.CBFActionFilter(on_wheels(env), [speed()]), "filtered already"),
        (lambda env: on_wheels(sw.ChunkHandover(env, 4, 2)), "ChunkHandover inside SlipLimiter"),
        (lambda env: on_wheels(lease(env)), "LeaseExpiry inside SlipLimiter"),
        (lambda env: on_wheels(sw.RecordInterventions(env)), "RecordInterventions inside SlipLimiter"),
        (lambda env: on_wheels(gym.wrappers.StickyAction(env, 0.5)), "inside the filter"),
    ],
)
def test_a_slip_limiter_has_the_last_word(wrap, message):
    with pytest.raises(ConfigurationError, match=message):
        wrap(gym.make("SafeRover-v0"))


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: sw.ChunkHandover(sw.RecordInterventions(lease(on_wheels(env))), 4, 2),
        lambda env: sw.RecordInterventions(on_wheels(env)),
        lambda env: sw.RecordInterventions(on_wheels(sw.ContactMonitor(env))),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_where_a_slip_limiter_fits(wrap):
    env = wrap(gym.make("SafeRover-v0"))
    env.reset(seed=0, options={"layout": {"ground": "ice", "patches": []}})
    for _ in range(20):
        info = env.step(
            np.broadcast_to([1.0, 1.0, 1.0, 1.0, 0.0], env.action_space.shape).astype(np.float32)
        )[4]
    assert info["slip/limited"].all() and (np.abs(info["slip/ratio"]) < 0.15).all()
