"""CBFActionFilter: what reaches the env and what is said of it, fallbacks, and closed loops that are known exactly.

The bugs seen in other filters are tested by their numbers.
"""

import threading
import warnings
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Below, pendulum_plant
from hypothesis import given
from hypothesis import strategies as st
from worlds import Cart, Raw, filtered_cart

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.fallback import brake

pytestmark = pytest.mark.filterwarnings("ignore")
PUSH = np.array([0.9], np.float32)
SPEED = sw.constraints.JointSpeedLimit(4.0)


def started(*constraints, **options):
    filtered = filtered_cart(list(constraints), **options)
    filtered.reset(seed=0)
    return filtered


# What reaches the env, and what is said of it ---------------------------------------------------------------------

LIMIT = 0.25
SPECIAL = [1 / 3, float(np.nextafter(1.0, 0.0)), -1.0, 1e30, np.nan, np.inf, -np.inf]
VALUES = st.one_of(st.floats(-1.0, 1.0), st.floats(-9.0, 9.0), st.sampled_from(SPECIAL))
FORMS = st.sampled_from([np.float32, np.float64, list])


@given(st.lists(st.tuples(VALUES, FORMS), min_size=1, max_size=12))
def test_what_is_executed_and_reported_is_the_projection_in_closed_form(proposals):
    # Bug 8: raw, boxed and executed are three things; saturation does not hide the intervention.
    filtered = started(Below(LIMIT, of=1), fallback="zero")
    for value, form in proposals:
        action = [value] if form is list else np.array([value], form)
        proposed = float(action[0])
        room = (LIMIT - filtered.unwrapped.state[1]) / 0.1  # the largest push that keeps the limit
        info = filtered.step(action)[4]
        sent = filtered.unwrapped.given[-1]
        boxed = float(np.clip(proposed, -1.0, 1.0)) if np.isfinite(proposed) else 0.0
        assert info["cbf/intervened"] == (not np.isfinite(proposed) or float(sent[0]) != boxed)
        assert info["cbf/nonfinite"] == info["cbf/fallback"] == (not np.isfinite(proposed))
        if boxed == proposed and not info["cbf/intervened"]:
            assert sent is action  # the very object
        else:
            assert sent.dtype == np.float32 and filtered.action_space.contains(sent)
        assert float(sent[0]) == pytest.approx(min(boxed, room), abs=1e-6)
        assert filtered.unwrapped.state[1] <= LIMIT + 1e-8
        shown = proposed if np.isfinite(proposed) else 0.0
        assert info["proposed_action"] == [shown] and info["executed_action"] == [float(sent[0])]
        assert info["cbf/correction"] == pytest.approx(abs(float(sent[0]) - shown), rel=1e-12)
        assert not (info["cbf/infeasible"] or info["cbf/unsafe"])
    assert filtered.filter_calls == len(proposals) and 0.0 < filtered.filter_seconds < 60.0


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ([3.0], "left the action space by 2; it is boxed"),
        ([np.nan], r"not finite \(\[nan\]\); the fallback acts"),
    ],
)
def test_a_wrong_action_is_warned_of_once(action, words):
    filtered = started(Below(LIMIT, of=1))
    with pytest.warns(UserWarning, match=words) as caught:
        for _ in range(3):
            filtered.step(np.array(action))
        filtered.reset(seed=0)
        filtered.step(np.array(action))
    assert len(caught) == 1


# Unsafe starts ----------------------------------------------------------------------------------------------------


def test_an_unsafe_start_is_warned_of_once_per_episode_counted_and_left():
    # Recovery is exponential towards h = margin, so a margin is what gets it inside.
    filtered = filtered_cart([sw.constraints.Barrier(lambda x: 1.0 - x[1] ** 2, alpha=2.0, margin=0.1)])
    for _ in range(2):
        with warnings.catch_warnings(record=True, action="always") as caught:
            _, info = filtered.reset(seed=0, options={"state": [0.0, 1.5]})
            assert info["cbf/unsafe"] and info["cbf/margin"] == pytest.approx(-1.25)
            assert info.keys() >= {*keys.CBF_BOOLS, *keys.CBF_FLOATS}
            assert [w.category for w in caught] == [sw.UnsafeStateWarning]
            infos = [filtered.step(np.ones(1, np.float32))[4] for _ in range(40)]
        assert len(caught) == 1
        unsafe = [i["cbf/unsafe"] for i in infos]
        assert unsafe[0] and not unsafe[-1]
        assert infos[1]["cbf/margin"] > infos[0]["cbf/margin"]


