"""What `protect` says of an env without a recipe: lines that work when they are run, for envs of many makes."""

import textwrap
import time
from types import SimpleNamespace
from typing import ClassVar
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.protect import recipe_names

ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body mocap="true" name="hand" pos="0 0 1"><geom size="0.01" contype="0" conaffinity="0"/></body>
    <body name="link">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder" gear="2" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>"""


class Arm(gym.Env):
    """Of MuJoCo: five physics steps of 2 ms per action."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    dt = 0.01

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(ARM)
        self.data = mujoco.MjData(self.model)

    def physics_of(self):
        return self.model, self.data

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        model, data = self.physics_of()
        mujoco.mj_resetData(model, data)
        data.qpos[:] = self.np_random.uniform(-0.1, 0.1)
        return self.observe(), {}

    def step(self, action):
        model, data = self.physics_of()
        data.ctrl[:] = action
        mujoco.mj_step(model, data, nstep=5)
        return self.observe(), 0.0, False, False, {}

    def observe(self):
        _, data = self.physics_of()
        return np.concatenate([data.qpos, data.qvel])


class Held:
    """MuJoCo's own objects in a wrapper, which cannot be copied, like dm_control's."""

    def __init__(self, ptr):
        self.ptr = ptr

    def __deepcopy__(self, memo):
        raise TypeError("cannot be copied")


class ArmOfPhysics(Arm):
    """Its model and data where dm_control's tasks have them, and nothing says how long a step lasts."""

    dt = None

    def __init__(self):
        super().__init__()
        self._env = SimpleNamespace(physics=SimpleNamespace(model=Held(self.model), data=Held(self.data)))
        del self.model, self.data

    def physics_of(self):
        return self._env.physics.model.ptr, self._env.physics.data.ptr


class ArmWithGoal(Arm):
    """Its observations are dicts, as those of envs with goals are."""

    observation_space = gym.spaces.Dict(
        {"observation": Arm.observation_space, "desired_goal": gym.spaces.Box(-1, 1, (1,), np.float64)}
    )

    def observe(self):
        return {"observation": super().observe(), "goal": np.zeros(1, np.float32)}


class ArmByHand(Arm):
    """Its four actions move a mocap body and open a gripper, like Meta-World's: none is a control."""

    action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def step(self, action):
        self.data.mocap_pos[0] += 0.01 * np.asarray(action[:3], float)
        return super().step(action[3:])


class Slider(gym.Env):
    """A point on a line, and nothing says how long its step lasts. Observed: position and speed."""

    observation_space = gym.spaces.Box(-100.0, 100.0, (2,), np.float64)

    def __init__(self, discrete=False):
        self.action_space = gym.spaces.Discrete(3, start=-1) if discrete else gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.move_to(np.zeros(2))
        return self.state_now(), {}

    def step(self, action):
        at = self.state_now()
        self.move_to(at + 0.1 * np.array([at[1], float(np.atleast_1d(action)[0])]))
        return self.state_now(), 0.0, False, False, {}

    def move_to(self, state):
        self.state = state

    def state_now(self):
        return self.state


class SliderOfServer(Slider):
    """Its state is elsewhere, under a number that copies share: PyBullet's servers are like that."""

    servers: ClassVar = {}

    def move_to(self, state):
        self.servers[7] = state

    def state_now(self):
        return self.servers[7]


class SliderOfSpace(Slider):
    """It can be copied, and then goes on otherwise: pymunk's spaces, as in PushT, lose what contacts remember."""

    class Space:
        def __init__(self):
            self.remembered = 0.0

        def __deepcopy__(self, memo):
            return type(self)()

    def reset(self, *, seed=None, options=None):
        self.space = self.Space()
        return super().reset(seed=seed)

    def step(self, action):
        self.space.remembered += 1e-3
        return super().step(np.atleast_1d(action) + self.space.remembered)


class SliderWithLock(Slider):
    """It holds what Python cannot copy."""

    def __init__(self):
        super().__init__()
        self.lock = Held(None)


class SliderOfClock(Slider):
    """It goes by the time of day: no simulation is this env."""

    def state_now(self):
        return self.state + np.array([time.perf_counter(), 0.0])


