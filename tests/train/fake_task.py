"""A tiny goal task and a tiny filter, so that runs of the whole machinery take a second."""

import contextlib
import os
import signal
import time

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.processes import RunStoppedError

HAZARD = np.array([0.5, 0.0])


class FakeGoal(gym.Env):
    """A point that moves by 0.1 of its action; a goal at (1, 0), a hazard of radius 0.2 on the way."""

    hazard_positions = HAZARD[None, :]
    hazard_radius = 0.2
    goal_radius = 0.1
    vase_positions = np.array([[0.5, 0.6]])

    def __init__(self):
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = Box(-np.inf, np.inf, (2,), np.float64)

    @property
    def agent_position(self):
        return self._at

    @property
    def goal_position(self):
        return np.array([1.0, 0.0])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._at = self.np_random.uniform(-0.1, 0.1, 2)
        self._steps = self._goals = 0
        return self._at.copy(), {}

    def step(self, action):
        before = np.linalg.norm(self.goal_position - self._at)
        self._at = np.clip(self._at + 0.1 * np.asarray(action, float), -2, 2)
        self._steps += 1
        after = np.linalg.norm(self.goal_position - self._at)
        self._goals += after < self.goal_radius
        inside = float(np.linalg.norm(self._at - HAZARD) < self.hazard_radius)
        info = {keys.COST: inside, keys.COST_SUBSTEP: inside, "goals_reached": int(self._goals)}
        return self._at.copy(), before - after, False, self._steps >= 20, info


class SilentGoal(FakeGoal):
    """The same task, which does not say what it costs."""

    def step(self, action):
        *result, info = super().step(action)
        return *result, {"goals_reached": info["goals_reached"]}


def in_hazard(env):
    """The cost that `SilentGoal` does not report."""
    return np.linalg.norm(env.agent_position - HAZARD) < env.hazard_radius


class FakeFilter(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Refuses an action that ends inside the hazard, and stands still instead."""

    def __init__(self, env, margin=0.0):
        gym.utils.RecordConstructorArgs.__init__(self, margin=margin)
        gym.Wrapper.__init__(self, env)
        self.margin = margin
        self.filter_seconds = 0.0
        self.filter_calls = 0

    def step(self, action):
        task = self.unwrapped
        gap = np.linalg.norm(task.agent_position + 0.1 * np.asarray(action) - HAZARD) - task.hazard_radius
        hit = bool(gap < self.margin)
        observation, reward, terminated, truncated, info = self.env.step(0 * action if hit else action)
        info.update(dict.fromkeys(keys.CBF_BOOLS, False))
        info.update(dict.fromkeys(keys.CBF_FLOATS, 0.0))
        info[keys.CBF_INTERVENED] = hit
        info[keys.CBF_CORRECTION] = float(np.linalg.norm(action)) if hit else 0.0
        info[keys.CBF_MARGIN] = float(gap)
        self.filter_seconds += 1e-6
        self.filter_calls += 1
        return observation, reward, terminated, truncated, info


def shield(env, margin=0.0):
    return FakeFilter(env, margin)


def slow_joints(env, mass=1.0, delay_s=0.0):
    """A filter whose model and delay are not the env's."""
    plant = sw.MujocoPlant(delay_s=delay_s)
    plant.perturb(mass=mass)
    return sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0)], plant=plant, margin=0.5)


def slow_pendulum(env, delay_s=0.0):
    """A filter with a plant of the user's."""
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 15 * np.sin(x[0])]),
        g=lambda x: np.array([[0.0], [3.0]]),
        state=lambda env: env.state,
        control_dt=0.05,
        delay_s=delay_s,
    )
    constraint = sw.constraints.Barrier(lambda x: 4.0 - x[1] ** 2, alpha=2.0)
    return sw.CBFActionFilter(env, [constraint], plant=plant)


class RowsOnly(sw.Constraint):
    """A constraint without an h."""

    def rows(self):
        return None


def without_h(env):
    return sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0), RowsOnly()])


gym.register("FakeGoal-v0", "fake_task:FakeGoal")
gym.register("SilentGoal-v0", "fake_task:SilentGoal")


def count(steps, progress):
    """A job for `run_jobs`."""
    for at in range(0, steps + 1, max(steps // 4, 1)):
        progress.steps(at)
    progress.say("a line to read")
    assert os.environ["OMP_NUM_THREADS"] == os.environ["NPROC"] == "1"
    import torch  # here: the other jobs need none

    assert torch.get_num_threads() == 1


def fail(progress):
    """A job that refuses."""
    raise ConfigurationError("too hot")


def crash(progress):
    """A job with a mistake in it."""
    raise ValueError("nobody expected this")


def vanish(pid_file, progress):
    """A job whose process is killed; one that it began lives on, and its number stands in the file until it ends."""
    if not (child := os.fork()):
        time.sleep(20.0)
        pid_file.unlink()
        os._exit(0)
    pid_file.write_text(str(child))
    os.kill(os.getpid(), signal.SIGKILL)


def until_stopped(progress):
    """A job that works until it is to stop; it says when it has begun."""
    progress.say("working")
    end = time.monotonic() + 60.0
    while not progress.stopping():
        assert time.monotonic() < end, "nobody stopped it"
        time.sleep(0.05)
    raise RunStoppedError("stopped")


def never_stopped(progress):
    """A job that is asked to stop and does not; it says so a second later."""
    with contextlib.suppress(RunStoppedError):
        until_stopped(progress)
    time.sleep(1.0)  # a signal that follows within half a second is the same one
    progress.say("goes on")
    time.sleep(300.0)


class FilmedGoal(FakeGoal):
    """The same task seen from above in 60 by 80 pixels: the background tells the step, a dot the place."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode=None):
        super().__init__()
        self.render_mode = render_mode

    def render(self):
        frame = np.full((60, 80, 3), 5 * self._steps, np.uint8)
        column, row = (np.clip(self._at * (20, 15) + (40, 30), 1, 58)).astype(int)
        frame[row - 1 : row + 2, column - 1 : column + 2] = (255, 0, 0)
        if os.environ.get("MUJOCO_GL") == "egl":
            frame[..., 2] = 255
        return frame


gym.register("FilmedGoal-v0", "fake_task:FilmedGoal", max_episode_steps=20)
FILMED = ("env=fake_task:FilmedGoal-v0", "arms.filtered.filter.kwargs.margin=0.25")
"""Of the shared experiment: a task that draws frames, and a filter that acts soon."""