# Fallbacks --------------------------------------------------------------------------------------------------------


CAUSES = {
    "infeasible": [[[1.0], [-1.0]], [-0.2, -0.4]],  # u <= -0.2 and u >= 0.4
    "not a number": [[[np.nan]], [1.0]],
    "infinite": [[[np.inf]], [1.0]],
}


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.parametrize(
    ("fallback", "expected"),
    [
        ("brake", None), ("hold", 0.35), ("zero", 0.0), (lambda plant: [-0.75], -0.75), (lambda plant: [9.0], 1.0),
        (lambda plant: [np.nan], 0.0), (lambda plant: [10.0 * plant.state[1]], 0.35),
    ],
)  # fmt: skip
def test_where_nothing_is_found_the_fallback_acts_once_and_the_cause_is_said(cause, fallback, expected):
    # Bug 2: infeasible, and the unsafe action passed with "intervened" False; a failed solve poisoned the next.
    filtered = started(Below(50.0, of=1), Raw(), fallback=fallback)
    filtered.step(np.array([0.35], np.float32))
    rows = filtered.filter.bound[1].spec
    rows.fixed = CAUSES[cause]
    info = filtered.step(PUSH)[4]
    assert info["cbf/fallback"] and info["cbf/intervened"]
    assert info["cbf/infeasible"] == (cause == "infeasible")
    if expected is None:  # what fails a contradiction least; of rows that are none nothing is known
        expected = 0.1 if cause == "infeasible" else 0.0
    np.testing.assert_allclose(info["executed_action"], [expected], atol=1e-4)
    np.testing.assert_array_equal(filtered.unwrapped.given[-1], info["executed_action"])
    rows.fixed = ()
    info = filtered.step(PUSH)[4]
    assert not (info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/intervened"])


NO_NUMBER = "the fallback's control is a number or an array of numbers"


@pytest.mark.parametrize(
    ("control", "words"), [(["fast"], NO_NUMBER), ([10**400], NO_NUMBER), ([0.0, 0.0], r"got \(2,\)")]
)  # fmt: skip
def test_a_fallback_that_returns_no_control_is_an_error(control, words):
    filtered = started(Raw(*CAUSES["infeasible"]), fallback=lambda plant: control)
    with pytest.raises(ConfigurationError, match=words):
        filtered.step(np.zeros(1))


def test_brake_on_mujoco_takes_the_kinetic_energy_away():
    filtered = sw.CBFActionFilter(gym.make("Reacher-v5"), [Raw(np.eye(2), [-5.0, -5.0])])
    filtered.reset(seed=0)
    raw = filtered.unwrapped
    raw.set_state(raw.data.qpos.copy(), np.array([3.0, -5.0, 0.0, 0.0]))
    before = np.abs(raw.data.qvel[:2]).copy()
    assert filtered.step(np.array([1.0, -1.0], np.float32))[4]["cbf/fallback"]
    assert (np.abs(raw.data.qvel[:2]) < before).all()


# Which constraint refused, what fails least, what is an intervention ----------------------------------------------

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


def bang_bang(env, k):
    """Corners of the box, held for six steps; now and then nothing."""
    if k % 4 == 3:
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
        action, refused = bang_bang(together, k), []
        for env in alone:
            mujoco.mj_copyData(env.unwrapped.data, together.unwrapped.model, together.unwrapped.data)
            refused.append(bool(env.step(action)[4]["cbf/refused"][0]))
        info = together.step(action)[4]
        assert info["cbf/refused"].tolist() == refused
        assert any(refused) == (info["cbf/intervened"] or info["cbf/infeasible"])
        found.append(refused)
    kinds = [type(limit).__name__ for limit in LIMITS[env_id]]
    numbered = [f"{kind} {kinds[: i + 1].count(kind)}" for i, kind in enumerate(kinds)]
    assert together.constraint_names == [
        n if kinds.count(k) > 1 else k for k, n in zip(kinds, numbered, strict=True)
    ]
    found = np.array(found)
    assert found.any(axis=0).sum() >= 3 and (found.sum(axis=1) > 1).any()


def torn(fallback="brake"):
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


@pytest.mark.parametrize("build", [too_fast, torn, lambda: torn("hold"), lambda: torn("zero")])
def test_where_nothing_is_admitted_the_brake_fails_least_and_an_intervention_is_another_action(build):
    env, failed, infeasible, agreed = build(), [], [], 0
    step, proposed = env.unwrapped.step, None

    def judged(action):
        """By the filter's own measure: the largest violation in shares of the constraint's scale, before the step."""
        controls = np.asarray(action, dtype=np.float64), proposed, brake(env.plant)
        failed.append([max(-c.slack(u) / c.spec.scale for c in env.filter.bound) for u in controls])
        return step(action)

    with mock.patch.object(env.unwrapped, "step", judged):
        for k in range(32):
            proposed = bang_bang(env, k).astype(np.float64)
            info = env.step(proposed.astype(np.float32))[4]
            infeasible.append(info["cbf/infeasible"])
            assert info["cbf/fallback"] or not infeasible[-1]
            assert info["cbf/refused"].any() or not infeasible[-1]
            assert info["cbf/intervened"] == bool((info["executed_action"] != proposed).any())
            assert info["cbf/intervened"] == (info["cbf/correction"] > 0.0)
            agreed += infeasible[-1] and not info["cbf/intervened"]
    executed, proposal, braking = np.array(failed)[infeasible].T
    assert len(executed) >= 3 and (executed > 0.0).all()
    if build in (too_fast, torn):
        # 1e-6: the executed one is rounded to float32
        assert (executed <= np.minimum(proposal, braking) + 1e-6).all()
        assert (executed < proposal - 1e-3).any()
    else:  # these may choose what the policy wanted: infeasible, and no intervention
        assert agreed > 0


# Threads ----------------------------------------------------------------------------------------------------------


def test_an_env_may_reset_its_filter_within_a_step():
    env = made("Reacher-v5", [SPEED])
    step = env.unwrapped.step
    with mock.patch.object(env.unwrapped, "step", lambda action: (step(action), env.reset(seed=0))[0]):
        thread = threading.Thread(target=env.step, args=(env.action_space.low,), daemon=True)
        thread.start()
        thread.join(20.0)
    assert not thread.is_alive()


# Closed loops that are known exactly ------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("late", [0, 3])
def test_a_plant_with_inertia_stops_in_front_of_the_wall_whatever_is_in_flight(dt, late):
    # Bugs 6 and 7: one step of look-ahead on the position would drive through at any of these.
    planes = [sw.constraints.Plane([3.0], [-1.0])]
    wall = sw.constraints.Clearance(planes, braking=1.0, position=[0], velocity=[1])

    def driven(delay_s):
        filtered = filtered_cart([wall], env=Cart(dt, late), dt=dt, delay_s=delay_s)
        filtered.reset(seed=0)
        return filtered, [filtered.step(np.ones(1, np.float32))[4] for _ in range(int(12 / dt))]

    filtered, infos = driven(late * dt)
    assert 3.0 - 1e-2 < filtered.unwrapped.farthest <= 3.0 + 1e-6
    assert min(i["cbf/margin"] for i in infos) > -1e-8
    assert sum(i["cbf/intervened"] for i in infos) > 3
    assert not late or driven(0.0)[0].unwrapped.farthest > 3.0 + 1e-3  # without telling it


def slow_pendulum(alpha, torque):
    env = gym.make("Pendulum-v1")
    env.unwrapped.max_torque = torque
    env.unwrapped.action_space = gym.spaces.Box(-torque, torque, (1,), np.float32)
    limits = [sw.constraints.Barrier(lambda x: 16.0 - x[1] ** 2, alpha=alpha)]
    return sw.CBFActionFilter(env, limits, plant=pendulum_plant())


@pytest.mark.parametrize("alpha", [5.0, 20.0])
@pytest.mark.parametrize("driver", ["full", "bang", "alternating"])
@pytest.mark.parametrize(
    ("torque", "holds"),
    [
        (60.0, True),  # one held step reaches twice the limit; at rest the row of 16 - v^2 allows everything
        (20.0, True),
        (2.0, False),  # of the published task: gravity is stronger
    ],
)
def test_a_barrier_is_never_broken_in_silence_and_held_where_the_motor_can(torque, holds, driver, alpha):
    filtered, rng, broken = slow_pendulum(alpha, torque), np.random.default_rng(0), 0
    filtered.reset(seed=0)
    for k in range(400):
        sign = {"full": 1.0, "bang": rng.choice([-1.0, 1.0]), "alternating": (-1.0) ** (k // 15)}[driver]
        *_, truncated, info = filtered.step(np.array([sign * torque], np.float32))
        violated = abs(filtered.unwrapped.state[1]) > 4.0 + 1e-6
        broken += violated
        assert not violated or info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"]
        if truncated:
            filtered.reset()
    assert (broken == 0) == holds


@pytest.mark.parametrize("fallback", ["hold", "zero", lambda plant: np.array([1.0, 1.0])])
def test_a_proved_constraint_stays_proved_with_any_fallback(fallback):
    env = sw.protect(gym.make("SafePointGoal2-v0"), detour=False, fallback=fallback)
    rng = np.random.default_rng(1)
    env.reset(seed=0)
    raw = env.unwrapped
    for k in range(600):
        if k % 60 == 0:
            target = raw.hazard_positions[rng.integers(len(raw.hazard_positions))]
        angle = np.angle((target - raw.agent_position) @ [1, 1j] / np.exp(1j * raw.agent_heading))
        action = np.array([1.0, np.clip(4.0 * angle, -1.0, 1.0)], np.float32)
        assert env.step(action)[4]["cost_substep"] == 0.0


# Broken readings --------------------------------------------------------------------------------------------------


class Standing(gym.Wrapper):
    """Its physics stands still, so that a broken state cannot crash it; it publishes hazards."""

    hazards = np.array([[0.5, 0.0]])

    def step(self, action):
        self.given = np.array(action)
        return self.observation_space.sample(), 0.0, False, False, {}


def broken_hazard(env):
    env.hazards = np.array([[0.5, 0.0], [np.nan, 0.0]])


def broken_speed(env):
    env.unwrapped.data.qvel[0] = np.inf


NEAR = sw.constraints.HeadingDriveClearance([sw.constraints.Discs("hazards", 0.2)])


@pytest.mark.parametrize(
    ("env_id", "limit", "delay_s", "broken"),
    [
        ("SafePointGoal1-v0", NEAR, 0.0, broken_hazard),
        ("Reacher-v5", SPEED, 0.02, broken_speed),  # not hidden by the prediction
    ],
)
@pytest.mark.parametrize("fallback", ["brake", lambda plant: [np.nan, np.inf]])
def test_a_state_or_an_obstacle_that_is_no_number_runs_the_fallback(env_id, limit, delay_s, broken, fallback):
    plant = sw.MujocoPlant(delay_s=delay_s)
    filtered = sw.CBFActionFilter(Standing(gym.make(env_id)), [limit], plant=plant, fallback=fallback)
    filtered.reset(seed=0)
    filtered.step(np.zeros(2, np.float32))
    broken(filtered.env)
    info = filtered.step(np.ones(2, np.float32))[4]
    assert filtered.action_space.contains(filtered.env.given.astype(np.float32))
    assert info["cbf/fallback"] and info["cbf/unsafe"] and info["cbf/intervened"], info
    assert all(np.isfinite(v).all() for v in info.values())
