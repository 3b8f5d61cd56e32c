"""What Gymnasium asks of a wrapper, over every wrapper that the library exports.

They are found by `safe_wrappers.__all__`; a new one needs an example in tests/wrapper_examples.py.
"""

import contextlib
import functools
import inspect
import json
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from asking import pendulum_plant
from episodes import actions, lowest, trace
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from wrapper_examples import (
    CASES,
    CHUNKED,
    DISCRETE,
    EXAMPLES,
    EXPORTED,
    FILTERS,
    ONLY_LOOKING,
    SILENT,
    TASK,
    build,
    example,
    inside,
    made,
)

import safe_wrappers as sw
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.errors import UnsupportedEnvError

every_wrapper = pytest.mark.parametrize(("name", "case"), CASES)


@functools.cache
def fresh_trace(name, case):
    """The trace of a new one, which every other must have, too."""
    return trace(build(name, case))


def test_there_are_wrappers_and_each_has_an_example():
    assert set(EXAMPLES) == set(EXPORTED), "every exported wrapper needs an example, and no other has one"


@pytest.mark.parametrize("name", EXPORTED)
def test_a_vector_env_is_refused_with_the_line_to_write(name):
    envs = gym.make_vec(TASK, num_envs=2, vectorization_mode="sync")
    arguments = EXAMPLES[name][next(iter(EXAMPLES[name]))][1]()
    with pytest.raises(UnsupportedEnvError, match=rf"{name} wraps single envs.*make_vec\(.*{name}\("):
        getattr(sw, name)(envs, **arguments)


# 1, 2: recording ----------------------------------------------------------------------------------------------


@every_wrapper
def test_gym_make_rebuilds_it_from_its_spec_and_from_the_spec_s_json(name, case):
    spec = build(name, case).spec
    assert type(gym.make(spec)) is getattr(sw, name)
    assert trace(gym.make(EnvSpec.from_json(spec.to_json()))) == fresh_trace(name, case)


@every_wrapper
def test_every_constructor_argument_is_recorded(name, case):
    wrapper = getattr(sw, name)
    recorded = build(name, case).spec.additional_wrappers[-1]
    parameters = [p for p in inspect.signature(wrapper.__init__).parameters if p not in ("self", "env")]
    assert recorded.name == name
    assert sorted(recorded.kwargs) == sorted(parameters)


def test_what_is_not_plain_data_is_still_recorded_for_gym_make():
    slow = sw.constraints.Barrier(lambda x: 4.0 - x[1] ** 2, alpha=2.0)
    env = sw.CBFActionFilter(gym.make("Pendulum-v1"), [slow], pendulum_plant(), lambda plant: [0.0])
    again = gym.make(env.spec)
    with warnings.catch_warnings(action="ignore"):
        assert trace(again, steps=100) == trace(env, steps=100)
    assert again.plant is not env.plant  # each filter reads its own env


class Forwarding(sw.ActionRepeat):
    """A user's own, which passes on what it is given."""

    def __init__(self, env, *more, **named):
        super().__init__(env, *more, **named)


class EnvLast(sw.ActionRepeat):
    def __init__(self, repeat, env):
        super().__init__(env, repeat)


class Swallowing(sw.ActionRepeat):
    def __init__(self, *more, **named):
        super().__init__(*more, **named)


class OwnNew(sw.ActionRepeat):
    def __new__(cls, env, repeat, passed_on=True):
        return super().__new__(cls, env, repeat=repeat) if passed_on else super().__new__(cls)

    def __init__(self, env, repeat, passed_on=True):
        super().__init__(env, repeat)


@pytest.mark.parametrize(
    "made",
    [
        lambda env: Forwarding(env, repeat=3),
        lambda env: EnvLast(3, env),
        lambda env: Swallowing(env, repeat=3),
        lambda env: Swallowing(env=env, repeat=3),
        lambda env: OwnNew(env, 3),
    ],
)
def test_a_subclass_is_made_again_with_what_it_was_given_by_name(made):
    env = made(gym.make(TASK))
    assert env.spec.additional_wrappers[-1].kwargs.items() >= {"repeat": 3}.items()
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert type(again) is type(env) and again.repeat == 3


