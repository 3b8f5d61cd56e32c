"""What each learner stores of a changed step, read from the replay buffers."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from stable_baselines3.common.buffers import ReplayBuffer

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, INK, OFF, ON, panels
from safe_wrappers.filter.constraint import BoundConstraint, Constraint
from safe_wrappers.sb3 import ExecutedActionReplayBuffer

PROPOSED, LIMIT, PENALTY = 0.75, 0.2, 0.4


class Line(gym.Env[Any, Any]):
    """One step: an action is worth one minus its distance from 0.5."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    dt = 1.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Nothing to reset."""
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Reward the executed action."""
        return (np.zeros(1, np.float32), 1.0 - abs(float(action[0]) - 0.5), False, False, {})


class Limit(Constraint):
    """u <= LIMIT."""

    def bind(self, plant: sw.Plant) -> BoundConstraint:
        """On a plant."""
        return BoundLimit(self, plant)


class BoundLimit(BoundConstraint):
    """Limit on a plant."""

    def rows(self) -> sw.HalfSpaces:
        """One row."""
        return sw.HalfSpaces(np.array([[1.0]]), np.array([LIMIT]))


class Stored(NamedTuple):
    """An action and the reward that it is credited with."""

    action: float
    reward: float


def stored(penalised: bool, mode: str | None) -> list[Stored]:
    """What one changed step leaves in the buffer."""
    plant = sw.AnalyticPlant(
        f=lambda x: 0.0 * x, g=lambda x: np.ones((1, 1)), state=lambda env: np.zeros(1), control_dt=1.0
    )
    env: Any = sw.CBFActionFilter(Line(), [Limit()], plant=plant)
    if penalised:
        env = sw.AdaptionPenalty(env, penalty=PENALTY)
    env.reset(seed=0)
    action = np.array([PROPOSED], np.float32)
    observation, reward, *_, info = env.step(action)
    kind, more = (ReplayBuffer, {}) if mode is None else (ExecutedActionReplayBuffer, {"mode": mode})
    buffer: Any = kind(4, env.observation_space, env.action_space, device="cpu", **more)
    one = np.array([reward])
    buffer.add(observation[None], observation[None], action[None], one, np.zeros(1), [info])
    kept = [Stored(float(buffer.actions[0, 0, 0]), float(buffer.rewards[0, 0]))]
    if mode == "both":
        kept.append(Stored(float(buffer.executed_actions[0, 0, 0]), float(buffer.task_rewards[0, 0])))
    return kept


def draw() -> Figure:
    """One row per learner."""
    figure, ax = panels(width=6.4, height=2.5)
    learners = {
        "naive": (False, None),
        "adaption penalty": (True, None),
        "safe action": (False, "safe_action"),
        "both": (True, "both"),
    }
    ax.axvspan(LIMIT, 1.0, color=FORBIDDEN, alpha=0.12, lw=0)
    ax.axvline(LIMIT, color=FORBIDDEN, lw=1.2)
    for row, (penalised, mode) in enumerate(learners.values()):
        ax.axhline(-row, color=GRID, lw=0.6)
        for action, reward in stored(penalised, mode):
            ax.plot(action, -row, "o", color=OFF if action > LIMIT + 0.01 else ON, ms=8)
            ax.text(action + 0.04, -row + 0.12, f"reward {reward:.1f}", color=INK, va="bottom")
    ax.set_yticks([-row for row in range(len(learners))], list(learners))
    ax.set(ylim=(-len(learners) + 0.6, 0.7), xlim=(-0.4, 1.15), xlabel="action")
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    return figure
