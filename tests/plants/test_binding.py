"""What a MujocoPlant finds of an env: its model and data, how long a step lasts, what it makes of an action.

The oracles are the env's own steps, and a twin of the machine whose actions are its controls.
"""

from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound
from scenes import make

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError

MACHINE = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <body name="wall" pos="2 0 0"><geom type="box" size="0.1 1 1"/></body>
    <body name="box"><joint name="x" type="slide" axis="1 0 0" damping="0.5"/><geom size="0.1" mass="2"/></body>
    <body name="arm" pos="0 3 0"><joint name="turn" axis="0 0 1" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05" mass="1"/></body>
  </worldbody>
  <actuator>
    <motor name="push" joint="x" gear="5" {push}/>
    <position name="servo" joint="turn" kp="8" ctrlrange="-2 1" {servo}/>
  </actuator>
</mujoco>
"""
OFFSET, SCALE = np.array([0.5, -0.5]), np.array([-3.0, 1.5])


class Machine(gym.Env):
    """A slide with a motor and a hinge with a position servo; an action is `(control - OFFSET) / SCALE`.

    `how` is what it does instead with its actions.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    dt, frame_skip = 0.02, 4

    push = 'ctrlrange="-2.5 3.5"'

    def __init__(self, offset=OFFSET, scale=SCALE, push=push, servo="", low=-1.0, high=1.0, how=""):
        self.model = mujoco.MjModel.from_xml_string(MACHINE.format(push=push, servo=servo))
        self.data, self.how = mujoco.MjData(self.model), how
        self.offset, self.scale = np.broadcast_to(offset, 2), np.broadcast_to(scale, 2)
        low, high = (np.broadcast_to(end, 2) for end in (low, high))
        self.action_space = gym.spaces.Box(low, high, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[:] = self.np_random.uniform(-1.0, 1.0, 2)
        mujoco.mj_forward(self.model, self.data)
        return self.observed(), {}

    def observed(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def step(self, action):
        control = self.offset + self.scale * np.clip(action, self.action_space.low, self.action_space.high)
        if self.how == "relative":
            control = self.data.qpos + 0.1 * action
        elif self.how == "squared":
            control = np.sign(control) * control**2
        elif self.how == "frozen":
            raise RuntimeError("no robot is connected")
        self.data.ctrl[:] = control
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        return self.observed(), 0.0, False, False, {}


class Plain(Machine):
    """The same machine, whose actions are its controls."""

    def __init__(self, **changed):
        low, high = OFFSET - np.abs(SCALE), OFFSET + np.abs(SCALE)
        super().__init__(offset=0.0, scale=1.0, low=low, high=high, **changed)


# Where the model and the data are, and how long a step lasts ------------------------------------------------------


class Nested(gym.Env):
    """A machine whose model and data are two levels down, and which does not say how long a step lasts."""

    observation_space = Machine.observation_space

    def __init__(self, inner):
        self.sim = SimpleNamespace(
            model=SimpleNamespace(ptr=inner.model), data=SimpleNamespace(ptr=inner.data)
        )
        self.inner, self.action_space = [inner], inner.action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.inner[0].reset(seed=seed)

    def step(self, action):
        return self.inner[0].step(action)


@pytest.mark.parametrize("machine", [Plain, Machine], ids=["control", "mapped"])
def test_a_filter_keeps_a_limit_of_a_machine_two_levels_down(machine):
    plant = sw.MujocoPlant(
        model=lambda env: env.sim.model.ptr, data=lambda env: env.sim.data.ptr, control_dt=0.02
    )
    limit = sw.constraints.JointSpeedLimit(limit=1.2, joints=["x"], margin=0.01)
    env = Nested(machine())
    filtered = sw.CBFActionFilter(env, [limit], plant=plant)
    assert plant.substeps == 4 and plant.control_dt == pytest.approx(0.02)
    assert (plant.action_map is None) == (machine is Plain)
    filtered.reset(seed=0)
    rng, fastest, changed = np.random.default_rng(0), 0.0, 0
    for k in range(80):
        action = rng.uniform(env.action_space.low, env.action_space.high) if k < 20 else env.action_space.high
        state, *_, info = filtered.step(action)
        fastest, changed = max(fastest, abs(state[2])), changed + info["cbf/intervened"]
        assert np.array_equal(plant.rollout(info["executed_action"]).states[-1], state)
        assert not info["cbf/infeasible"]
    assert 1.1 < fastest <= 1.2 and changed


class FromDmControl(gym.Env):
    """A user's own env around one of dm_control's."""

    def __init__(self, task, scale):
        suite = pytest.importorskip("dm_control.suite")
        self.inner, self.scale = suite.load(*task.split("-"), task_kwargs={"random": 0}), scale
        self.physics, spec = self.inner.physics, self.inner.action_spec()
        self.action_space = gym.spaces.Box(spec.minimum / scale, spec.maximum / scale, spec.shape, np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.physics.get_state().size,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.inner.reset()
        return self.physics.get_state(), {}

    def step(self, action):
        self.inner.step(self.scale * action)
        return self.physics.get_state(), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("task", "scale"),
    [("cartpole-balance", 1.0), ("walker-walk", 0.5), ("finger-spin", 0.5), ("humanoid-run", 1.0)],
)
def test_a_step_of_a_dm_control_task_is_its_forecast(task, scale):
    env = FromDmControl(task, scale)
    plant = sw.MujocoPlant(
        model=lambda raw: raw.inner.physics.model.ptr,
        data=lambda raw: raw.inner.physics.data.ptr,
        control_dt=env.inner.control_timestep(),
    )
    plant.bind(env)
    assert (plant.action_map is None) == (scale == 1.0)
    rng, data = np.random.default_rng(0), env.physics.data.ptr
    for k in range(200):
        if k % 100 == 0:
            env.reset(seed=k)
            plant.executed(None)
        plant.observe()
        action = rng.uniform(env.action_space.low, env.action_space.high)
        end = plant.rollout(action).states[-1]
        env.step(action)
        # 0.0 with dm_control 1.0.44 and MuJoCo 3.11
        np.testing.assert_allclose(end, np.concatenate([data.qpos, data.qvel]), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("env_id", "substeps", "control_dt"), [("AntMaze_UMaze-v5", 5, 0.05), ("PointMaze_UMaze-v3", 1, 0.01)]
)
def test_the_hold_of_a_maze_is_the_inner_env_s(env_id, substeps, control_dt):
    env = make(env_id)
    plant = bound(env)
    assert plant.substeps == substeps and plant.control_dt == pytest.approx(control_dt)
    env.reset(seed=0)
    before = env.unwrapped.data.time
    env.step(np.zeros(env.action_space.shape, env.action_space.dtype))
    assert env.unwrapped.data.time - before == pytest.approx(plant.control_dt)


@pytest.mark.parametrize(
    ("frame_skip", "control_dt", "got"),
    [
        (0, None, "no control_dt, and 0 by"),
        (5, 0.02, "4 by control_dt, and 5 by"),
        (None, 0.0125, "2.5 by control_dt, and nothing by"),
    ],
)
def test_a_control_step_that_is_no_whole_number_of_physics_steps_is_refused(frame_skip, control_dt, got):
    env = Plain()
    env.frame_skip = None  # it says it by dt alone
    assert bound(env).substeps == 4
    env.frame_skip = env.dt = frame_skip
    with pytest.raises(ConfigurationError, match=rf"steps of 0\.005 s.*got {got} .*: leave control_dt"):
        bound(env, control_dt=control_dt)


# Actions that the env makes controls of ---------------------------------------------------------------------------


def test_the_map_is_found_whatever_its_signs_and_whether_the_control_is_limited():
    for env in (
        Machine(),
        Machine(push=""),
        Machine(scale=[-3.0, 0.0]),
        Machine(low=[-1.0, -0.5], high=[0.5, 1.0]),
    ):
        env.reset(seed=0)
        before = env.observed().tobytes(), env.data.ctrl.tobytes(), env.np_random.bit_generator.state
        found = bound(env).action_map
        assert before == (
            env.observed().tobytes(),
            env.data.ctrl.tobytes(),
            env.np_random.bit_generator.state,
        )
        np.testing.assert_allclose(found.offset, env.offset, atol=1e-12)
        np.testing.assert_allclose(found.scale, env.scale, atol=1e-12)
    assert bound(Machine(0.0, 1.0, push="", low=[-1.0, -2.0], high=[1.0, 1.0])).action_map is None
    unlimited = bound(Plain(push=""))
    assert unlimited.action_map is None and unlimited.lower[0] == -np.inf
    narrow = bound(Machine(0.0, 1.0))  # a control as it is, but of a narrower range
    assert narrow.action_map.is_identity and (narrow.upper == 1.0).all()


@pytest.mark.parametrize("servo", ["", 'forcerange="-3 2"'])
def test_acceleration_acting_range_braking_and_rollouts_are_the_twin_s_in_other_units(servo):
    env, twin = Machine(servo=servo), Plain(servo=servo)
    plant, plain = bound(env), bound(twin)
    rng = np.random.default_rng(0)
    for _ in range(20):
        env.data.qpos[:] = twin.data.qpos[:] = rng.uniform(-1.0, 1.0, 2)
        env.data.qvel[:] = twin.data.qvel[:] = rng.uniform(-3.0, 3.0, 2)
        plant.observe()
        plain.observe()
        action = rng.uniform(*plant.acting_range)
        (drift, effect), (its_drift, its_effect) = plant.acceleration, plain.acceleration
        control = OFFSET + SCALE * action
        np.testing.assert_allclose(drift + effect @ action, its_drift + its_effect @ control, atol=1e-9)
        mapped = np.sort(OFFSET + SCALE * np.array(plant.acting_range), axis=0)
        np.testing.assert_allclose(mapped, plain.acting_range, atol=1e-12)
        np.testing.assert_allclose(OFFSET + SCALE * plant.braking(), plain.braking(), atol=1e-12)
        longer = plant.rollout(action, 3).states
        np.testing.assert_allclose(longer, plain.rollout(control, 3).states, atol=1e-12)


LIMITS = {
    "speed and clearance": [
        sw.constraints.JointSpeedLimit(limit=[1.0, 1.5], joints=["x", "turn"], margin=0.01),
        sw.constraints.Clearance([sw.constraints.Plane([1.2, 0.0], [-1.0, 0.0])], 3.0, bodies=["box"]),
    ],
    "impact": [
        sw.constraints.ImpactSpeedLimit(["box"], ["wall"], force_limit=60.0, stiffness=2e4, margin=1.0)
    ],
}


@pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
def test_a_filter_decides_as_on_the_twin(limits):
    env, twin = (sw.CBFActionFilter(machine, limits) for machine in (Machine(), Plain()))
    env.reset(seed=3)
    twin.reset(seed=3)
    its, mine = twin.unwrapped.data, env.unwrapped.data
    rng, changed = np.random.default_rng(0), 0
    for k in range(100):
        action = np.array([-1.0, rng.choice([-1.0, 1.0])]) if k > 10 else rng.uniform(-1.0, 1.0, 2)
        *_, info = env.step(action)
        *_, other = twin.step(OFFSET + SCALE * action)
        changed += info["cbf/intervened"]
        assert info["cbf/intervened"] == other["cbf/intervened"]
        executed = OFFSET + SCALE * info["executed_action"]
        np.testing.assert_allclose(executed, other["executed_action"], atol=1e-9)
        its.qpos[:], its.qvel[:], its.qacc_warmstart[:] = mine.qpos, mine.qvel, mine.qacc_warmstart
    assert changed >= 5


def taking(size, wrapped=False):
    """A machine with another action space, or in a wrapper that has one."""
    env = gym.Wrapper(Machine()) if wrapped else Machine()
    env.action_space = gym.spaces.Box(-2.0, 2.0, (size,))
    return env


REFUSED = {
    partial(
        Machine, how="relative"
    ): r"in 100 steps .* up to \d.* away from that, at actuator '(push|servo)'",
    partial(Machine, how="squared"): r"not by control = offset \+ scale \* action.*AnalyticPlant",
    partial(Machine, how="frozen"): r"no copy .* \(RuntimeError: no robot is connected\).*AnalyticPlant\(",
    partial(taking, 1): "has not one action for each control. Use AnalyticPlant",
    partial(taking, 2, wrapped=True): "a wrapper of .* changes its action space; the filter must be inside",
    partial(make, "FetchReach-v4"): r"moves its gripper by displacements: take DisplacementPlant\(\)",
    partial(gym.make, "Pendulum-v1"): r"has no MuJoCo .*; .*AnalyticPlant.*MujocoPlant\(model=",
}


@pytest.mark.parametrize(("build", "says"), REFUSED.items(), ids=range(len(REFUSED)))
def test_an_env_that_does_something_else_is_refused_with_what_to_take_instead(build, says):
    with pytest.raises(UnsupportedEnvError, match=says):
        bound(build())


@pytest.mark.parametrize(
    "constraint",
    [
        sw.constraints.Stance(),
        sw.constraints.Traction(["turn"], max_slip=0.1),
        sw.constraints.WallClearance(),
        sw.constraints.HeadingDriveClearance([sw.constraints.Disc([5.0, 0.0], 1.0)], body="box"),
    ],
    ids=lambda one: type(one).__name__,
)
def test_what_reads_controls_off_the_model_is_refused(constraint):
    with pytest.raises(UnsupportedEnvError, match="needs actions that are the model's controls"):
        sw.CBFActionFilter(Machine(), [constraint])
