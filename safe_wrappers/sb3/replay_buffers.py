"""Replay buffers with the action that the filter executed."""

from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from safe_wrappers import info as keys
from safe_wrappers.errors import ActionError, ConfigurationError

Values = NDArray[Any]
Infos = list[dict[str, Any]]

_SAME: Final = 1e-3  # two scaled actions that differ by less differ by rounding only, not by their unit


class ExecutedActionReplayBuffer(ReplayBuffer):
    """SB3's replay buffer for SAC, TD3 and DDPG, with the action that the filter executed.

    SB3 stores the policy's action a ("naive" in Krasowski et al., Provably Safe Reinforcement Learning, TMLR 2023).
    Where the filter changed it to a_safe, this buffer stores (s, a_safe, s', r) instead, and unchanged steps as SB3
    stores them, bit for bit. Returns are one-step whatever SB3's `n_steps` says. Of an `ActionRepeat`, whose control
    steps may be executed with different actions, a_safe is the last one's.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> from stable_baselines3 import SAC
        >>> from safe_wrappers.sb3 import ExecutedActionReplayBuffer
        >>> env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(limit=4.0)])
        >>> model = SAC("MlpPolicy", env, buffer_size=1000, replay_buffer_class=ExecutedActionReplayBuffer)

    Args:
        buffer_size: Env steps to keep, over all envs.
        observation_space: Not a Dict; for those there is `ExecutedActionDictReplayBuffer`.
        action_space: A bounded Box.
        args, more: As in SB3.

    Raises:
        ConfigurationError: Other actions or observations; at the first step, an env without a filter, with an
            `AdaptionPenalty` (it would charge the safe action), or with a wrapper outside the filter that changes
            actions.
        ActionError: An executed action that is not finite.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        **more: Any,
    ) -> None:
        if not (isinstance(action_space, spaces.Box) and action_space.is_bounded()):
            raise ConfigurationError(f"expected a bounded Box of actions, got {action_space}")
        if isinstance(observation_space, spaces.Dict) and not isinstance(self, DictReplayBuffer):
            raise ConfigurationError(
                f"expected observations that are no Dict, got {observation_space}; those are for"
                " ExecutedActionDictReplayBuffer, or ExecutedActionHerReplayBuffer"
            )
        super().__init__(buffer_size, observation_space, action_space, *args, **more)

    def add(
        self, obs: Any, next_obs: Any, action: Values, reward: Values, done: Values, infos: Infos
    ) -> None:
        """Stores one step of every env; `action` is the policy's, scaled, and `infos` hold the executed one."""
        policy = action.reshape((self.n_envs, self.action_dim))
        for at, info in enumerate(infos):
            _check(at, info)
        executed = self._scaled(infos, keys.EXECUTED_ACTION)
        if not np.isfinite(executed).all():
            raise ActionError(f"an executed action is not finite: {[i[keys.EXECUTED_ACTION] for i in infos]}")
        replaced = ~np.isfinite(policy).all(axis=1)
        chosen, given = policy[~replaced], self._scaled(infos, keys.PROPOSED_ACTION)[~replaced]
        if not (np.abs(chosen - given) < _SAME).all():
            raise _foreign(f"scaled to [-1, 1], the policy chose {chosen} and the filter got {given}")
        changed = replaced | np.array([bool(info[keys.CBF_INTERVENED]) for info in infos])
        # Unscaling and scaling again is not the identity in floating point: unchanged actions stay the policy's.
        super().add(obs, next_obs, np.where(changed[:, None], executed, policy), reward, done, infos)

    def _scaled(self, infos: Infos, key: str) -> Values:
        """Actions from the infos as `policy.scale_action` makes them, (n_envs, nu), in its precision."""
        space: Any = self.action_space
        given = np.array([np.asarray(info[key], dtype=space.dtype) for info in infos])
        if given.shape[1:] != space.shape:
            raise _foreign(f"{key} has shape {given.shape[1:]}, the action space {space.shape}")
        scaled: Values = 2.0 * ((given - space.low) / (space.high - space.low)) - 1.0
        return scaled.reshape((self.n_envs, self.action_dim))


def _check(at: int, info: dict[str, Any]) -> None:
    """Whether a step of one env tells what the filter executed, at the task's own reward."""
    for key in (keys.EXECUTED_ACTION, keys.PROPOSED_ACTION, keys.CBF_INTERVENED):
        if key not in info:
            raise ConfigurationError(
                f"env {at} has no info[{key!r}]: ExecutedActionReplayBuffer needs a CBFActionFilter inside"
                " the env; without a filter use SB3's own ReplayBuffer"
            )
    if keys.ADAPTION_PENALTY in info:
        raise ConfigurationError(
            f"env {at} has an AdaptionPenalty, which would be charged to the executed action, the safe one; use SB3's"
            " own ReplayBuffer, or take the wrapper away"
        )


def _foreign(what: str) -> ConfigurationError:
    return ConfigurationError(
        f"the filter's actions are not the policy's ({what}): a wrapper outside the filter changes actions, so the"
        " executed action is not in the policy's units; take that wrapper away (SB3 scales actions to [-1, 1]"
        " itself), or learn from the policy's action (SB3's own ReplayBuffer)"
    )


class ExecutedActionDictReplayBuffer(ExecutedActionReplayBuffer, DictReplayBuffer):
    """`ExecutedActionReplayBuffer` for Dict observations; same arguments."""


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
        args, more: As in SB3's; SB3 passes `env`.

    Raises:
        ConfigurationError, ActionError: As `ExecutedActionReplayBuffer`.
    """
