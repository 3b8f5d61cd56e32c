"""CBFActionFilter: what reaches the env, what info says of it, fallbacks, episodes and threads.

The bugs seen in other filters are tested by their numbers.
"""

import threading
import warnings
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from worlds import Raw, SpeedRow, filtered_cart, full_throttle, wall

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.fallback import brake

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")


def started(*constraints, **options):
    filtered = filtered_cart(list(constraints), **options)
    filtered.reset(seed=0)
    return filtered


# What reaches the env -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "action",
    [np.array([0.1], np.float32), np.array([1 / 3]), [0.25], np.array([np.nextafter(1, 0)]), [1], [0.0]],
)
def test_inactive_hands_the_very_object_on(action):
    filtered = started(wall(100.0))
    info = filtered.step(action)[4]
    assert filtered.unwrapped.given[-1] is action
    assert not info["cbf/intervened"] and info["cbf/correction"] == 0.0
    np.testing.assert_array_equal(info["executed_action"], np.asarray(action, float))


@pytest.mark.parametrize("limit", [0.05, 0.1 / 3])
def test_a_changed_action_has_the_spaces_dtype_and_the_rows_hold_for_what_was_executed(limit):
    # Bug 8: raw, boxed and executed are three things; saturation does not hide the intervention.
    for action in (1.0, 3.0):
        filtered = started(SpeedRow(limit))
        with warnings.catch_warnings(action="ignore"):
            info = filtered.step(np.array([action], np.float32))[4]
        sent = filtered.unwrapped.given[-1]
        assert sent.dtype == np.float32 and filtered.action_space.contains(sent)
        assert info["cbf/intervened"] and info["proposed_action"] == [action]
        np.testing.assert_array_equal(info["executed_action"], sent)
        np.testing.assert_allclose(sent, [10.0 * limit], atol=1e-6)
        assert info["cbf/correction"] == pytest.approx(action - 10.0 * limit, abs=1e-6)
        full_throttle(filtered, 20)
        assert filtered.unwrapped.state[1] <= limit + 1e-8


