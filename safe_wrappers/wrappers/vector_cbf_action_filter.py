"""VectorCBFActionFilter: CBFActionFilter for a vector env, whose envs are judged together."""

import copy
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorActionWrapper, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint, ConstraintBatch
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.plant import Plant
from safe_wrappers.stack import refuse_order
from safe_wrappers.wrappers.cbf_action_filter import SAFE_TOLERANCE, CBFActionFilter
from safe_wrappers.wrappers.layer import Step, action_array

Mask = NDArray[np.bool_]

if TYPE_CHECKING:
    _Wrapper = VectorWrapper[Any, Any, Any, Any, Any]
else:
    _Wrapper = VectorWrapper  # no generic class in Gymnasium 1.1


class VectorCBFActionFilter(_Wrapper):
    """Filters the actions of all envs of a `SyncVectorEnv`.

    Every env gets a `CBFActionFilter` of its own, around it in the vector env, with the same guarantees. Where the
    only constraint can judge many envs in one compiled call (`HeadingDriveClearance` without a delay), it judges all
    proposals first; an env whose proposal it does not admit is then decided by its own filter, with the same bits.

    Args:
        env: A `SyncVectorEnv`, or vector wrappers around one that leave actions as they are. In an `AsyncVectorEnv`
            the states are in other processes: filter each env there. It is changed in place: its envs become
            `filters`.
        constraints: As for `CBFActionFilter`; so are the other arguments.
        plant: Not bound yet; every env gets a copy. None reads its MuJoCo model.
        fallback: See there.
        margin: See there.

    Attributes:
        filters: Each env's filter.
        constraint_batch: What judges all proposals in one call, or None: each is judged by its own filter.

    Raises:
        UnsupportedEnvError: Not such a vector env.
        ConfigurationError: As `CBFActionFilter`.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> envs = gym.make_vec("Reacher-v5", num_envs=2, vectorization_mode="sync")
        >>> envs = sw.VectorCBFActionFilter(envs, [sw.constraints.JointSpeedLimit(limit=4.0)])
        >>> _ = envs.reset(seed=0)
        >>> infos = envs.step(envs.action_space.sample())[4]
        >>> infos["cbf/margin"].shape
        (2,)
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        constraints: Sequence[Constraint | dict[str, Any]],
        plant: Plant | None = None,
        fallback: str | FallbackFunction = "brake",
        margin: float = 0.0,
    ) -> None:
        super().__init__(env)
        envs = single_envs(env)
        for single in envs:
            refuse_order(single, CBFActionFilter.layer, CBFActionFilter.__name__)
        self.filters = [
            _FilterOfMany(single, constraints, copy.deepcopy(plant), fallback, margin) for single in envs
        ]
        envs[:] = self.filters
        for i, single in enumerate(self.filters):
            single.place, single.warned = i, self.filters[0].warned
        space: Any = envs[0].action_space
        self._low, self._high = space.low.astype(float), space.high.astype(float)
        self._next_step = env.metadata.get("autoreset_mode") is AutoresetMode.NEXT_STEP
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._make_batch()

    def _make_batch(self) -> None:
        """Judge all envs at once, where their constraint can."""
        self._batched = [single.filter.bound[0] for single in self.filters]
        alone = len(self.filters[0].filter.bound) == 1
        self.constraint_batch = self._batched[0].batch(self._batched) if alone else None
        for single in self.filters:
            single.batch = self.constraint_batch

    def _follow_models(self, envs: Mask) -> None:
        """Read the models of these envs anew where they have changed; what the batch has remembered stays."""
        for i in np.flatnonzero(envs).tolist():
            engine = self.filters[i].filter
            engine.plant.follow()
            if engine.outdated:
                engine.observe()
        bound = [single.filter.bound[0] for single in self.filters]
        if any(new is not old for new, old in zip(bound, self._batched, strict=True)):
            before = self.constraint_batch
            self._make_batch()
            if before is not None and self.constraint_batch is not None:
                for i in range(self.num_envs):
                    self.constraint_batch.restart(i, before.memory(i))

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all envs, or those of ``options["reset_mask"]``."""
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs)), dtype=bool)
        for i in np.flatnonzero(mask).tolist():
            self.filters[i].started = False
        self._ended[mask] = False
        # The vector env takes the mask out of its options.
        return self.env.reset(seed=seed, options=options and dict(options))  # type: ignore[arg-type]

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Filter the actions, shape (n, m), and step the envs with what may be executed."""
        if not all(single.started for single in self.filters):
            raise gym.error.ResetNeeded("call reset before step; the last one may have failed")
        given = action_array(actions, (self.num_envs, *self._low.shape))
        if self.constraint_batch is None:
            return self.env.step(list(given))
        proposed = given.astype(np.float64)
        margins, admitted = self._judge_together(proposed)
        answer = self.env.step(list(given))
        self._ended = np.asarray(answer[2] | answer[3])
        self._report(answer[4], admitted & ~self._ended, margins, proposed)
        return answer

    def _judge_together(self, proposed: Array) -> tuple[Array, Mask]:
        """The smallest h of each env, and whose proposals are admitted; the others' filters will judge alone."""
        judged = ~self._ended if self._next_step else np.ones(self.num_envs, dtype=bool)
        self._follow_models(judged)
        batch = self.constraint_batch
        assert batch is not None
        inside = ((proposed >= self._low) & (proposed <= self._high)).all(axis=1)
        margins, admitted = batch.judge(np.clip(proposed, self._low, self._high))
        # An unsafe or unreadable state (NaN) gets a warning from its own filter.
        usual: Mask = judged & inside & admitted & (margins >= -SAFE_TOLERANCE)
        batch.executed(usual)
        for i, single in enumerate(self.filters):
            # None also where a step that another env has broken off left an admission.
            single.admitted = float(margins[i]) if usual[i] else None
        return margins, usual

    def _report(self, infos: dict[str, Any], quiet: Mask, margins: Array, proposed: Array) -> None:
        """Write the info keys of envs that changed nothing and whose episode goes on; the others' are written."""
        for key, value in self.filters[0].quiet_report(0.0, proposed[0]).items():
            if key not in infos:
                infos[key] = np.zeros((self.num_envs, *np.shape(value)), dtype=np.asarray(value).dtype)
                infos[f"_{key}"] = np.zeros(self.num_envs, dtype=bool)
            infos[f"_{key}"][quiet] = True
        infos[keys.CBF_MARGIN][quiet] = np.where(np.isfinite(margins), margins, 0.0)[quiet]
        infos[keys.PROPOSED_ACTION][quiet] = infos[keys.EXECUTED_ACTION][quiet] = proposed[quiet]


