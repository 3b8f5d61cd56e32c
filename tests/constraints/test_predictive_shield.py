"""PredictiveShield against the stopping distance of a cart in closed form, and its promises in closed loop."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from asking import Asked
from hypothesis import given
from hypothesis import strategies as st
from judged_loops import Judge, drive, flagged, signs
from simulated_worlds import DT, TOP, WALL, Cart, Grid

import safe_wrappers as sw
from safe_wrappers.constraints import PredictiveShield
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError


def brake(observation):
    """Takes the speed away, in the last step exactly."""
    return [float(np.clip(-observation[1] / DT, -TOP, TOP))]


def at_rest(observation):
    return abs(observation[1]) < 1e-9 and observation[0] <= WALL


def wall(observation):
    return WALL - observation[0]


def shield(**changed):
    return PredictiveShield(**{"h": wall, "horizon": 60, "backup": brake, "terminal": at_rest} | changed)


def asked(constraint, start=(0.0, 0.0), env=None):
    env = env or Cart(start)
    plant = sw.SimulatorPlant(check_steps=0)
    plant.bind(env)
    plant.received(*env.reset(seed=0))
    found = Asked(constraint, plant)
    plant.observe()
    return found


def stopping_distance(v, u):
    """Of a control held for one step and then `brake`, by whole and last steps in closed form, m."""
    x, v = v * DT + 0.5 * u * DT * DT, v + u * DT
    if v <= 0.0:
        return max(0.0, x)
    whole = int(v / (TOP * DT) + 1e-12)
    rest = v - whole * TOP * DT
    return x + whole * v * DT - 0.5 * TOP * (whole * DT) ** 2 + 0.5 * rest * DT


@given(x=st.floats(-2.0, 4.9), v=st.floats(0.1, 3.0), u=st.floats(-1.0, 1.0))
def test_it_admits_what_can_stop_before_the_wall(x, v, u):
    needed, room = stopping_distance(v, u), WALL - x
    if abs(needed - room) > 1e-9:
        assert asked(shield(), (x, v)).admits(np.array([u])) == (needed < room)


def test_any_backup_of_a_list_admits():
    go, stop = (lambda o: [0.5]), brake
    for room, backup, expected in (
        (0.2, [go, stop], False),  # to the wall, at 1 m/s: too little for the brake
        (0.65, go, False),
        (0.65, stop, True),
        (0.65, [go, stop], True),
        (0.65, ["hold", stop], True),
    ):
        before_it = dict(h=lambda o: 1.0 if o[0] < WALL else -1.0, terminal=None, horizon=6)
        found = asked(shield(backup=backup, **before_it), (WALL - room, 1.0))
        assert found.admits(np.array([0.0])) == expected


@pytest.mark.parametrize(
    ("backup", "expected"),
    [("zero", 0.0), ("hold", 0.5), (np.array([-0.25]), -0.25), (lambda o: [-0.75], -0.75)],
)
def test_what_a_backup_does_after_the_action(backup, expected):
    seen = []

    def h(observation):
        seen.append(observation[1])
        return 1.0

    asked(shield(h=h, backup=backup, terminal=None, horizon=3)).admits(np.array([0.5]))
    np.testing.assert_allclose(np.diff(seen[-3:]) / DT, expected)


def test_a_model_is_a_backup_and_is_not_copied():
    class Model:
        def predict(self, observation, deterministic):
            assert deterministic
            return np.array([-1.0]), None

        def __deepcopy__(self, memo):
            raise AssertionError("a model may hold a replay buffer")

    env = sw.CBFActionFilter(Cart((4.4, 1.0)), [shield(backup=Model(), terminal=None, horizon=10)])
    env.reset(seed=0)
    assert env.step(np.ones(1))[4]["cbf/intervened"]


def test_nothing_is_proved_of_an_unchecked_copy():
    unchecked = sw.CBFActionFilter(Cart(), [shield()], plant=sw.SimulatorPlant(check_steps=0))
    assert unchecked.constraints[0].promise == shield(terminal=None).promise == "best effort"


def test_what_has_to_come_within_the_horizon():
    # It can brake from 3 m/s within 4.5 m; ten steps later, without a set to reach, nothing is visible yet.
    assert not asked(shield(), (0.9, 3.0)).admits(np.ones(1))
    assert asked(shield(terminal=None, horizon=10), (0.9, 3.0)).admits(np.ones(1))
    late = asked(shield(horizon=5), (0.0, 2.0))  # it stops after twenty steps: a set that is not reached
    assert not late.admits(np.zeros(1)) and -1e-5 < late.slack(np.zeros(1)) < 0.0
    assert asked(shield(margin=0.5), (0.0, 0.0)).slack(np.zeros(1)) == pytest.approx(4.5)
    # An episode that ends has survived; from 0.5 m before the wall it does not.
    for room, admitted in ((5.0, True), (0.5, False)):
        short = gym.wrappers.TimeLimit(Cart((WALL - room, 2.0)), 4)
        assert asked(shield(horizon=5), env=short).admits(np.zeros(1)) == admitted


def test_the_survivor_of_the_last_step_is_asked_first():
    calls = []

    def named(name, action):
        return lambda observation: calls.append(name) or [action]

    constraint = shield(backup=[named("go", 1.0), named("stop", -1.0)], terminal=None, horizon=12)
    found = asked(constraint, (WALL - 0.8, 1.0))
    assert found.admits(np.zeros(1)) and calls[0] == "go" and calls[-1] == "stop"
    found.executed(np.zeros(1))
    found.plant.observe()
    calls.clear()
    found.admits(np.array([-1.0]))
    assert set(calls) == {"stop"}  # it survives: nobody else is asked


class Settable(gym.Env):
    """The state is the last action."""

    observation_space = gym.spaces.Box(-9.0, 9.0, (2,), np.float64)

    def __init__(self, space):
        self.action_space = space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2), {}

    def step(self, action):
        return np.ravel(action).astype(float)[:2], 0.0, False, False, {}


def test_an_array_is_one_backup_and_whole_numbers_are_several():
    space = gym.spaces.Box(-1.0, 1.0, (3,), np.float64)
    found = asked(shield(h=lambda o: 1.0, backup=np.array([0, 0, 1]), terminal=None), env=Settable(space))
    np.testing.assert_array_equal(found.backup(), [0.0, 0.0, 1.0])
    several = shield(h=lambda o: 1.0 if o[0] == 1.0 else -1.0, backup=[0, 1], terminal=None)
    env = sw.ActionShield(Settable(gym.spaces.Discrete(3)), [several])
    env.reset(seed=0)
    assert env.step(2)[4]["executed_action"] == [1]


def test_value_chooses_among_the_admitted():
    def prefers(observation, actions):
        return -np.abs(actions[:, 0] + 0.6)

    found = asked(shield(value=prefers, candidates=200), (WALL - 0.66, 1.0))
    best = next(iter(found.candidates(np.ones(1))))
    assert abs(best[0] + 0.6) < 0.05 and found.admits(best)
    wrong = asked(shield(value=lambda o, a: np.zeros(1)), (WALL - 0.66, 1.0))
    with pytest.raises(ConfigurationError, match=r"value must return a number for each of \d+ actions"):
        wrong.candidates(np.ones(1))


def test_h_that_is_nan_is_never_admitted():
    broken = asked(shield(h=lambda o: np.nan if o[1] > 0.0 else 1.0, terminal=None, horizon=3))
    assert broken.slack(np.ones(1)) == -np.inf and broken.admits(-np.ones(1))
    env = sw.CBFActionFilter(Cart(), [shield(h=lambda o: np.nan)])
    with pytest.warns(sw.UnsafeStateWarning):
        env.reset(seed=0)
    assert env.step(np.ones(1))[4]["executed_action"] == [0.0]
    with pytest.raises(ConfigurationError, match="h must return one number"):
        asked(shield(h=lambda o: o)).value()


def test_a_backup_without_an_answer_admits_nothing_and_ends_nothing():
    lost = asked(
        shield(backup=lambda o: [np.nan] if o[1] > 1.0 else brake(o), terminal=None, horizon=4), (0.0, 1.0)
    )
    assert not lost.admits(np.ones(1)) and lost.admits(np.zeros(1))
    env = sw.CBFActionFilter(
        Cart(), [shield(backup=lambda o: [np.nan if o[1] > 0.05 else 0.0], terminal=None)]
    )
    env.reset(seed=0)
    env.unwrapped.v = 2.0
    infos = [env.step(np.ones(1))[4] for _ in range(2)]
    assert infos[1]["cbf/infeasible"] and np.isfinite(infos[1]["executed_action"]).all()


def test_functions_may_see_a_view():
    found = asked(
        shield(
            sees="view",
            h=lambda view: WALL - view.env.x - view.info["cost"],
            backup=lambda view: brake(view.observation),
            terminal=lambda view: at_rest(view.observation),
        ),
        (WALL - 0.66, 1.0),
    )
    same = asked(shield(), (WALL - 0.66, 1.0))
    for u in np.linspace(-1, 1, 21):
        assert found.admits(np.array([u])) == same.admits(np.array([u]))


@pytest.mark.parametrize(
    ("backup", "words"),
    [
        (lambda o: [0.5, 0.5], r"a finite action of Box.*\[0\.5, 0\.5\]"),
        (lambda o: [np.nan], "must be a finite action"),
        (lambda o: np.ma.masked_array([0.0], True), "must be a finite action"),
    ],
)
def test_a_backup_that_is_no_action_is_refused_at_the_latest_at_a_reset(backup, words):
    with pytest.raises(ConfigurationError, match=words):
        sw.CBFActionFilter(Cart(), [shield(backup=backup)]).reset(seed=0)


def test_envs_and_plants_without_copies_or_a_zero_are_refused():
    with pytest.raises(ConfigurationError, match="discrete action has no zero"):
        sw.ActionShield(Grid(), [PredictiveShield("cost", 2)])
    with pytest.raises(UnsupportedEnvError, match=r"take plant=SimulatorPlant\(\)"):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [shield()], plant=sw.MujocoPlant())


# On MuJoCo envs, against every physics substep that MuJoCo itself makes of what was executed -------------------

LIMIT = 15.0  # rad/s of every joint


def against(speeds):
    return np.clip(-0.1 * speeds, -1.0, 1.0)


def shielded(sees):
    """HalfCheetah, of which the observation and the env show the joints' speeds, and its judge."""
    speeds = {"observation": lambda x: x[11:17], "env": lambda env: env.data.qvel[3:]}[sees]
    h, backup = lambda x: LIMIT - np.abs(speeds(x)).max(), lambda x: against(speeds(x))
    shield = PredictiveShield(h, 4, backup=backup, candidates=6, sees=sees)
    env = sw.CBFActionFilter(gym.make("HalfCheetah-v5"), [shield], plant=sw.SimulatorPlant(check_steps=20))
    return env, Judge(env, lambda model, data: LIMIT - np.abs(data.qvel[3:]))


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
def test_no_substep_is_violated_without_a_flag():
    env, judge = shielded("env")
    assert drive(env, judge, lambda judge, space, k, rng: signs(space, k, 4), 60)["intervened"] > 10


def test_where_substeps_are_not_judged_it_says_so_once_and_judges_the_ends():
    with pytest.warns(UserWarning, match=r'ends of control steps alone.*5 physics substeps.*sees="env"'):
        env, judge = shielded("observation")
    env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        for k in range(30):
            action = signs(env.action_space, k, 4).astype(np.float32)
            _, least, _, info = judge.step(env, action)
            assert least >= 0.0 or flagged(info) or info["cbf/unsafe"]
            assert not info["cbf/mismatch"]  # looking at substeps changes nothing, bit for bit