ENVS = {
    "Arm": (Arm, "JointSpeedLimit", ""),
    "ArmOfPhysics": (ArmOfPhysics, "JointSpeedLimit", "MujocoPlant"),
    "ArmWithGoal": (ArmWithGoal, "JointSpeedLimit", ""),
    "ArmByHand": (ArmByHand, "PredictiveShield", ""),
    "Slider": (Slider, "PredictiveShield", ""),
    "discrete Slider": (lambda: Slider(discrete=True), "PredictiveShield", ""),
    "SliderOfServer": (SliderOfServer, "PredictiveShield", "fork"),
    "SliderOfSpace": (SliderOfSpace, "PredictiveShield", "fork"),
    "SliderWithLock": (SliderWithLock, "PredictiveShield", "fork"),
}
"""What makes each env, the constraint that is named, and the plant."""


def refusal(env):
    with pytest.raises(ConfigurationError) as caught:
        sw.protect(env)
    return str(caught.value)


def lines_of(message):
    return textwrap.dedent("\n".join(line for line in message.splitlines() if line.startswith("    ")))


def filtered_as_told(env, **given):
    """The filtered env that the refusal's lines make, and all that they name."""
    scope = {"env": env} | given
    exec(lines_of(refusal(env)), scope)
    return scope


@pytest.mark.parametrize("name", ENVS)
def test_the_lines_that_are_told_filter_the_env(name):
    make, constraint, plant = ENVS[name]
    env, discrete = make(), "discrete" in name
    message = refusal(env)
    lines = lines_of(message)
    assert constraint in lines and plant in lines and ("plant=" in lines) == bool(plant)
    given = {"h": lambda seen: 1.0, "horizon": 2, "backup": "zero"}
    if "Slider" in name:
        given["h"] = lambda seen: 0.25 - abs(seen[1])
        given["backup"] = lambda seen: -int(np.sign(seen[1])) if discrete else [-np.sign(seen[1])]
    scope = {"env": env} | given
    exec(lines, scope)
    filtered, changed = scope["env"], 0
    filtered.reset(seed=0)
    for _ in range(8 if plant == "fork" else 60):
        action = 1 if discrete else np.ones(env.action_space.shape, np.float32)
        observation, *_, info = filtered.step(action)
        assert not info["cbf/infeasible"]
        changed += info["cbf/intervened"]
        if "Slider" in name:
            assert abs(observation[1]) <= 0.25
    assert changed or name == "ArmByHand"


def test_a_vector_env_gets_lines_for_all_of_its_envs():
    with mock.patch.dict(gym.registry):
        gym.register("lab/Arm-v0", entry_point=Arm)
        env = gym.make_vec("lab/Arm-v0", 2, vectorization_mode="sync")
        scope = {"env": env}
        exec(lines_of(refusal(env)), scope)
    scope["env"].reset(seed=0)
    assert scope["env"].step(np.ones((2, 1), np.float32))[4]["cbf/margin"].shape == (2,)


def test_an_unknown_machine_that_is_pushed_at_a_site_gets_lines_that_name_its_joints():
    with mock.patch.dict(gym.registry):
        gym.register("lab/Pushed-v0", entry_point=lambda: gym.make("SafePointGoal0-v0").unwrapped)
        env = gym.make("lab/Pushed-v0")
        scope = {"env": env}
        exec(lines_of(refusal(env)), scope)
    assert scope["limit"].joints == ["x", "y", "z"]
    scope["env"].reset(seed=0)
    scope["env"].step(scope["env"].action_space.sample())


def test_recipes_of_similar_names_are_told_after_the_lines_and_not_all():
    with mock.patch.dict(gym.registry):
        gym.register("lab/Swimer-v3", entry_point="gymnasium.envs.mujoco.swimmer_v5:SwimmerEnv")
        message = refusal(gym.make("lab/Swimer-v3"))
    assert message.startswith("no recipe for 'lab/Swimer-v3'.")
    named = message.partition("Recipes of similar names: ")[2].split(", ")
    assert named[0] == "Swimmer" and len(named) <= 3 and set(named) <= set(recipe_names())
    assert message.index("sw.CBFActionFilter") < message.index("Recipes of similar names")


def test_an_env_that_no_line_protects_is_told_why_and_not_what_was_tried_in_vain():
    message = refusal(SliderOfClock())
    assert "A filter by hand is refused, too: " in message and "observation[0]" in message
    assert not lines_of(message) and "fork" not in message
    picture = Slider()
    picture.action_space = gym.spaces.Box(-1.0, 1.0, (2, 2))
    assert "gymnasium.spaces.flatten_space(space)" in refusal(picture)