class _FilterOfMany(CBFActionFilter):
    """The filter of one env, whose proposal may have been admitted together with those of others."""

    place: int
    batch: ConstraintBatch | None = None  # remembers the episode
    admitted: float | None = None  # the smallest h, where the batch has admitted the next action

    def start_report(self) -> dict[str, Any]:
        report = super().start_report()
        self.admitted = None
        if self.batch is not None:
            self.batch.restart(self.place, self.filter.memories[0])
        return report

    def judge(self, action: Any) -> tuple[Any, dict[str, Any]]:
        if self.batch is None:
            return super().judge(action)
        self.filter.memories = [self.batch.memory(self.place)]
        judged = super().judge(action)
        self.batch.restart(self.place, self.filter.memories[0])
        return judged

    def step(self, action: Any) -> Step:
        """As ever; of what was admitted the vector filter reports, unless the episode ends."""
        if self.admitted is None:
            return super().step(action)
        margin, self.admitted = self.admitted, None
        self.filter.last = proposed = action.astype(np.float64)
        self.plant.executed(proposed)
        self.filter_calls += 1
        observation, reward, terminated, truncated, info = self.plant.step(self.env, action)
        mismatch = self.deviates()
        if terminated or truncated:
            info |= self.quiet_report(margin, proposed)
        if terminated or truncated or mismatch:
            info[keys.CBF_MISMATCH] = mismatch
        return observation, reward, terminated, truncated, info

    def quiet_report(self, margin: float, proposed: Array) -> dict[str, Any]:
        """The info keys of a step that changes nothing."""
        report = self._quiet_report() | {keys.CBF_MARGIN: margin if math.isfinite(margin) else 0.0}
        return report | {keys.PROPOSED_ACTION: proposed, keys.EXECUTED_ACTION: proposed.copy()}


def single_envs(env: VectorEnv[Any, Any, Any]) -> list[gym.Env[Any, Any]]:
    """The list of envs in a `SyncVectorEnv`, or an error that says what to do with another vector env."""
    inner: Any = env
    while isinstance(inner, VectorWrapper):
        if isinstance(inner, VectorActionWrapper | VectorCBFActionFilter):
            raise ConfigurationError(
                f"{type(inner).__name__} inside the filter changes the actions that the filter has checked; put it "
                "outside (filter first, then this wrapper), so that the filter has the last word"
            )
        inner = inner.env
    if not isinstance(inner, SyncVectorEnv):
        raise UnsupportedEnvError(
            f"expected a SyncVectorEnv, whose envs are in this process, got {inner!r}; protect each env of it: "
            + by_env(inner)
        )
    envs: list[gym.Env[Any, Any]] = inner.envs
    return envs


def by_env(env: VectorEnv[Any, Any, Any]) -> str:
    """The line that makes the same vector env of protected envs."""
    if env.spec is None:
        envs = f"[lambda: sw.protect(gym.make(...))] * {env.num_envs}"
        return f"gym.vector.{type(env.unwrapped).__name__}({envs})"
    options = "".join(f"{name}={value!r}, " for name, value in env.spec.kwargs.items())
    return f"gym.make_vec({env.spec.id!r}, {options}wrappers=[sw.protect])"
