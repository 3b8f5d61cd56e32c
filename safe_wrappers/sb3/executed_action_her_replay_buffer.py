"""Hindsight experience replay (HER) with the action that the filter executed."""

import copy
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3.executed_action_replay_buffer import (
    ExecutedActionReplayBuffer,
    Flags,
    Indices,
    Infos,
    Values,
    picked,
)


class ExecutedActionHerReplayBuffer(ExecutedActionReplayBuffer, HerReplayBuffer):
    """SB3's `HerReplayBuffer`, with the action that the filter executed and with the penalty in relabelled rewards.

    HER (Andrychowicz et al., NeurIPS 2017) replays most transitions with a goal g' that the episode did reach, and
    the task's reward for it, r' = `compute_reward(achieved, g', info)`. Of a step that the filter changed

    - mode "safe_action" replays (s, g', a_safe, s', r');
    - mode "adaption_penalty" replays (s, g', a, s', r' - penalty), with what `AdaptionPenalty` took at the time;
    - mode "both" replays both.

    Unchanged steps are drawn as SB3 draws them, bit for bit with the same seed. The reward has to be a function of
    the goals alone: wrappers that change rewards, such as `OcclusionPenalty`, are not in `compute_reward`.

    Example:
        >>> import gymnasium as gym, gymnasium_robotics, safe_wrappers as sw
        >>> from stable_baselines3 import SAC
        >>> from safe_wrappers.sb3 import ExecutedActionHerReplayBuffer
        >>> gym.register_envs(gymnasium_robotics)
        >>> model = SAC(
        ...     "MultiInputPolicy",
        ...     sw.protect(gym.make("FetchReach-v4")),
        ...     buffer_size=1000,
        ...     replay_buffer_class=ExecutedActionHerReplayBuffer,
        ...     replay_buffer_kwargs={"mode": "safe_action", "n_sampled_goal": 4},
        ... )

    Args:
        env, n_sampled_goal, goal_selection_strategy, copy_info_dict: As in `HerReplayBuffer`; SB3 passes `env`.
        args, more: The others as in `ExecutedActionReplayBuffer`; observations as in `HerReplayBuffer`.

    Attributes:
        penalties: Modes "both" and "adaption_penalty": of each step, (buffer_size, n_envs), reward.

    Raises:
        ConfigurationError, ActionError: As `ExecutedActionReplayBuffer`.
    """

    modes: ClassVar[Sequence[str]] = ("safe_action", "both", "adaption_penalty")
    others: ClassVar[str] = "the naive learner uses SB3's own HerReplayBuffer"

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        if self.mode != "safe_action":
            # In double precision, so that a penalty comes off a relabelled reward as it came off the task's own.
            self.penalties = np.zeros(self.rewards.shape)

    def _keep(self, infos: Infos, executed: Values, task: Values, changed: Flags, finite: Flags) -> None:
        super()._keep(infos, executed, task, changed, finite)
        self.penalties[self.pos] = np.where(finite, [info[keys.ADAPTION_PENALTY] for info in infos], 0.0)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Draws a batch, uniformly from all transitions of whole episodes; most of them get a new goal.

        Raises:
            RuntimeError: No episode has ended yet (SB3's: give a larger `learning_starts`).
        """
        if self.mode == "safe_action" or not self.ep_length.any():
            return HerReplayBuffer.sample(self, batch_size, env)
        slots, envs, _ = drawn = self._draw(batch_size)
        replayed = int(self.her_ratio * batch_size)
        goals = self._sample_goals(slots[:replayed], envs[:replayed])
        # SB3 puts the transitions with their own goals first.
        slots, envs, second = drawn = np.roll(drawn, -replayed, axis=1)
        real = batch_size - replayed
        before, after = (picked(part, slots, envs) for part in (self.observations, self.next_observations))
        before["desired_goal"][real:] = after["desired_goal"][real:] = goals
        rewards = self.rewards[slots, envs]
        if self.mode == "both":
            rewards = np.where(second, self.task_rewards[slots, envs], rewards)
        penalties = np.where(second, 0.0, self.penalties[slots, envs])
        relabelled = self._task_rewards(after["achieved_goal"][real:], goals, slots[real:], envs[real:])
        rewards[real:] = relabelled - penalties[real:]
        return self._batch(drawn, before, after, rewards, env)

    def _draw(self, count: int) -> Indices:
        """Slots, envs and which of the two transitions, uniformly from whole episodes, by SB3's own random calls."""
        whole = self.ep_length > 0
        first = np.flatnonzero(whole)
        second = np.flatnonzero(whole & self.changed) if self.mode == "both" else first[:0]
        drawn = np.random.choice(len(first) + len(second), size=count, replace=True)
        slots, envs = np.unravel_index(np.concatenate([first, second])[drawn], whole.shape)
        return np.stack([slots, envs, drawn >= len(first)])

    def _task_rewards(self, achieved: Values, goals: Values, slots: Indices, envs: Indices) -> Values:
        """The task's rewards for having reached `achieved`, (n,)."""
        if self.env is None:
            raise ConfigurationError(
                "this buffer was loaded and has no env to relabel rewards with: call set_env(vec_env), or load it"
                " with the model's load_replay_buffer"
            )
        infos: Any = copy.deepcopy(self.infos[slots, envs]) if self.copy_info_dict else [{} for _ in slots]
        (rewards,) = self.env.env_method("compute_reward", achieved, goals, infos, indices=[0])
        return np.asarray(rewards, dtype=np.float64)
