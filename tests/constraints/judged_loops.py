"""Closed loops judged at every physics substep by an integration of their own, and the drivers that attack them."""

import gymnasium as gym
import mujoco
import numpy as np
from scenes import Scene

import safe_wrappers as sw


def sliders(count=1, actuator="motor", range_="-1 1", **options):
    """Masses of 1 kg on slides of their own, along x, without gravity: `v' = u` each."""
    limit = 'ctrllimited="false"' if range_ is None else f'ctrlrange="{range_}"'
    bodies = "".join(
        f'<body name="b{i}" pos="0 {i} 0"><joint name="x{i}" type="slide" axis="1 0 0"/>'
        '<geom size=".1" mass="1"/></body>'
        for i in range(count)
    )
    motors = "".join(f'<{actuator} joint="x{i}" {limit}/>' for i in range(count))
    return Scene(
        f"""<mujoco><option timestep="0.01" gravity="0 0 0"><flag contact="disable"/></option>
        <worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>""",
        **options,
    )


class Judge:
    """Integrates every executed action once more, from a copy of the env's data.

    Args:
        env: The filtered one.
        room: Model and data with fresh kinematics to what is left of the limit, any shape; wanted >= 0.
    """

    def __init__(self, env, room):
        self.raw, self.room = env.unwrapped, room
        self.data = mujoco.MjData(self.raw.model)
        self._still = mujoco.MjData(self.raw.model)

    def at(self, data):
        """Room of a state; MuJoCo's own derived quantities lag behind the state, these do not."""
        self._still.qpos[:], self._still.qvel[:] = data.qpos, data.qvel
        mujoco.mj_kinematics(self.raw.model, self._still)
        return float(np.min(self.room(self.raw.model, self._still)))

    def ahead(self, control, horizon):
        """Room after holding a control for some steps."""
        mujoco.mj_copyData(self.data, self.raw.model, self.raw.data)
        self.data.ctrl[:] = control
        mujoco.mj_step(self.raw.model, self.data, nstep=horizon * self.raw.frame_skip)
        return self.at(self.data)

    def step(self, env, action):
        """The least room at any substep of the step, that at its end, and the info."""
        mujoco.mj_copyData(self.data, self.raw.model, self.raw.data)
        *_, terminated, truncated, info = env.step(action)
        self.data.ctrl[:] = info["executed_action"]
        rooms = []
        for _ in range(self.raw.frame_skip):
            mujoco.mj_step(self.raw.model, self.data)
            rooms.append(self.at(self.data))
        assert np.array_equal(self.data.qpos, self.raw.data.qpos)  # else it judges another machine
        assert np.array_equal(self.data.qvel, self.raw.data.qvel)
        return min(rooms), rooms[-1], terminated or truncated, info


def flagged(info):
    """Whether the step says of itself that it promises nothing."""
    return info["cbf/infeasible"] or info["cbf/fallback"]


def signs(env, k, rate):
    """Full controls that stay for `rate` steps."""
    bits = np.random.default_rng(k // rate).random(env.action_space.shape) < 0.5
    return env.action_space.high * np.where(bits, -1.0, 1.0)


def at_random(judge, env, k, rng):
    return rng.uniform(env.action_space.low, env.action_space.high)


def bang_bang(judge, env, k, rng):
    return signs(env, k, 9)


def pulse(judge, env, k, rng):
    return signs(env, k, 20) * (k % 20 < 4)


def seeking(judge, env, k, rng):
    """Of some full controls the one that leaves the least room two steps on."""
    tried = [env.action_space.high * rng.choice([-1.0, 1.0], env.action_space.shape) for _ in range(5)]
    return min(tried, key=lambda u: judge.ahead(u, 2))


DRIVERS = {d.__name__: d for d in (at_random, bang_bang, pulse, seeking)}


def drive(env, room, driver, steps, seeds=(0,)):
    """Drive episodes; every step that starts safe and is not flagged has to keep the limit at every substep.

    Returns:
        Counts: steps, intervened, flagged, outside (steps with less than no room), and the least room.
    """
    judge = Judge(env, room)
    seen = {"steps": 0, "intervened": 0, "flagged": 0, "outside": 0, "least": np.inf}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        env.reset(seed=seed)
        before = judge.at(judge.raw.data)
        for k in range(steps):
            action = DRIVERS[driver](judge, env, k, rng).astype(env.action_space.dtype)
            least, end, done, info = judge.step(env, action)
            # 1e-6: the executed action is rounded to the space's float32
            assert least >= -1e-6 or before < 0.0 or flagged(info), (seed, k, least, info)
            seen["steps"] += 1
            seen["intervened"] += info["cbf/intervened"]
            seen["flagged"] += flagged(info)
            seen["outside"] += least < -1e-6
            seen["least"] = min(seen["least"], least)
            before = end
            if done:
                env.reset()
                before = judge.at(judge.raw.data)
    return seen


def check_inactive(env_id, limit, largest, steps):
    """Actions of up to `largest` pass bit for bit: the env does what it does without the filter."""
    bare, filtered = gym.make(env_id), sw.CBFActionFilter(gym.make(env_id), [limit])
    rng = np.random.default_rng(0)
    a, b = bare.reset(seed=3)[0], filtered.reset(seed=3)[0]
    for _ in range(steps):
        assert a.tobytes() == b.tobytes()
        action = rng.uniform(-largest, largest, bare.action_space.shape).astype(np.float32)
        a, reward, *_ = bare.step(action)
        b, same, _, _, info = filtered.step(action)
        assert reward == same and not info["cbf/intervened"] and not info["cbf/refused"].any()
