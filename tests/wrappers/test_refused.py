"""Which constraint refused, what fails least where all fail, and what counts as an intervention."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")

LIMITS = {
    "Reacher-v5": [
        sw.constraints.JointSpeedLimit(6.0),
        sw.constraints.JointPositionLimit(-1.5, 1.5, ["joint0"], horizon=6),
        sw.constraints.Workspace(
            keep_out=[sw.constraints.Disc([0.0, 0.15], 0.06)], bodies=["fingertip"], horizon=6
        ),
        sw.constraints.SpeedLimit(0.8, "fingertip", horizon=2),
        sw.constraints.JointPositionLimit(-2.0, 2.0, ["joint1"], horizon=6),
    ],
    "HalfCheetah-v5": [
        sw.constraints.SpeedLimit(0.5, "torso", "+x"),
        sw.constraints.Workspace(low=[None, None, 0.5], bodies=["torso"], horizon=3),
        sw.constraints.JointSpeedLimit(12.0),
    ],
}


def made(env_id, limits, **options):
    return sw.CBFActionFilter(gym.make(env_id, disable_env_checker=True), limits, **options)


def bang_bang(env, k, rng):
    bits = np.random.default_rng(k // 6).random(env.action_space.shape) < 0.5
    return (env.action_space.high * np.where(bits, -1.0, 1.0)).astype(np.float32)


# Which refuse -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", LIMITS)
def test_refused_names_exactly_those_that_refuse_alone(env_id):
    # Each constraint has an env and a filter of its own, which is put into the same state before every step.
    together = made(env_id, LIMITS[env_id])
    alone = [made(env_id, [limit]) for limit in LIMITS[env_id]]
    for env in (together, *alone):
        env.reset(seed=1)
    rng, seen = np.random.default_rng(0), np.zeros(len(alone), dtype=int)
    several = 0
    for k in range(60):
        action = bang_bang(together, k, rng) if k % 3 else np.zeros(together.action_space.shape, np.float32)
        refused = []
        for env in alone:
            mujoco.mj_copyData(env.unwrapped.data, together.unwrapped.model, together.unwrapped.data)
            refused.append(bool(env.step(action)[4]["cbf/refused"][0]))
        info = together.step(action)[4]
        assert info["cbf/refused"].dtype == np.bool_
        assert info["cbf/refused"].tolist() == refused
        assert info["cbf/refused"].any() == (info["cbf/intervened"] or info["cbf/infeasible"])
        seen += refused
        several += sum(refused) > 1
    assert (seen > 0).sum() >= 3 and several > 0, seen


# Where all fail -----------------------------------------------------------------------------------------------


def stuck(fallback="brake", **options):
    """Two demands that no control meets: the tip is to be left of one line and right of another."""
    limits = [
        sw.constraints.Workspace(high=[0.0, None, None], bodies=["fingertip"], horizon=4),
        sw.constraints.Workspace(low=[0.1, None, None], bodies=["fingertip"], horizon=4),
        sw.constraints.JointSpeedLimit(3.0),
    ]
    return made("Reacher-v5", limits, fallback=fallback, **options)


def too_fast():
    """A cheetah thrown at twice the limit: no control keeps it."""
    env = made(
        "HalfCheetah-v5",
        [sw.constraints.SpeedLimit(2.0, "torso", "+x"), sw.constraints.JointSpeedLimit(10.0)],
    )
    env.reset(seed=0)
    env.unwrapped.data.qvel[0] = 4.0
    return env


def failing(env, control):
    """The filter's own measure: the largest violation in shares of the constraint's scale."""
    return max(-c.slack(control) / c.spec.scale for c in env.filter.bound)


def compared(env, steps, monkeypatch):
    """For every infeasible step: how the executed control fails, the proposal, and the brake."""
    from safe_wrappers.filter.fallback import brake

    real, seen = env.unwrapped.step, []

    def judged(action):
        # The plant still stands at the state before this step.
        executed = np.asarray(action, dtype=np.float64)
        seen.append((failing(env, executed), failing(env, proposed), failing(env, brake(env.plant))))
        return real(action)

    monkeypatch.setattr(env.unwrapped, "step", judged)
    out = []
    for k in range(steps):
        proposed = bang_bang(env, k, None).astype(np.float64)
        info = env.step(proposed.astype(np.float32))[4]
        if info["cbf/infeasible"]:
            assert info["cbf/fallback"]
            out.append(seen[-1])
        seen.clear()
    return np.array(out)


@pytest.mark.parametrize("make", [too_fast, stuck])
def test_what_is_executed_fails_no_more_than_the_brake_and_the_proposal(make, monkeypatch):
    env = make()
    if make is stuck:
        env.reset(seed=0)
    failed = compared(env, 25, monkeypatch)
    assert len(failed) >= 3 and (failed[:, 0] > 0.0).all()
    # 1e-6: the executed one is rounded to float32
    assert (failed[:, 0] <= failed[:, 1] + 1e-6).all()
    assert (failed[:, 0] <= failed[:, 2] + 1e-6).all()
    assert (failed[:, 0] < failed[:, 1] - 1e-3).any()


@pytest.mark.parametrize(
    ("fallback", "expected"),
    [
        ("zero", lambda last: np.zeros(2)),
        ("hold", lambda last: last),
        (lambda plant: np.array([0.25, -0.5]), lambda last: np.array([0.25, -0.5])),
    ],
)
def test_a_fallback_that_was_chosen_is_what_is_executed(fallback, expected):
    env = stuck(fallback)
    env.reset(seed=0)
    last = np.zeros(2)
    for k in range(10):
        info = env.step(bang_bang(env, k, None))[4]
        assert info["cbf/infeasible"] and info["cbf/fallback"]
        np.testing.assert_array_equal(info["executed_action"], expected(last))
        last = info["executed_action"]


# What is an intervention --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "may_agree"),
    [
        (too_fast, False),
        (stuck, False),
        (lambda: stuck("hold"), True),
        (lambda: stuck("zero"), True),
        (lambda: made("Reacher-v5", LIMITS["Reacher-v5"]), False),
    ],
    ids=["too fast", "stuck", "stuck, hold", "stuck, zero", "possible"],
)
def test_intervened_says_whether_the_executed_action_is_another_one(make, may_agree):
    env = make()
    if make is not too_fast:
        env.reset(seed=0)
    agreed = 0
    for k in range(40):
        action = np.zeros(env.action_space.shape, np.float32) if k % 4 == 3 else bang_bang(env, k, None)
        info = env.step(action)[4]
        assert info["cbf/intervened"] == bool((info["executed_action"] != action).any())
        assert info["cbf/intervened"] == (info["cbf/correction"] > 0.0)
        assert not info["cbf/infeasible"] or info["cbf/refused"].any()
        agreed += info["cbf/infeasible"] and not info["cbf/intervened"]
    assert (
        agreed > 0 or not may_agree
    )  # the fallback chose what the policy wanted: infeasible, no intervention
