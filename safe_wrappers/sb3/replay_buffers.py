"""Replay buffers with the action that the filter executed."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from safe_wrappers import info as keys
from safe_wrappers.errors import ActionError, ConfigurationError

Values = NDArray[Any]
Infos = list[dict[str, Any]]

_SAME: Final = 1e-3  # two scaled actions that differ by less differ by rounding only, not by their unit


class ExecutedActionReplayBuffer(ReplayBuffer):
    """SB3's replay buffer for SAC, TD3 and DDPG, with the action that the filter executed.

    SB3 stores the policy's action a ("naive" in Krasowski et al., Provably Safe Reinforcement Learning, TMLR 2023).
    Where the filter changed it to a_safe, this buffer stores

    - mode "safe_action": (s, a_safe, s', r) instead;
    - mode "both": (s, a_safe, s', r) beside (s, a, s', r - penalty), with the task's reward r and the penalty of the
      `AdaptionPenalty` in the env. Batches are drawn uniformly from all transitions.

    Unchanged steps are stored as SB3 stores them, bit for bit. Of a step whose policy action is not finite only the
    executed one is stored. Returns are one-step whatever SB3's `n_steps` says.

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
        buffer_size: Env steps to keep, over all envs; a changed step counts once.
        observation_space: Not a Dict; for those there is `ExecutedActionDictReplayBuffer`.
        action_space: A bounded Box.
        mode: "safe_action" or "both"; for "both" without `optimize_memory_usage`.
        args, more: As in SB3.

    Attributes:
        actions, rewards: In mode "both" the policy's actions and penalised rewards.
        executed_actions, task_rewards: Mode "both": the second transition, scaled actions (buffer_size, n_envs, nu)
            and rewards (buffer_size, n_envs).
        changed: Mode "both": where there is a second transition, (buffer_size, n_envs).

    Raises:
        ConfigurationError: An unknown mode or unsuitable spaces; at the first step, an env without a filter, without
            the penalty that "both" needs, with one in "safe_action", or with a wrapper outside the filter that
            changes actions.
        ActionError: An executed action that is not finite.
    """

    modes: ClassVar[Sequence[str]] = ("safe_action", "both")

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        mode: str = "safe_action",
        **more: Any,
    ) -> None:
        if mode not in self.modes:
            expected = " or ".join(map(repr, self.modes))
            others = "the naive learner and the adaption penalty alone use SB3's own buffer"
            raise ConfigurationError(f"mode: expected {expected}, got {mode!r}; {others}")
        if not (isinstance(action_space, spaces.Box) and action_space.is_bounded()):
            raise ConfigurationError(f"expected a bounded Box of actions, got {action_space}")
        if isinstance(observation_space, spaces.Dict) != isinstance(self, DictReplayBuffer):
            raise ConfigurationError(
                "use ExecutedActionDictReplayBuffer for Dict observations (with HER: ExecutedActionHerReplayBuffer)"
                f" and ExecutedActionReplayBuffer for all others; {type(self).__name__} got {observation_space}"
            )
        if mode == "both" and more.get("optimize_memory_usage"):
            raise ConfigurationError("mode 'both' does not work with optimize_memory_usage; leave it out")
        super().__init__(buffer_size, observation_space, action_space, *args, **more)
        self.mode = mode
        if mode == "both":
            self.executed_actions = np.zeros_like(self.actions)
            self.task_rewards = np.zeros_like(self.rewards)
            self.changed = np.zeros(self.rewards.shape, dtype=np.bool_)

    def add(
        self, obs: Any, next_obs: Any, action: Values, reward: Values, done: Values, infos: Infos
    ) -> None:
        """Stores one step of every env; `action` is the policy's, scaled, and `infos` hold the executed one."""
        policy = action.reshape((self.n_envs, self.action_dim))
        for at, info in enumerate(infos):
            self._check(at, info)
        executed = self._scaled(infos, keys.EXECUTED_ACTION)
        if not np.isfinite(executed).all():
            raise ActionError(f"an executed action is not finite: {[i[keys.EXECUTED_ACTION] for i in infos]}")
        finite = np.asarray(np.isfinite(policy).all(axis=1))
        escaping = np.array([bool(info.get(keys.CBF_ESCAPING, False)) for info in infos])
        judged = finite & ~escaping
        chosen, given = policy[judged], self._scaled(infos, keys.PROPOSED_ACTION)[judged]
        if not (np.abs(chosen - given) < _SAME).all():
            raise _foreign(f"scaled to [-1, 1], the policy chose {chosen} and the filter got {given}")
        changed = np.array([bool(info[keys.CBF_INTERVENED]) for info in infos]) | escaping | ~finite
        # Unscaling and scaling again is not the identity in floating point: unchanged actions stay the policy's.
        executed = np.where(changed[:, None], executed, policy)
        if self.mode == "safe_action":
            super().add(obs, next_obs, executed, reward, done, infos)
            return
        task = reward + np.array([info[keys.ADAPTION_PENALTY] for info in infos])
        self.executed_actions[self.pos], self.task_rewards[self.pos] = executed, task
        self.changed[self.pos] = changed & finite
        policy = np.where(finite[:, None], policy, executed)
        super().add(obs, next_obs, policy, np.where(finite, reward, task), done, infos)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """Draws a batch, uniformly from all stored transitions, with replacement."""
        if self.mode == "safe_action":
            return super().sample(batch_size, env)
        slots, envs, second = self._draw(batch_size)
        at = slots, envs
        rewards = np.where(second, self.task_rewards[at], self.rewards[at])
        actions = np.where(second[:, None], self.executed_actions[at], self.actions[at])
        dones = self.dones[at] * (1 - self.timeouts[at])
        kind: Any = DictReplayBufferSamples if isinstance(self, DictReplayBuffer) else ReplayBufferSamples
        return kind(
            observations=self._observed(self.observations, at, env),
            actions=self.to_torch(actions),
            next_observations=self._observed(self.next_observations, at, env),
            dones=self.to_torch(dones.reshape(-1, 1)),
            rewards=self.to_torch(self._normalize_reward(rewards.reshape(-1, 1), env)),
        )

    def _observed(self, stored: Any, at: tuple[Values, Values], env: VecNormalize | None) -> Any:
        """A copy of the observations of some slots and envs, as SB3 takes them."""
        parts = isinstance(stored, Mapping)
        picked: Any = {key: part[at] for key, part in stored.items()} if parts else stored[at]
        seen: Any = self._normalize_obs(picked, env)
        return {key: self.to_torch(part) for key, part in seen.items()} if parts else self.to_torch(seen)

    def _draw(self, count: int) -> Values:
        """Slots, envs and which of the two transitions (1 is the executed one), shape (3, count), uniformly."""
        drawn = np.empty((3, 0), dtype=np.int64)
        while drawn.shape[1] < count:
            # Rejection sampling: at least half of the candidates exist. Counting the changed steps of a full buffer
            # for every batch would cost more. NumPy's global generator is the one that SB3 seeds and uses.
            tries = np.stack([np.random.randint(0, n, 2 * count) for n in (self.size(), self.n_envs, 2)])
            slots, envs, second = tries
            drawn = np.hstack([drawn, tries[:, (second == 0) | self.changed[slots, envs]]])
        return drawn[:, :count]

    def _scaled(self, infos: Infos, key: str) -> Values:
        """Actions from the infos as `policy.scale_action` makes them, (n_envs, nu), in its precision."""
        space: Any = self.action_space
        given = np.array([np.asarray(info[key], dtype=space.dtype) for info in infos])
        if given.shape[1:] != space.shape:
            raise _foreign(f"{key} has shape {given.shape[1:]}, the action space {space.shape}")
        scaled: Values = 2.0 * ((given - space.low) / (space.high - space.low)) - 1.0
        return scaled.reshape((self.n_envs, self.action_dim))

    def _check(self, at: int, info: dict[str, Any]) -> None:
        for key in (keys.EXECUTED_ACTION, keys.PROPOSED_ACTION, keys.CBF_INTERVENED):
            if key not in info:
                raise ConfigurationError(
                    f"env {at} has no info[{key!r}]: ExecutedActionReplayBuffer needs a CBFActionFilter inside"
                    " the env; without a filter use SB3's own ReplayBuffer"
                )
        if (keys.ADAPTION_PENALTY in info) == (self.mode == "both"):
            return
        if self.mode == "both":
            raise ConfigurationError(
                f"env {at} has no info[{keys.ADAPTION_PENALTY!r}]: mode 'both' stores a penalised transition; wrap"
                " the env in AdaptionPenalty(env, penalty=...), or use mode 'safe_action'"
            )
        raise ConfigurationError(
            f"env {at} has an AdaptionPenalty: mode 'safe_action' would charge it to the executed action, which is"
            " the safe one; use mode 'both', or take the wrapper away"
        )


def _foreign(what: str) -> ConfigurationError:
    return ConfigurationError(
        f"the filter's actions are not the policy's ({what}): a wrapper outside the filter changes actions, so the"
        " executed action is not in the policy's units; take that wrapper away (SB3 scales actions to [-1, 1]"
        " itself), or learn from the policy's action (SB3's own ReplayBuffer)"
    )


class ExecutedActionDictReplayBuffer(ExecutedActionReplayBuffer, DictReplayBuffer):
    """`ExecutedActionReplayBuffer` for Dict observations; same arguments and modes."""


class ExecutedActionHerReplayBuffer(ExecutedActionReplayBuffer, HerReplayBuffer):
    """SB3's `HerReplayBuffer`, with the action that the filter executed.

    HER (Andrychowicz et al., NeurIPS 2017) replays most transitions with a goal g' that the episode did reach, and
    the task's reward for it, r' = `compute_reward(achieved, g', info)`. Of a step that the filter changed this
    replays (s, g', a_safe, s', r'). The reward has to be a function of the goals alone: what wrappers take off
    rewards, `AdaptionPenalty` and `OcclusionPenalty`, is not in `compute_reward`.

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
        ...     replay_buffer_kwargs={"n_sampled_goal": 4},
        ... )

    Args:
        env, n_sampled_goal, goal_selection_strategy, copy_info_dict: As in `HerReplayBuffer`; SB3 passes `env`.
        args, more: The others as in `ExecutedActionReplayBuffer`; observations as in `HerReplayBuffer`.

    Raises:
        ConfigurationError, ActionError: As `ExecutedActionReplayBuffer`.
    """

    modes: ClassVar[Sequence[str]] = ("safe_action",)
