"""Envs that make controls of actions in their own step: the map is found, and everything counts in actions.

The oracles are the env's own steps, and a twin of the machine whose actions are its controls.
"""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import bound

import safe_wrappers as sw
from safe_wrappers.errors import UnsupportedEnvError

HANDS = ["HandReach-v3", *(f"AdroitHand{task}-v1" for task in ("Door", "Hammer", "Pen", "Relocate"))]
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
    """A slide with a motor and a hinge with a position servo; an action is `(control - OFFSET) / SCALE`."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    dt, frame_skip = 0.02, 4

    def __init__(self, offset=OFFSET, scale=SCALE, push='ctrlrange="-2.5 3.5"', servo="", low=-1.0, high=1.0):
        self.model = mujoco.MjModel.from_xml_string(MACHINE.format(push=push, servo=servo))
        self.data = mujoco.MjData(self.model)
        self.offset, self.scale = np.broadcast_to(offset, 2), np.broadcast_to(scale, 2)
        self.action_space = gym.spaces.Box(
            np.broadcast_to(low, 2), np.broadcast_to(high, 2), (2,), np.float64
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[:] = self.np_random.uniform(-1.0, 1.0, 2)
        mujoco.mj_forward(self.model, self.data)
        return self.observed(), {}

    def observed(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def step(self, action):
        self.act(self.offset + self.scale * np.clip(action, self.action_space.low, self.action_space.high))
        return self.observed(), 0.0, False, False, {}

    def act(self, control):
        self.data.ctrl[:] = control
        mujoco.mj_step(self.model, self.data, self.frame_skip)


class Plain(Machine):
    """The same machine, whose actions are its controls."""

    def __init__(self, **changed):
        ends = OFFSET - np.abs(SCALE), OFFSET + np.abs(SCALE)
        super().__init__(offset=0.0, scale=1.0, low=ends[0], high=ends[1], **changed)


@pytest.fixture(scope="module", params=HANDS)
def hand(request):
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    return gym.make(request.param, disable_env_checker=True)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_a_step_of_a_robotic_hand_is_its_forecast_to_the_last_bit(hand):
    raw, rng = hand.unwrapped, np.random.default_rng(0)
    hand.reset(seed=7)
    before = raw.data.qpos.tobytes(), raw.data.ctrl.tobytes(), raw.np_random.bit_generator.state
    plant = bound(hand)
    assert before == (raw.data.qpos.tobytes(), raw.data.ctrl.tobytes(), raw.np_random.bit_generator.state)
    assert plant.action_map is not None and (plant.lower == -1.0).all() and (plant.upper == 1.0).all()
    for k in range(200):
        if k % 50 == 0:  # episodes differ in where the door, the nail or the target is
            hand.reset(seed=k)
            plant.executed(None)
        plant.observe()
        action = rng.uniform(-1.0, 1.0, plant.lower.size).astype(np.float32)
        if k % 2:
            action = np.sign(action)
        end = plant.rollout(action.astype(np.float64)).states[-1]
        hand.step(action)
        assert np.array_equal(end, np.concatenate([raw.data.qpos, raw.data.qvel]))


def test_the_map_is_found_whatever_its_signs_and_whether_the_control_is_limited():
    for env in (
        Machine(),
        Machine(push=""),
        Machine(scale=[-3.0, 0.0]),
        Machine(low=[-1.0, -0.5], high=[0.5, 1.0]),
    ):
        found = bound(env).action_map
        np.testing.assert_allclose(found.offset, env.offset, atol=1e-12)
        np.testing.assert_allclose(found.scale, env.scale, atol=1e-12)
    assert bound(Machine(0.0, 1.0, push="", low=[-1.0, -2.0], high=[1.0, 1.0])).action_map is None
    unlimited = bound(Plain(push=""))
    assert unlimited.action_map is None and unlimited.lower[0] == -np.inf
    narrow = bound(Machine(0.0, 1.0))  # a control as it is, but of a narrower range
    assert narrow.action_map.is_identity and (narrow.upper == 1.0).all()


@pytest.mark.parametrize("servo", ["", 'forcerange="-3 2"'])
def test_acceleration_and_acting_range_are_those_of_the_twin_in_other_units(servo):
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


@pytest.mark.parametrize(
    "constraint",
    [
        sw.constraints.JointSpeedLimit(limit=[1.0, 1.5], joints=["x", "turn"], margin=0.01),
        sw.constraints.Clearance(
            [sw.constraints.Plane([1.2, 0.0], [-1.0, 0.0])], 3.0, bodies=["box"], margin=0.01
        ),
        sw.constraints.ImpactSpeedLimit(
            bodies=["box"], against=["wall"], force_limit=60.0, stiffness=20_000.0, margin=1.0
        ),
    ],
    ids=lambda one: type(one).__name__,
)
def test_a_filter_decides_as_on_the_twin(constraint):
    env, twin = (sw.CBFActionFilter(made, [constraint]) for made in (Machine(), Plain()))
    env.reset(seed=3)
    twin.reset(seed=3)
    rng, changed = np.random.default_rng(0), 0
    for k in range(150):
        action = np.array([-1.0, rng.choice([-1.0, 1.0])]) if k > 10 else rng.uniform(-1.0, 1.0, 2)
        *_, info = env.step(action)
        *_, its = twin.step(OFFSET + SCALE * action)
        changed += info["cbf/intervened"]
        assert info["cbf/intervened"] == its["cbf/intervened"]
        np.testing.assert_allclose(
            OFFSET + SCALE * info["executed_action"], its["executed_action"], atol=2e-4
        )
        twin.unwrapped.data.qpos[:], twin.unwrapped.data.qvel[:] = (
            env.unwrapped.data.qpos,
            env.unwrapped.data.qvel,
        )
        twin.unwrapped.data.qacc_warmstart[:] = env.unwrapped.data.qacc_warmstart
    assert changed >= 5  # the speed limit on impact acts while the arm approaches, then it rests


class Relative(Machine):
    def step(self, action):
        self.act(self.data.qpos + 0.1 * action)
        return self.observed(), 0.0, False, False, {}


class Ramp(Machine):
    def act(self, control):
        before = self.data.ctrl.copy()
        for part in range(1, 5):
            self.data.ctrl[:] = before + (control - before) * part / 4
            mujoco.mj_step(self.model, self.data)


def test_a_control_that_is_not_held_is_a_mismatch_at_every_step():
    env = sw.CBFActionFilter(Ramp(), [sw.constraints.JointSpeedLimit(50.0)])
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="from its forecast"):
        assert all(env.step(action)[4]["cbf/mismatch"] for action in ([0.5, 0.5], [-0.5, 0.0]))


class Squared(Machine):
    def act(self, control):
        super().act(np.sign(control) * control**2)


class Frozen(Machine):
    def step(self, action):
        raise RuntimeError("no robot is connected")


@pytest.mark.parametrize(
    ("env", "says"),
    [
        (
            Relative(),
            r"not by control = offset \+ scale \* action: in 100 steps .* up to \d.* away .*'(push|servo)'",
        ),
        (Squared(), r"not by control = offset \+ scale \* action.*AnalyticPlant"),
        (
            Frozen(),
            r"no copy of it can be stepped to find out how \(RuntimeError: no robot is connected\).*AnalyticPlant\(",
        ),
    ],
)
def test_what_is_no_map_is_refused(env, says):
    with pytest.raises(UnsupportedEnvError, match=says):
        bound(env)


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