@pytest.mark.parametrize("made", [lambda env: Forwarding(env, 3), lambda env: OwnNew(env, 3, False)])
def test_what_has_no_name_is_not_made_again_by_defaults(made):
    env = made(gym.make(TASK))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    with pytest.raises(TypeError, match=r"unexpected keyword argument '\*"):
        gym.make(env.spec)


def test_arguments_that_do_not_fit_are_said_with_the_class_s_name():
    with pytest.raises(TypeError, match=r"ActionRepeat\.__init__\(\).*'times'"):
        sw.ActionRepeat(gym.make(TASK), times=3)


# 3: spaces and check_env --------------------------------------------------------------------------------------


@every_wrapper
def test_check_env_passes_on_the_wrapped_env(name, case):
    with warnings.catch_warnings(action="ignore"):  # of unbounded sensors, and of an env that is wrapped
        check_env(build(name, case), skip_render_check=True)


@every_wrapper
def test_spaces_are_the_envs_own(name, case):
    env = build(name, case)
    if name in CHUNKED:
        own = env.env.action_space
        low, high = (np.stack([end] * env.chunk_size) for end in (own.low, own.high))
        assert env.action_space == gym.spaces.Box(low, high, dtype=own.dtype)
    else:
        assert env.action_space == env.env.action_space
    if getattr(env, "observe", False) is True or name == "FilterObservation":  # what was there stays in front
        own, box = env.env.observation_space, env.observation_space
        n = own.shape[0]
        assert gym.spaces.Box(box.low[:n], box.high[:n], dtype=box.dtype) == own and box.shape[0] > n
    else:
        assert env.observation_space == env.env.observation_space


# 4, 5, 9: reset, pickling -------------------------------------------------------------------------------------


class Witness(gym.Wrapper):
    """Keeps what the wrapper under test passes on."""

    def reset(self, *, seed=None, options=None):
        self.passed = (seed, options)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        self.action = action
        return super().step(action)


@every_wrapper
def test_reset_passes_seed_and_options_on_and_changes_neither(name, case):
    env = build(name, case, Witness)
    options = {"note": [1, 2, {"deep": 3}]}
    if env.spec.id == TASK:
        options = {"layout": {"goal": [1.0, 1.0], "hazards": [[0.0, -1.0]]}}
    before = json.dumps(options)
    for seed in (3, None, 4):
        env.reset(seed=seed, options=options)
        passed = env.get_wrapper_attr("passed")
        assert passed[0] == seed and passed[1] is options
    env.reset()
    assert env.get_wrapper_attr("passed") == (None, None)
    assert json.dumps(options) == before


@every_wrapper
def test_reset_clears_the_wrappers_state_and_that_of_a_pickled_one(name, case):
    env = build(name, case)
    env.reset(seed=9)
    for action in actions(env, 37, seed=9):
        env.step(action)
    assert trace(pickle.loads(pickle.dumps(env))) == fresh_trace(name, case)
    assert trace(env) == fresh_trace(name, case)


@every_wrapper
def test_it_never_draws_from_the_envs_generator(name, case):
    env_id, _ = example(name, case)
    env, bare = build(name, case), gym.make(env_id)
    for seed in (0, None, None):
        a, b = env.reset(seed=seed)[0], bare.reset(seed=seed)[0]
        assert a[: b.size].tobytes() == b.tobytes()
        for _ in range(20):
            env.step(lowest(env))
    assert env.unwrapped.np_random.bit_generator.state == bare.unwrapped.np_random.bit_generator.state


# 6: attributes ------------------------------------------------------------------------------------------------


@every_wrapper
def test_it_forwards_no_attributes(name, case):
    env = build(name, case)
    with pytest.raises(AttributeError):
        _ = env.frame_skip
    assert env.get_wrapper_attr("frame_skip") == env.unwrapped.frame_skip
    assert "__getattr__" not in vars(getattr(sw, name)) and "__setattr__" not in vars(getattr(sw, name))
    assert not env.set_wrapper_attr("filter_secnods", 0.0, force=False)