def test_an_action_outside_of_the_box_is_boxed_which_is_no_intervention_and_warned_of_once():
    filtered = started(SpeedRow(50.0))
    with warnings.catch_warnings(record=True, action="always") as caught:
        infos = [filtered.step(np.array([3.0]))[4] for _ in range(3)]
    assert [str(w.message) for w in caught] == ["the policy's action left the action space by 2; it is boxed"]
    assert not infos[0]["cbf/intervened"] and infos[0]["cbf/correction"] == 2.0
    assert filtered.unwrapped.given[0] == infos[0]["executed_action"] == [1.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_the_fallbacks_turn(bad):
    filtered = started(wall(100.0), fallback="zero")
    with pytest.warns(UserWarning, match="not finite"):
        info = filtered.step(np.array([bad]))[4]
    assert filtered.unwrapped.given[-1] == [0.0]
    assert info["cbf/nonfinite"] and info["cbf/fallback"] and info["cbf/intervened"]


# Unsafe starts ------------------------------------------------------------------------------------------------


def test_an_unsafe_start_is_warned_of_once_per_episode_counted_and_left():
    # Recovery is exponential towards h = margin, so a margin is what gets it inside.
    filtered = filtered_cart([sw.constraints.Barrier(lambda x: 1.0 - x[1] ** 2, alpha=2.0, margin=0.1)])
    for _ in range(2):
        with warnings.catch_warnings(record=True, action="always") as caught:
            _, info = filtered.reset(seed=0, options={"state": [0.0, 1.5]})
            assert info["cbf/unsafe"] and info["cbf/margin"] == pytest.approx(-1.25)
            infos = [filtered.step(np.array([1.0], np.float32))[4] for _ in range(40)]
        assert [w.category for w in caught] == [sw.UnsafeStateWarning]
        assert "outside the safe set" in str(caught[0].message)
        unsafe = [i["cbf/unsafe"] for i in infos]
        assert unsafe[0] and 1 <= sum(unsafe) < 40
        assert infos[1]["cbf/margin"] > infos[0]["cbf/margin"]
        assert abs(filtered.unwrapped.state[1]) <= 1.0 + 1e-2


def test_point_goal_started_inside_a_hazard_leaves_it():
    hazards = [[0.05, 0.02], [-1.0, -1.0]]
    layout = {"agent": [0.0, 0.0, 0.3], "goal": [1.2, 1.2], "hazards": hazards, "vases": []}
    filtered = sw.protect(gym.make("SafePointGoal1-v0"))
    assert filtered.reset(seed=0, options={"layout": layout})[1]["cbf/unsafe"]
    infos = [filtered.step(np.array([1.0, 0.0], np.float32))[4] for _ in range(150)]
    costs = [info["cost_substep"] for info in infos]
    assert costs[0] == 1.0 and not any(costs[-20:])
    assert infos[-1]["cbf/margin"] > -0.005  # of the stopping path; the approach to 0 is exponential


# Fallbacks ----------------------------------------------------------------------------------------------------


class Switch(sw.Constraint):
    """Asks for nothing, or, switched on, for a contradiction."""

    on = False

    def rows(self):
        contradiction = sw.HalfSpaces(np.array([[1.0], [-1.0]]), np.array([-0.2, -0.4]))
        return contradiction if self.on else sw.HalfSpaces.none(1)


CONTRADICTION = Raw([[1.0], [-1.0]], [-0.2, -0.4])  # u <= -0.2 and u >= 0.4


@pytest.mark.parametrize(
    ("fallback", "expected"),
    [
        ("brake", 0.1),
        ("hold", 0.35),
        ("zero", 0.0),
        (lambda plant: [-0.75], -0.75),
        (lambda plant: [9.0], 1.0),
        (lambda plant: [np.nan], 0.0),
        (lambda plant: [10.0 * plant.state[1]], 0.35),
    ],
)
def test_infeasible_is_reported_and_the_fallback_runs(fallback, expected):
    # Bug 2: infeasible, and the unsafe action passed with "intervened" False.
    filtered = started(SpeedRow(50.0), Switch(), fallback=fallback)
    filtered.step(np.array([0.35], np.float32))
    filtered.filter.bound[1].spec.on = True
    info = filtered.step(np.array([0.9], np.float32))[4]
    assert info["cbf/infeasible"] and info["cbf/fallback"] and info["cbf/intervened"]
    np.testing.assert_allclose(info["executed_action"], [expected], atol=1e-4)
    np.testing.assert_allclose(filtered.unwrapped.given[-1], [expected], atol=1e-4)
    # the next feasible step is untouched by it
    filtered.filter.bound[1].spec.on = False
    info = filtered.step(np.array([0.9], np.float32))[4]
    assert not (info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/intervened"])


@pytest.mark.parametrize(
    ("control", "words"),
    [
        (["fast"], "the fallback's control is a number or an array of numbers"),
        ([10**400], "the fallback's control is a number or an array of numbers"),
        (np.ma.masked_array([0.0], True), "the fallback's control is a number or an array of numbers"),
        ([0.0, 0.0], r"fallback must return a control of shape \(1,\), got \(2,\)"),
    ],
)
def test_a_fallback_that_returns_no_control_is_an_error(control, words):
    filtered = started(CONTRADICTION, fallback=lambda plant: control)
    with pytest.raises(ConfigurationError, match=words):
        filtered.step(np.zeros(1))


def test_brake_on_mujoco_takes_the_kinetic_energy_away():
    filtered = sw.CBFActionFilter(gym.make("Reacher-v5"), [Raw(np.eye(2), [-5.0, -5.0])])
    filtered.reset(seed=0)
    raw = filtered.unwrapped
    raw.set_state(raw.data.qpos.copy(), np.array([3.0, -5.0, 0.0, 0.0]))
    before = np.abs(raw.data.qvel[:2]).copy()
    info = filtered.step(np.array([1.0, -1.0], np.float32))[4]
    assert info["cbf/infeasible"] and info["cbf/fallback"]
    assert (np.abs(raw.data.qvel[:2]) < before).all()


@pytest.mark.parametrize("row", [np.nan, np.inf])
def test_a_broken_constraint_is_a_failed_solve_and_the_fallback(row):
    info = started(Raw([[row]], [1.0]), fallback="zero").step(np.array([0.9], np.float32))[4]
    assert info["cbf/fallback"] and info["cbf/intervened"] and not info["cbf/infeasible"]
    np.testing.assert_array_equal(info["executed_action"], [0.0])


# Which constraint refused, what fails least, what is an intervention ------------------------------------------


LIMITS = {
    "Reacher-v5": [
        sw.constraints.JointSpeedLimit(6.0),
        sw.constraints.JointPositionLimit(-1.5, 1.5, ["joint0"], horizon=6),
        sw.constraints.Workspace(keep_out=[sw.constraints.Disc([0.0, 0.15], 0.06)], bodies=["fingertip"], horizon=6),
        sw.constraints.SpeedLimit(0.8, "fingertip", horizon=2),
        sw.constraints.JointPositionLimit(-2.0, 2.0, ["joint1"], horizon=6),
    ],
    "HalfCheetah-v5": [
        sw.constraints.SpeedLimit(0.5, "torso", "+x"),
        sw.constraints.Workspace(low=[None, None, 0.5], bodies=["torso"], horizon=3),
        sw.constraints.JointSpeedLimit(12.0),
    ],
}  # fmt: skip


def made(env_id, limits, **options):
    filtered = sw.CBFActionFilter(gym.make(env_id, disable_env_checker=True), limits, **options)
    filtered.reset(seed=1)
    return filtered


def bang_bang(env, k, rests=4):
    """Corners of the box, held for six steps; now and then nothing."""
    if k % rests == rests - 1:
        return np.zeros(env.action_space.shape, np.float32)
    bits = np.random.default_rng(k // 6).random(env.action_space.shape) < 0.5
    return (env.action_space.high * np.where(bits, -1.0, 1.0)).astype(np.float32)


@pytest.mark.parametrize("env_id", LIMITS)
def test_refused_names_exactly_those_that_refuse_alone(env_id):
    # Each constraint has an env and a filter of its own, which is put into the same state before every step.
    together = made(env_id, LIMITS[env_id])
    alone = [made(env_id, [limit]) for limit in LIMITS[env_id]]
    found = []
    for k in range(60):
        action, refused = bang_bang(together, k, rests=3), []
        for env in alone:
            mujoco.mj_copyData(env.unwrapped.data, together.unwrapped.model, together.unwrapped.data)
            refused.append(bool(env.step(action)[4]["cbf/refused"][0]))
        info = together.step(action)[4]
        assert info["cbf/refused"].tolist() == refused
        assert any(refused) == (info["cbf/intervened"] or info["cbf/infeasible"])
        found.append(refused)
    found = np.array(found)
    assert found.any(axis=0).sum() >= 3 and (found.sum(axis=1) > 1).any()


def stuck(fallback="brake"):
    """Two demands that no control meets: the tip is to be left of one line and right of another."""
    limits = [
        sw.constraints.Workspace(high=[0.0, None, None], bodies=["fingertip"], horizon=4),
        sw.constraints.Workspace(low=[0.1, None, None], bodies=["fingertip"], horizon=4),
        sw.constraints.JointSpeedLimit(3.0),
    ]
    return made("Reacher-v5", limits, fallback=fallback)


def too_fast():
    """A cheetah thrown at twice the limit: no control keeps it."""
    limits = [sw.constraints.SpeedLimit(2.0, "torso", "+x"), sw.constraints.JointSpeedLimit(10.0)]
    env = made("HalfCheetah-v5", limits)
    env.unwrapped.data.qvel[0] = 4.0
    return env


@pytest.mark.parametrize("make", [too_fast, stuck])
def test_what_is_executed_fails_no_more_than_the_brake_and_the_proposal(make):
    """By the filter's own measure: the largest violation in shares of the constraint's scale."""
    env, failed = make(), []
    step = env.unwrapped.step

    def judged(action):  # the plant still stands at the state before this step
        controls = np.asarray(action, dtype=np.float64), proposed, brake(env.plant)
        failed.append([max(-c.slack(u) / c.spec.scale for c in env.filter.bound) for u in controls])
        return step(action)

    infeasible = []
    with mock.patch.object(env.unwrapped, "step", judged):
        for k in range(25):
            proposed = bang_bang(env, k, rests=99).astype(np.float64)
            info = env.step(proposed.astype(np.float32))[4]
            infeasible.append(info["cbf/infeasible"])
            assert info["cbf/fallback"] or not infeasible[-1]
    executed, proposal, braking = np.array(failed)[infeasible].T
    assert len(executed) >= 3 and (executed > 0.0).all()
    # 1e-6: the executed one is rounded to float32
    assert (executed <= np.minimum(proposal, braking) + 1e-6).all()
    assert (executed < proposal - 1e-3).any()


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
    env, agreed = make(), 0
    for k in range(40):
        action = bang_bang(env, k)
        info = env.step(action)[4]
        assert info["cbf/intervened"] == bool((info["executed_action"] != action).any())
        assert info["cbf/intervened"] == (info["cbf/correction"] > 0.0)
        assert not info["cbf/infeasible"] or info["cbf/refused"].any()
        agreed += info["cbf/infeasible"] and not info["cbf/intervened"]
    # The fallback may choose what the policy wanted: infeasible, and no intervention.
    assert agreed > 0 or not may_agree


# Episodes and threads -----------------------------------------------------------------------------------------


def test_after_a_reset_that_a_constraint_refuses_no_step_is_made():
    env = made("Reacher-v5", [sw.constraints.JointSpeedLimit(limit=4.0)])
    raises = ConfigurationError("not from here")
    for _ in range(2):
        with (
            mock.patch.object(env.filter.bound[0], "observe", side_effect=raises),
            pytest.raises(ConfigurationError),
        ):
            env.reset(seed=0)
        with pytest.raises(gym.error.ResetNeeded):
            env.step(env.action_space.low)
        env.reset(seed=0)
        env.step(env.action_space.low)


def test_a_step_is_compared_with_its_forecast_before_another_threads_step_begins():
    env = made("Reacher-v5", [sw.constraints.JointSpeedLimit(limit=4.0)])
    deviation, calls, others = env.plant.deviation, [], []

    def look():
        if not others:
            others.append(threading.Thread(target=env.step, args=(env.action_space.low,)))
            others[0].start()
            others[0].join(0.2)
            calls.append(env.filter_calls)
        return deviation()

    with mock.patch.object(env.plant, "deviation", look):
        info = env.step(env.action_space.high)[4]
        others[0].join(20.0)
    assert calls == [1] and env.filter_calls == 2
    assert not info["cbf/mismatch"]


class Restarting(gym.Wrapper):
    """An env that begins a new episode within a step, through the outermost wrapper."""

    outermost = None

    def step(self, action):
        answer = self.env.step(action)
        self.outermost.reset(seed=0)
        return answer


def test_an_env_may_reset_its_filter_within_a_step():
    inner = Restarting(gym.make("Reacher-v5"))
    env = inner.outermost = sw.CBFActionFilter(inner, [sw.constraints.JointSpeedLimit(limit=4.0)])
    env.reset(seed=0)
    step = threading.Thread(target=env.step, args=(env.action_space.low,), daemon=True)
    step.start()
    step.join(20.0)
    assert not step.is_alive()
