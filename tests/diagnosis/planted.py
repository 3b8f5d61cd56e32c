"""Envs and policies with one fault each, and healthy ones: what `diagnose` has to find, and to leave alone."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks.mujoco_drivers import balancing_gain
from safe_wrappers.envs.teleop_operator import TeleopOperator

Policy = Callable[[Any], Any]
Made = tuple[gym.Env[Any, Any], Policy | None]
gym.register_envs(gymnasium_robotics)


class LateBothWays(gym.Wrapper[Any, Any, Any, Any]):
    """A plain link: actions go up and observations come down, each so many steps late."""

    def __init__(self, env: gym.Env[Any, Any], steps: int) -> None:
        super().__init__(env)
        self.late = steps

    def reset(self, **options: Any) -> Any:
        observation, info = self.env.reset(**options)
        self.up = [np.zeros(self.action_space.shape, self.action_space.dtype)] * self.late
        self.down = [observation] * self.late
        return observation, info

    def step(self, action: Any) -> Any:
        self.up.append(np.array(action))
        observation, *rest = self.env.step(self.up.pop(0))
        self.down.append(observation)
        return self.down.pop(0), *rest


class Operating(TeleopOperator):
    """The scripted operator as a policy."""

    def __call__(self, observation: Any) -> Any:
        return self.act(observation)


class Late(gym.Wrapper[Any, Any, Any, Any]):
    """Executes every action so many steps late."""

    def __init__(self, env: gym.Env[Any, Any], steps: int) -> None:
        super().__init__(env)
        self.late = steps

    def reset(self, **options: Any) -> Any:
        self.queue = [np.zeros(self.action_space.shape, self.action_space.dtype)] * self.late
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        self.queue.append(np.asarray(action))
        return self.env.step(self.queue.pop(0))


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


def without_speeds(env: gym.Env[Any, Any]) -> Policy:
    """`balancing`, with speeds from the last two positions."""
    feedback, state = balancing(env), {"before": np.zeros(2)}
    dt = env.unwrapped.dt  # type: ignore[attr-defined]

    def act(seen: Any) -> Any:
        speeds = (seen - state["before"]) / dt
        state["before"] = np.array(seen)
        return feedback(np.concatenate([seen, np.clip(speeds, -1.0, 1.0)]))

    return act


def still(env: gym.Env[Any, Any]) -> Policy:
    """Nothing."""
    return lambda observation: np.zeros(env.action_space.shape, env.action_space.dtype)  # type: ignore[arg-type]


def balancing(env: gym.Env[Any, Any]) -> Policy:
    """A linear quadratic regulator of InvertedPendulum, from differences of one control step."""
    gain = balancing_gain(env.unwrapped, effort=0.1)
    return lambda x: np.clip(-gain @ x, -3.0, 3.0).astype(np.float32)


ARM = """
<mujoco><compiler autolimits="true"/><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 0 1" damping="0.05"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="1" contype="0" conaffinity="0"/>
    <body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 0 1" damping="0.05"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".5" contype="0" conaffinity="0"/>
      <body name="tip" pos=".3 0 0"><geom size=".01" mass=".05" contype="0" conaffinity="0"/></body></body></body>
  </worldbody><actuator><velocity joint="shoulder" kv="5" ctrlrange="-30 30"/>
  <velocity joint="elbow" kv="5" ctrlrange="-30 30"/></actuator></mujoco>
"""
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

TURNTABLE = """
<mujoco><compiler autolimits="true"/><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body><joint name="turn" axis="0 0 1" damping=".1"/><geom type="cylinder" size=".3 .02" mass="2"/>
    <site name="imu" pos="{arm} 0 0"/></body></worldbody>
  <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator>
  <sensor><accelerometer site="imu"/><gyro site="imu"/></sensor></mujoco>