# 7, 8: info ---------------------------------------------------------------------------------------------------


def types(info):
    return {  # a number that nobody judged is a float of its own kind
        k: (v.dtype.str, v.shape) if isinstance(v, np.ndarray) else float if isinstance(v, float) else type(v)
        for k, v in info.items()
        if k not in ("interventions", "episode")  # at an episode's end only, by design
    }


@every_wrapper
def test_info_has_the_same_keys_and_types_at_every_step(name, case):
    env = build(name, case)
    with warnings.catch_warnings(action="ignore"):
        seen = []
        for seed in range(2):
            env.reset(seed=seed)
            seen += [types(env.step(a)[4]) for a in actions(env)]
        if name in FILTERS:
            seen.append(types(env.step(np.full(env.action_space.shape, np.nan))[4]))
            seen.append(types(env.step(np.full(env.action_space.shape, 9.0))[4]))
        if name in CHUNKED:
            for value in (np.nan, 9.0):
                seen.append(types(env.step(np.full(env.action_space.shape, value))[4]))
            env.set_observation_time(None)
            seen.append(types(env.step(lowest(env))[4]))
    assert all(s == seen[0] for s in seen)
    added = seen[0].keys() - env.unwrapped.step(lowest(env.unwrapped))[4].keys()
    assert added or name in (*SILENT, "RecordInterventions"), "a wrapper of ours reports something"
    assert all("/" in key or key.endswith("_action") or key == "cost" for key in added)


@every_wrapper
def test_info_holds_no_wall_clock_value(name, case):
    # Two runs at different speeds agree in everything.
    env = build(name, case)
    inner = env.env.step
    if name == "ActionShield":  # whose copies of the env would step this one
        env.unwrapped.work = 20_000
    else:
        env.env.step = lambda action: (sum(i * i for i in range(20_000)), inner(action))[1]
    assert trace(env, steps=20) == fresh_trace(name, case)[:21]


@pytest.mark.parametrize(
    ("kind", "name", "case"),
    [(gym.vector.SyncVectorEnv, *one) for one in CASES]
    + [(gym.vector.AsyncVectorEnv, *first) for first in dict(reversed(CASES)).items()],
)
def test_inside_a_vector_env_infos_are_whole(kind, name, case):
    """What each env says arrives whole, with its own types."""
    single = build(name, case)
    single.reset(seed=0)
    steps = actions(single, 25)
    makers = [lambda: gym.wrappers.TimeLimit(build(name, case), 10)] * 2
    with contextlib.closing(kind(makers, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)) as envs:
        envs.reset(seed=0)
        for compared, action in enumerate(steps):  # the first episode
            _, _, terminated, truncated, infos = envs.step(np.stack([action, action]))
            if (terminated | truncated).any():
                assert compared >= 2
                return
            for key, value in single.step(action)[4].items():
                assert infos[f"_{key}"].all()
                assert infos[key].dtype == np.asarray(value).dtype, key
                np.testing.assert_array_equal(infos[key][0], value, err_msg=key)
    raise AssertionError("the first episode does not end")


# 10, 11: actions ----------------------------------------------------------------------------------------------


