"""Hindsight experience replay (HER) that knows what the filter executed."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.sb3.executed_action_replay_buffer import ExecutedActionReplayBuffer


class ExecutedActionHerReplayBuffer(ExecutedActionReplayBuffer, HerReplayBuffer):
    """SB3's `HerReplayBuffer`, with the action that the filter executed and with the penalty in relabelled rewards.

    HER (Andrychowicz et al., NeurIPS 2017) replays most transitions with another goal g', one that the episode did
    reach, and the task's reward for it, r' = `compute_reward(achieved, g', info)`. Whether and how far the filter
    changed an action does not depend on the goal, so that of a changed step

    - mode "safe_action" replays (s, g', a_safe, s', r');
    - mode "both" replays that one and (s, g', a, s', r' - penalty), where the penalty is what this step cost, as
      `AdaptionPenalty` said at the time;
    - mode "adaption_penalty" replays the latter alone. With SB3's own `HerReplayBuffer` behind an `AdaptionPenalty`
      relabelled rewards would have no penalty: `compute_reward` is the task's and does not know of it.

    The naive learner uses SB3's `HerReplayBuffer`. What is not changed is drawn as SB3 draws it, bit for bit with the
    same seed. As in SB3 only whole episodes are drawn from, and a loaded buffer needs `set_env`, which
    `load_replay_buffer` calls. The reward has to be a function of the goals alone: a wrapper that scales rewards, or
    an `OcclusionPenalty`, is not in `compute_reward`.

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
        buffer_size, observation_space, action_space, device, n_envs, handle_timeout_termination: As in
            `ExecutedActionReplayBuffer`; observations are a Dict with `observation`, `achieved_goal`, `desired_goal`.
        mode: "safe_action", "both" or "adaption_penalty".
        env, n_sampled_goal, goal_selection_strategy, copy_info_dict: As in `HerReplayBuffer`. `env` comes from SB3.

    Attributes:
        penalties: Modes "both" and "adaption_penalty": of each step, (buffer_size, n_envs), reward.

    Raises:
        ConfigurationError: As `ExecutedActionReplayBuffer`.
        ActionError: An executed action that is not finite.
    """

    modes: ClassVar[Sequence[str]] = ("safe_action", "both", "adaption_penalty")
    others: ClassVar[str] = "the naive learner uses SB3's own HerReplayBuffer"

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        if self.mode != "safe_action":
            # In double precision, so that a penalty comes off a relabelled reward as it came off the task's own.
            self.penalties = np.zeros(self.rewards.shape)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: NDArray[Any],
        reward: NDArray[Any],
        done: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Stores one step of every env; `action` is the policy's, scaled, and `infos` hold the executed one."""
        at = self.pos
        super().add(obs, next_obs, action, reward, done, infos)
        if self.mode != "safe_action":
            finite = np.isfinite(action.reshape((self.n_envs, self.action_dim))).all(axis=1)
            self.penalties[at] = np.where(finite, [info[keys.ADAPTION_PENALTY] for info in infos], 0.0)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Draws a batch, uniformly from all transitions of whole episodes; most of them get a new goal.

        Raises:
            RuntimeError: No episode has ended yet (SB3's: give a larger `learning_starts`).
        """
        if self.mode == "safe_action" or not self.ep_length.any():
            return HerReplayBuffer.sample(self, batch_size, env)
        slots, envs, second = self._draw(batch_size)
        replayed = int(self.her_ratio * batch_size)
        goals = self._sample_goals(slots[:replayed], envs[:replayed])
        # SB3 puts what is not relabelled first.
        slots, envs, second = (np.roll(drawn, -replayed) for drawn in (slots, envs, second))
        real = batch_size - replayed
        before = {key: stored[slots, envs] for key, stored in self.observations.items()}
        after = {key: stored[slots, envs] for key, stored in self.next_observations.items()}
        before["desired_goal"][real:] = after["desired_goal"][real:] = goals
        actions, rewards = self.actions[slots, envs], self.rewards[slots, envs]
        if self.mode == "both":
            actions = np.where(second[:, None], self.executed_actions[slots, envs], actions)
            rewards = np.where(second, self.task_rewards[slots, envs], rewards)
        penalties = np.where(second, 0.0, self.penalties[slots, envs])
        relabelled = self._task_rewards(after["achieved_goal"][real:], goals, slots[real:], envs[real:])
        rewards[real:] = relabelled - penalties[real:]
        dones = self.dones[slots, envs] * (1 - self.timeouts[slots, envs])
        observed, next_observed = (self._normalize_obs(part, env) for part in (before, after))
        return DictReplayBufferSamples(
            observations={key: self.to_torch(part) for key, part in dict(observed).items()},
            actions=self.to_torch(actions),
            next_observations={key: self.to_torch(part) for key, part in dict(next_observed).items()},
            dones=self.to_torch(dones.reshape(-1, 1)),
            rewards=self.to_torch(self._normalize_reward(rewards.reshape(-1, 1), env)),
        )

    def _draw(self, count: int) -> NDArray[np.int64]:
        """Slots, envs and which of the two transitions, uniform over those of whole episodes.

        With no second transition the numbers are drawn as SB3 draws them.
        """
        whole = self.ep_length > 0
        first = np.flatnonzero(whole)
        second = np.flatnonzero(whole & self.changed) if self.mode == "both" else first[:0]
        drawn = np.random.choice(len(first) + len(second), size=count, replace=True)
        slots, envs = np.unravel_index(np.concatenate([first, second])[drawn], whole.shape)
        return np.stack([slots, envs, drawn >= len(first)])

    def _task_rewards(
        self, achieved: NDArray[Any], goals: NDArray[Any], slots: NDArray[np.int64], envs: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """The task's rewards for having reached `achieved`, (n,)."""
        if self.env is None:
            raise ConfigurationError(
                "this buffer was loaded and has no env to relabel rewards with: call set_env(vec_env), or load it"
                " with the model's load_replay_buffer"
            )
        infos: Any = copy.deepcopy(self.infos[slots, envs]) if self.copy_info_dict else [{} for _ in slots]
        (rewards,) = self.env.env_method("compute_reward", achieved, goals, infos, indices=[0])
        return np.asarray(rewards, dtype=np.float64)
