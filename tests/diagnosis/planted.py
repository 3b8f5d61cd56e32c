"""Envs and policies with one fault each, and healthy ones: what `diagnose` has to find, and to leave alone."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import mujoco
import numpy as np

import safe_wrappers as sw

Policy = Callable[[Any], Any]
Made = tuple[gym.Env[Any, Any], Policy | None]
gym.register_envs(gymnasium_robotics)


def waving(env: gym.Env[Any, Any], share: float = 0.3, period: float = 60.0, seam: int = 0) -> Policy:
    """Slow sines; with a `seam` another phase every so many steps, as chunks have that do not fit together."""
    high, state = env.action_space.high.astype(float), {"k": 0, "phase": 0.0}  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)

    def act(observation: Any) -> Any:
        if seam and state["k"] % seam == 0:
            state["phase"] = rng.uniform(0.0, 2.0 * np.pi)
        state["k"] += 1
        angle = 2.0 * np.pi * state["k"] / period + state["phase"] + np.arange(high.size)
        return (share * high * np.sin(angle)).astype(env.action_space.dtype)

    return act


CART = """
<mujoco><compiler autolimits="true"/><option timestep="0.002"/><worldbody>
  <geom type="box" name="wall" pos="1.05 0 0" size=".05 .3 .3" solref="-{stiffness} -20"/>
  <body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom size=".05" mass="1" solref="-{stiffness} -20"/></body>
  </worldbody><actuator><motor joint="slide" ctrlrange="-20 20"/></actuator></mujoco>
"""
STOPPED = """
<mujoco><compiler autolimits="true"/><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body><joint name="swing" axis="0 0 1" range="-60 60" damping=".01"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1"/></body>
  </worldbody><actuator><motor joint="swing" ctrlrange="-4 4"/></actuator></mujoco>
"""


class Bench(gym.Env[Any, Any]):
    """A machine of a few parts; the observation is its state."""

    frame_skip = 5

    def __init__(self, xml: str, start: Any = None) -> None:
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.start = np.zeros(self.model.nq) if start is None else np.array(start)
        self.dt = self.frame_skip * self.model.opt.timestep
        low, high = self.model.actuator_ctrlrange.T
        self.action_space = gym.spaces.Box(low, high, dtype=np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.model.nq + self.model.nv,), np.float64)
        self.steps = 0

    def _get_obs(self) -> Any:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.start + self.np_random.uniform(-0.01, 0.01, self.model.nq)
        mujoco.mj_forward(self.model, self.data)
        self.steps = 0
        return self._get_obs(), {}

    def step(self, action: Any) -> Any:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        self.steps += 1
        return self._get_obs(), 0.0, False, self.steps >= 400, {}


def _with(env: gym.Env[Any, Any], policy: Callable[[Any], Policy] | None = None) -> Made:
    return env, None if policy is None else policy(env)


PLANTED: dict[str, tuple[str, int, Callable[[], Made]]] = {
    "chunks that do not fit together": (
        "command_steps", 200, lambda: _with(gym.make("Swimmer-v5"), lambda env: waving(env, seam=10)),
    ),
    "chunks on joints that ring": (
        "command_steps", 300,
        lambda: _with(gym.make("FlexJointReach-v0"), lambda env: waving(env, 0.5, 200.0, seam=24)),
    ),
    "icy ground": ("wheel_slip", 200, lambda: _with(gym.make("SafeRover-v0"))),
    "a stiff wall": (
        "contact_forces", 300,
        lambda: _with(Bench(CART.format(stiffness=40_000)), lambda env: waving(env, 0.5, 200.0)),
    ),
    "a maze with stiff walls": ("contact_forces", 300, lambda: _with(gym.make("PointMaze_UMaze-v3"))),
    "a stop that is run into": ("limits", 300, lambda: _with(Bench(STOPPED), lambda env: waving(env, 0.5, 100.0))),
    "hazards": (
        "limits", 1000, lambda: _with(gym.make("SafePointGoal1-v0"), lambda env: waving(env, 0.5, 100.0)),
    ),
    "a speed limit": (
        "limits", 300, lambda: _with(gym.make("SafeSwimmerVelocity-v0"), lambda env: waving(env, 1.0, 25.0)),
    ),
}  # fmt: skip
"""What is planted, for how many steps it is looked at, and the env and its policy."""
HEALTHY: dict[str, Callable[[], Made]] = {
    "Swimmer, waving": lambda: _with(gym.make("Swimmer-v5"), waving),
    "FetchReach, waving slowly": lambda: _with(gym.make("FetchReach-v4"), lambda env: waving(env, 0.2)),
    "SafeRover, slowly": lambda: _with(
        sw.protect(gym.make("SafeRover-v0")), lambda env: waving(env, 0.2, 200.0)
    ),
    "swing, waving": lambda: _with(Bench(STOPPED), lambda env: waving(env, 0.02, 60.0)),
    "SafePointGoal1, protected": lambda: _with(sw.protect(gym.make("SafePointGoal1-v0"))),
    "Reacher, waving": lambda: _with(gym.make("Reacher-v5"), lambda env: waving(env, 0.05)),
    "FlexJointReach, waving": lambda: _with(
        gym.make("FlexJointReach-v0"), lambda env: waving(env, 0.15, 200.0)
    ),
    "TeleopContact through waves, in the air": lambda: _with(
        sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1, impedance=40.0),
        lambda env: waving(env, 0.02, 500.0),
    ),
}
