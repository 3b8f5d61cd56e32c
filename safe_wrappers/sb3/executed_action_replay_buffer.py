"""A replay buffer that knows what the filter executed: the "safe action" and "both" learners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from safe_wrappers import info as keys
from safe_wrappers.errors import ActionError, ConfigurationError

MODES: Final = ("safe_action", "both")
_SAME: Final = 1e-3
"""Two scaled actions that differ by less differ by rounding: a wrong unit differs by a share of the range."""


class ExecutedActionReplayBuffer(ReplayBuffer):
    """SB3's replay buffer for SAC, TD3 and DDPG, with the action that the filter executed.

    SB3 stores the policy's action a, whatever the filter made of it ("naive" in Krasowski et al., Provably Safe
    Reinforcement Learning, TMLR 2023). Where the filter changed the action to a_safe, this buffer stores

    - mode "safe_action": (s, a_safe, s', r) instead;
    - mode "both": (s, a_safe, s', r) beside (s, a, s', r - penalty). The penalty is `AdaptionPenalty`'s, which this
      mode needs in the env; r is the task's own reward.

    An unchanged step is stored once, as SB3 stores it, bit for bit. Actions are stored as SB3 stores them, scaled to
    [-1, 1] as `policy.scale_action` does.

    `buffer_size` counts env steps, as in SB3, so that every mode remembers equally far back. In mode "both" a changed
    step keeps two actions and rewards and one pair of observations; batches are drawn uniformly from all transitions,
    so that a changed step is drawn twice as often. A policy's action that is not finite is never stored: that step
    has the executed action only.

    On-policy algorithms (PPO, A2C) have no replay buffer and cannot learn from the executed action: they weigh an
    action by the probability with which the policy drew it, and the policy did not draw this one. `AdaptionPenalty`
    works with them. SB3 makes n-step returns with a buffer of its own; with this one returns are one-step whatever
    `n_steps` says (SB3 warns).

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> from stable_baselines3 import SAC
        >>> from safe_wrappers.sb3 import ExecutedActionReplayBuffer
        >>> env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(limit=4.0)])
        >>> env = sw.AdaptionPenalty(env, penalty=0.1)
        >>> model = SAC(
        ...     "MlpPolicy",
        ...     env,
        ...     buffer_size=1000,
        ...     replay_buffer_class=ExecutedActionReplayBuffer,
        ...     replay_buffer_kwargs={"mode": "both"},
        ... )

    Args:
        buffer_size: Env steps to keep, over all envs.
        observation_space: Not a Dict; for those there is `ExecutedActionDictReplayBuffer`.
        action_space: A bounded Box.
        device: Where batches go.
        n_envs: Number of envs.
        optimize_memory_usage: As in SB3, mode "safe_action" only.
        handle_timeout_termination: As in SB3.
        mode: "safe_action" or "both".
        more: What the SB3 buffer beneath takes besides; none here, HER's in `ExecutedActionHerReplayBuffer`.

    Attributes:
        actions, rewards: What SB3 expects there: in mode "both" the policy's actions and penalised rewards.
        executed_actions, task_rewards: Mode "both": the second transition, scaled actions (buffer_size, n_envs, nu)
            and rewards (buffer_size, n_envs).
        changed: Mode "both": where there is a second transition, (buffer_size, n_envs).

    Raises:
        ConfigurationError: An unknown mode, or spaces it cannot work with; at the first step, an env without a
            filter, without the penalty that "both" needs or with the one that "safe_action" does not take, or with a
            wrapper outside the filter that changes actions.
        ActionError: An executed action that is not finite.
    """

    modes: ClassVar[Sequence[str]] = MODES
    others: ClassVar[str] = (
        "the naive learner and the one with the adaption penalty alone use SB3's own ReplayBuffer"
    )

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        mode: str = "safe_action",
        **more: Any,
    ) -> None:
        if mode not in self.modes:
            raise ConfigurationError(
                f"mode: expected {' or '.join(map(repr, self.modes))}, got {mode!r}; {self.others}"
            )
        if not (isinstance(action_space, spaces.Box) and action_space.is_bounded()):
            raise ConfigurationError(f"expected a bounded Box of actions, got {action_space}")
        if isinstance(observation_space, spaces.Dict) != isinstance(self, DictReplayBuffer):
            raise ConfigurationError(
                "use ExecutedActionDictReplayBuffer for Dict observations (with HER: ExecutedActionHerReplayBuffer)"
                f" and ExecutedActionReplayBuffer for all others; {type(self).__name__} got {observation_space}"
            )
        if mode == "both" and optimize_memory_usage:
            raise ConfigurationError(
                "mode 'both' does not work with optimize_memory_usage=True; leave it out"
            )
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device=device,
            n_envs=n_envs,
            optimize_memory_usage=optimize_memory_usage,
            handle_timeout_termination=handle_timeout_termination,
            **more,
        )
        self.mode = mode
        self._low, self._high = action_space.low, action_space.high
        if mode == "both":
            self.executed_actions = np.zeros_like(self.actions)
            self.task_rewards = np.zeros_like(self.rewards)
            self.changed = np.zeros(self.rewards.shape, dtype=np.bool_)

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
        policy = action.reshape((self.n_envs, self.action_dim))
        self._check(infos)
        executed = self._scaled(infos, keys.EXECUTED_ACTION)
        if not np.isfinite(executed).all():
            raise ActionError(f"an executed action is not finite: {[i[keys.EXECUTED_ACTION] for i in infos]}")
        finite = np.isfinite(policy).all(axis=1)
        self._check_units(policy[finite], self._scaled(infos, keys.PROPOSED_ACTION)[finite])
        changed = np.array([bool(info[keys.CBF_INTERVENED]) for info in infos]) | ~finite
        # Unscaling and scaling again is not the identity in floating point: what was not changed stays the policy's.
        executed = np.where(changed[:, None], executed, policy)
        if self.mode == "safe_action":
            super().add(obs, next_obs, executed, reward, done, infos)
            return
        task = np.array([info[keys.ADAPTION_TASK_REWARD] for info in infos], dtype=np.float64)
        if self.mode == "both":
            self.executed_actions[self.pos], self.task_rewards[self.pos] = executed, task
            self.changed[self.pos] = changed & finite
        super().add(
            obs,
            next_obs,
            np.where(finite[:, None], policy, executed),
            np.where(finite, reward, task),
            done,
            infos,
        )

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Draws a batch, uniformly from all stored transitions, with replacement."""
        if self.mode == "safe_action":
            return super().sample(batch_size, env)
        slots, envs, second = self._draw(batch_size)
        actions = np.where(second[:, None], self.executed_actions[slots, envs], self.actions[slots, envs])
        rewards = np.where(second, self.task_rewards[slots, envs], self.rewards[slots, envs])
        dones = self.dones[slots, envs] * (1 - self.timeouts[slots, envs])
        kind: Any = DictReplayBufferSamples if isinstance(self, DictReplayBuffer) else ReplayBufferSamples
        return kind(
            observations=self._observations(self.observations, slots, envs, env),
            actions=self.to_torch(actions),
            next_observations=self._observations(self.next_observations, slots, envs, env),
            dones=self.to_torch(dones.reshape(-1, 1)),
            rewards=self.to_torch(self._normalize_reward(rewards.reshape(-1, 1), env)),
        )

    def _draw(self, count: int) -> NDArray[np.int64]:
        """Slots, envs and which of the two transitions (1 is the executed one), uniform over those that exist."""
        drawn = np.empty((3, 0), dtype=np.int64)
        while drawn.shape[1] < count:
            # At least half of all candidates exist, and what is kept is uniform; counting the changed steps of a
            # full buffer for every batch would cost more. NumPy's global generator, which SB3 seeds and uses.
            tries = np.stack([np.random.randint(0, n, 2 * count) for n in (self.size(), self.n_envs, 2)])
            slots, envs, second = tries
            drawn = np.hstack([drawn, tries[:, (second == 0) | self.changed[slots, envs]]])
        return drawn[:, :count]

    def _observations(
        self, stored: Any, slots: NDArray[np.int64], envs: NDArray[np.int64], env: VecNormalize | None
    ) -> Any:
        if isinstance(stored, Mapping):
            picked: Any = self._normalize_obs({k: v[slots, envs] for k, v in stored.items()}, env)
            return {key: self.to_torch(value) for key, value in picked.items()}
        array: Any = self._normalize_obs(stored[slots, envs], env)
        return self.to_torch(array)

    def _scaled(self, infos: Sequence[Mapping[str, Any]], key: str) -> NDArray[Any]:
        """Actions from the infos as `policy.scale_action` makes them, (n_envs, nu), in its precision."""
        given = np.array([np.asarray(info[key], dtype=self.action_space.dtype) for info in infos])
        if given.shape[1:] != self.action_space.shape:
            raise self._foreign(
                f"{key} has shape {given.shape[1:]}, the action space {self.action_space.shape}"
            )
        scaled: NDArray[Any] = 2.0 * ((given - self._low) / (self._high - self._low)) - 1.0
        return scaled.reshape((self.n_envs, self.action_dim))

    def _check(self, infos: Sequence[Mapping[str, Any]]) -> None:
        for at, info in enumerate(infos):
            for key in (keys.EXECUTED_ACTION, keys.PROPOSED_ACTION, keys.CBF_INTERVENED):
                if key not in info:
                    raise ConfigurationError(
                        f"env {at} has no info[{key!r}]: ExecutedActionReplayBuffer needs a CBFActionFilter inside"
                        " the env; without a filter use SB3's own ReplayBuffer"
                    )
            if self.mode != "safe_action" and keys.ADAPTION_PENALTY not in info:
                raise ConfigurationError(
                    f"env {at} has no info[{keys.ADAPTION_PENALTY!r}]: mode {self.mode!r} stores a penalised"
                    " transition; wrap the env in AdaptionPenalty(env, penalty=...), or use mode 'safe_action'"
                )
            if self.mode == "safe_action" and keys.ADAPTION_PENALTY in info:
                raise ConfigurationError(
                    f"env {at} has an AdaptionPenalty: mode 'safe_action' would charge it to the executed action,"
                    " which is the safe one; use mode 'both', or take the wrapper away"
                )

    def _check_units(self, policy: NDArray[Any], proposed: NDArray[Any]) -> None:
        if not (np.abs(policy - proposed) < _SAME).all():
            raise self._foreign(
                f"scaled to [-1, 1], the policy chose {policy} and the filter was given {proposed}"
            )

    def _foreign(self, what: str) -> ConfigurationError:
        return ConfigurationError(
            f"the filter's actions are not the policy's ({what}): a wrapper outside the filter changes actions, so"
            " the executed action is not in the policy's units; take that wrapper away (SB3 scales actions to [-1, 1]"
            " itself), or learn from the policy's action (SB3's own ReplayBuffer)"
        )


class ExecutedActionDictReplayBuffer(ExecutedActionReplayBuffer, DictReplayBuffer):
    """`ExecutedActionReplayBuffer` for Dict observations; same arguments and modes."""