def harmless(name, case):
    """The wrapper over a witness, with limits that nothing reaches."""
    if name == "CBFActionFilter":
        return sw.CBFActionFilter(Witness(gym.make("Reacher-v5")), [sw.constraints.JointSpeedLimit(1e9)])
    if name in CHUNKED:
        return getattr(sw, name)(Witness(gym.make("Reacher-v5", max_episode_steps=500)), 5, 3, rate_limit=1e6)
    if name == "LeaseExpiry":
        far = sw.constraints.JointSpeedLimit(1e9)
        return sw.LeaseExpiry(Witness(gym.make("Reacher-v5")), sw.StoppingBudget(far, closing_speed=1.0))
    if name == "ActionShield":
        free = sw.constraints.PredictiveShield(lambda x: 1.0, 1, backup=0)
        return sw.ActionShield(Witness(gym.make(DISCRETE)), [free], plant=sw.SimulatorPlant(check_steps=0))
    if name == "SlipLimiter":  # a ground that is said to carry any torque
        return sw.SlipLimiter(Witness(gym.make("SafeRover-v0")), list(WHEELS), friction=1e9)
    if name == "WholeBodyFilter":
        cheetah = Witness(gym.make("HalfCheetah-v5"))
        return sw.WholeBodyFilter(cheetah, friction_share=1.0, tolerance=1e3, joint_tolerance=1e3)
    env_id, arguments = example(name, case)
    if name == "TeleopChannel":
        return sw.TeleopChannel(Witness(gym.make("Reacher-v5")), 0.0, 0.0)
    return getattr(sw, name)(Witness(inside(name, made(name, env_id))), **arguments())


@every_wrapper
def test_inactive_is_bit_identical(name, case):
    env = harmless(name, case)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    if name == "ActionShield":
        for action in (0, np.int64(2), np.array(1)):
            env.step(action)
            assert env.env.action == action and env.env.action_space.contains(env.env.action)
        return
    for dtype in (np.float32, np.float64):
        for _ in range(20):
            action = rng.uniform(-1, 1, env.action_space.shape).astype(dtype)
            before = action.tobytes()
            env.step(action)
            if name in CHUNKED:  # the env gets its own dtype, and the last entry that was executed last
                row = action[env.execution_horizon - 1].astype(env.env.action_space.dtype)
                assert env.env.action.tobytes() == row.tobytes() and env.env.action.dtype == row.dtype
            else:
                assert env.env.action.tobytes() == before and env.env.action.dtype == dtype
            assert action.tobytes() == before


def no_array_of_numbers(action):
    """By name: what NumPy makes no numbers of, or other numbers than were given."""
    masked = np.ma.masked_array(np.ones_like(action), np.arange(action.size).reshape(action.shape) == 0)
    rest = action.ravel()[1:].tolist()
    return {
        "beyond float64": np.array([10**400, *rest], dtype=object).reshape(action.shape).tolist(),
        "too long to print": np.array([10**5000, *rest], dtype=object).reshape(action.shape).tolist(),
        "masked": masked,
        "a list with a masked entry": list(masked),
        "text": np.full(action.shape, "0.1"),
        "ragged": ([0.5], [1, 2]),
        "nothing": None,
        "a mapping": {},
    }


@every_wrapper
def test_what_is_no_array_of_numbers_is_refused_and_does_not_get_through(name, case):
    env = build(name, case, Witness)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, env.action_space.dtype)
    for bad in no_array_of_numbers(np.atleast_1d(action)).values():
        with pytest.raises(sw.errors.ActionError, match="expected"):
            env.step(bad[0] if env.spec.id == DISCRETE and isinstance(bad, list) else bad)
        assert not env.has_wrapper_attr("action")


@every_wrapper
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_non_finite_action_does_not_get_through(name, case, bad):
    env = build(name, case, Witness)
    env.reset(seed=0)
    if env.spec.id == DISCRETE:  # not an action of the space at all
        with pytest.raises(sw.SafeWrappersError, match="expected an action of Discrete"):
            env.step(bad)
        return
    action = np.full(env.action_space.shape, bad)
    if name in ONLY_LOOKING:  # nothing inside would answer it
        with pytest.raises(sw.SafeWrappersError, match=r"finite numbers.*the env was not stepped"):
            env.step(action)
        assert not env.has_wrapper_attr("action")
        return
    if name in CHUNKED:  # it is refused, which the info says: the fallback acts
        info = env.step(action)[4]
        assert info["handover/refused"] and info["handover/starved"] == env.execution_horizon
    else:
        with pytest.warns(UserWarning, match="not finite"):
            env.step(action)
    reached = env.get_wrapper_attr("action")
    assert np.isfinite(reached).all() and env.unwrapped.action_space.contains(reached)