"""


HIDDEN = """
<mujoco><compiler autolimits="true"/><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <geom name="pillar" type="box" pos="0 1 0" size=".2 .05 .3"/>
  <body name="cart"><joint name="slide" type="slide" axis="1 0 0" range="-1 1" damping="2"/>
    <geom size=".1" mass="1"/><camera name="eye" pos="0 .12 0" xyaxes="1 0 0 0 0 1" fovy="110"/></body>
  <body name="ball" pos="0 2 0"><joint name="ball" type="slide" axis="1 0 0" stiffness="1"/>
    <geom size=".1" mass="1"/></body>
  </worldbody><actuator><motor joint="slide" ctrlrange="-2 2"/></actuator></mujoco>
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


def partly(env: gym.Env[Any, Any], left_out: list[int]) -> gym.Env[Any, Any]:
    """The env without some entries of its observation."""
    low, high = (np.delete(end, left_out) for end in (env.observation_space.low, env.observation_space.high))  # type: ignore[attr-defined]
    return gym.wrappers.TransformObservation(
        env, lambda seen: np.delete(seen, left_out), gym.spaces.Box(low, high, dtype=np.float64)
    )


def tracing(env: Bench, center: float, width: float) -> Policy:
    """Moves the tip to and fro along x at 0.3 m/s by resolved rates, around `center`."""
    model, data = env.model, mujoco.MjData(env.model)
    jacobian = np.zeros((3, model.nv))
    state = {"k": 0}

    def act(observation: Any) -> Any:
        data.qpos[:] = observation[: model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBody(model, data, jacobian, None, model.body("tip").id)
        state["k"] += 1
        target = np.array([center + width * np.sin(0.3 / width * state["k"] * env.dt), 0.0])
        error = target - data.body("tip").xpos[:2]
        return np.clip(np.linalg.pinv(jacobian[:2], rcond=1e-3) @ (5.0 * error), -30.0, 30.0)

    return act


def holding(env: Bench, at: float) -> Policy:
    """A gentle spring and damper to a position."""
    return lambda x: np.clip(2.0 * (at - x[:1]) - 3.0 * x[1:], -3.0, 3.0)


def stiffened(env: gym.Env[Any, Any], times: float) -> gym.Env[Any, Any]:
    """The same joints, with so much stiffer and more damped springs."""
    raw: Any = env.unwrapped
    springs = raw.model.jnt_stiffness > 0.0
    raw.model.jnt_stiffness[springs] *= times
    raw.model.dof_damping[raw.model.jnt_dofadr[springs]] *= times
    return env


def _with(env: gym.Env[Any, Any], policy: Callable[[Any], Policy] | None = None) -> Made:
    return env, None if policy is None else policy(env)


def _lease(env: gym.Env[Any, Any]) -> Made:
    policy = waving(env)
    return sw.faults.Outages(env, mean_length_s=0.3, mean_between_s=1.0), policy


PLANTED: dict[str, tuple[str, Callable[[], Made]]] = {
    "chunks that do not fit together": (
        "command_steps",
        lambda: _with(gym.make("Swimmer-v5"), lambda env: waving(env, seam=10)),
    ),
    "chunks on a position-controlled arm": (
        "command_steps",
        lambda: _with(gym.make("FetchReach-v4"), lambda env: waving(env, 0.5, seam=8)),
    ),
    "commands three steps late": (
        "loop_margin",
        lambda: (Late(base := gym.make("InvertedPendulum-v5"), 3), balancing(base)),
    ),
    "commands two steps late": (
        "loop_margin",
        lambda: (Late(base := gym.make("InvertedPendulum-v5"), 2), balancing(base)),
    ),
    "a link that falls silent": ("late_commands", lambda: _lease(gym.make("Swimmer-v5"))),
    "an IMU off the turning axis": (
        "lever_arms",
        lambda: _with(Bench(TURNTABLE.format(arm=0.25)), lambda env: waving(env, 0.5, 100.0)),
    ),
    "icy ground": ("wheel_slip", lambda: _with(gym.make("SafeRover-v0"))),
    "a path through a singular pose": (
        "singular_poses",
        lambda: _with(env := Bench(ARM, [0.8, -1.6]), lambda _: tracing(env, 0.45, 0.165)),
    ),
    "a stiff wall": (
        "contact_forces",
        lambda: _with(Bench(CART.format(stiffness=40_000)), lambda env: waving(env, 0.5, 200.0)),
    ),
    "a stop that is run into": ("limits", lambda: _with(Bench(STOPPED), lambda env: waving(env, 0.5, 100.0))),
    "hazards": ("limits", lambda: _with(gym.make("SafePointGoal1-v0"))),
    "a speed limit": (
        "limits",
        lambda: _with(gym.make("SafeSwimmerVelocity-v0"), lambda env: waving(env, 1.0, 25.0)),
    ),
    "a plain channel, 0.1 s each way": (
        "port_energy",
        lambda: (sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1), Operating()),
    ),
    "a plain link of one's own, 0.06 s each way": (
        "port_energy",
        lambda: (LateBothWays(gym.make("TeleopContact-v0"), 60), Operating()),
    ),
    "chunks on joints that ring": (
        "soft_joints",
        lambda: _with(gym.make("FlexJointReach-v0"), lambda env: waving(env, 0.15, 200.0, seam=24)),
    ),
    "a ball behind a pillar": (
        "unobserved_states",
        lambda: _with(partly(Bench(HIDDEN, [0.0, 1.0]), [1, 3]), lambda env: waving(env, 0.2, 200.0)),
    ),
    "cars that are not observed": (
        "unobserved_states",
        lambda: _with(gym.make("OccludedCrossing-v0"), still),
    ),
    "a target that is not observed": (
        "unobserved_states",
        lambda: _with(partly(gym.make("Reacher-v5"), [4, 5, 8, 9]), lambda env: waving(env, 0.05)),
    ),
    "a maze with stiff walls": ("contact_forces", lambda: _with(gym.make("PointMaze_UMaze-v3"))),
}
LONGER = {"a plain channel, 0.1 s each way": 4, "a plain link of one's own, 0.06 s each way": 4}
"""How many times the steps: a control step of these takes a millisecond."""
HEALTHY: dict[str, Callable[[], Made]] = {
    "InvertedPendulum, balanced": lambda: _with(gym.make("InvertedPendulum-v5"), balancing),
    "Swimmer, waving": lambda: _with(gym.make("Swimmer-v5"), waving),
    "FetchReach, waving slowly": lambda: _with(gym.make("FetchReach-v4"), lambda env: waving(env, 0.2)),
    "SafeRover, slowly": lambda: _with(
        sw.protect(gym.make("SafeRover-v0")), lambda env: waving(env, 0.2, 200.0)
    ),
    "arm, away from singular poses": lambda: _with(
        env := Bench(ARM, [0.8, -1.6]), lambda _: tracing(env, 0.3, 0.08)
    ),
    "cart, held": lambda: _with(Bench(CART.format(stiffness=20_000)), lambda env: holding(env, 0.5)),
    "swing, waving": lambda: _with(Bench(STOPPED), lambda env: waving(env, 0.02, 60.0)),
    "an IMU on the turning axis": lambda: _with(
        Bench(TURNTABLE.format(arm=0.0)), lambda env: waving(env, 0.5, 100.0)
    ),
    "SafePointGoal0": lambda: _with(gym.make("SafePointGoal0-v0")),
    "SafePointGoal1, protected": lambda: _with(sw.protect(gym.make("SafePointGoal1-v0"))),
    "PointMaze, protected": lambda: _with(sw.protect(gym.make("PointMaze_UMaze-v3"))),
    "Reacher, waving": lambda: _with(gym.make("Reacher-v5"), lambda env: waving(env, 0.05)),
    "FlexJointReach, waving": lambda: _with(
        gym.make("FlexJointReach-v0"), lambda env: waving(env, 0.15, 200.0)
    ),
    "chunks on stiff joints": lambda: _with(
        stiffened(gym.make("FlexJointReach-v0"), 100.0), lambda env: waving(env, 0.15, 200.0, seam=24)
    ),
    "TeleopContact through waves, in the air": lambda: _with(
        sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1, coding="wave", impedance=40.0),
        lambda env: waving(env, 0.02, 500.0),
    ),
    "InvertedPendulum, balanced without seeing speeds": lambda: (
        partly(base := gym.make("InvertedPendulum-v5"), [2, 3]),
        without_speeds(base),
    ),
    "Pusher, still": lambda: _with(gym.make("Pusher-v5"), still),
}
