"""VectorCBFActionFilter: CBFActionFilter for a vector env, whose envs are decided together."""

import copy
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorActionWrapper, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Constraint, ConstraintBatch
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.cbf_action_filter import SAFE_TOLERANCE, CBFActionFilter
from safe_wrappers.wrappers.layer import action_array

Mask = NDArray[np.bool_]
Rows = NDArray[Any] | list[NDArray[Any]]
"""The envs' actions; a list where they have different dtypes."""


if TYPE_CHECKING:
    _Wrapper = VectorWrapper[Any, Any, Any, Any, Any]
else:
    _Wrapper = VectorWrapper  # no generic class in Gymnasium 1.1


class VectorCBFActionFilter(_Wrapper):
    """Filters the actions of all envs of a `SyncVectorEnv`.

    Every env has a `CBFActionFilter` of its own beside it, with the same guarantees; its executed actions are the
    same, bit for bit. Where the only constraint can judge many proposals in one compiled call
    (`HeadingDriveClearance` without a delay), it does; what it refuses, and other envs, are decided one by one.

    Infos are those that filtered envs give to a `SyncVectorEnv`, in all three autoreset modes: a step that resets an
    env reports the new episode, and with `AutoresetMode.SAME_STEP` the last step is in ``infos["final_info"]``.

    Args:
        env: A `SyncVectorEnv`, or vector wrappers around one that leave actions as they are. In an `AsyncVectorEnv`
            the states are in other processes: filter each env there.
        constraints: As for `CBFActionFilter`; so are the other arguments.
        plant: Not bound yet; every env gets a copy. None reads its MuJoCo model.
        fallback: See there.
        margin: See there.

    Attributes:
        filters: Each env's `CBFActionFilter`, which judges but does not step; its `filter_seconds` are its share.
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
        plants = [copy.deepcopy(plant) for _ in envs]
        self.filters = [
            CBFActionFilter(single, constraints, own, fallback, margin)
            for single, own in zip(envs, plants, strict=True)
        ]
        space = envs[0].action_space
        assert isinstance(space, gym.spaces.Box)  # CBFActionFilter has refused every other space
        self._low, self._high, self._dtype = space.low.astype(float), space.high.astype(float), space.dtype
        self._last = np.zeros((self.num_envs, *self._low.shape))
        self._make_batch(None)
        for single in self.filters:
            single.warned = self.filters[0].warned
        self._same_step = env.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP
        self._next_step = env.metadata.get("autoreset_mode") is AutoresetMode.NEXT_STEP
        self._ended = np.zeros(self.num_envs, dtype=bool)

    def _make_batch(self, before: ConstraintBatch | None) -> None:
        """Judge all envs at once, where their constraint can; what a batch before has remembered stays."""
        self._batched = [single.filter.bound[0] for single in self.filters]
        alone = len(self.filters[0].filter.bound) == 1
        batch = self._batched[0].batch(self._batched) if alone else None
        if batch is not None and before is not None:
            for i in range(self.num_envs):
                batch.restart(i, before.memory(i))
        self.constraint_batch = batch

    def _follow_models(self, envs: Mask) -> None:
        """Read the models of these envs anew where they have changed."""
        for i in np.flatnonzero(envs).tolist():
            engine = self.filters[i].filter
            engine.plant.follow()
            if engine.outdated:
                engine.observe()
        self._follow_constraints()

    def _follow_constraints(self) -> None:
        """A batch is of the constraints that are bound at present."""
        if any(
            single.filter.bound[0] is not own for single, own in zip(self.filters, self._batched, strict=True)
        ):
            self._make_batch(self.constraint_batch)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all envs, or those of ``options["reset_mask"]``."""
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs)), dtype=bool)
        for i in np.flatnonzero(mask).tolist():
            self.filters[i].started = False
        # The vector env takes the mask out of its options.
        observations, infos = self.env.reset(seed=seed, options=options and dict(options))  # type: ignore[arg-type]
        self._ended[mask] = False
        self._received(observations, infos, mask)
        self._start(infos, mask)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Filter the actions, shape (n, m), and step the envs with what may be executed."""
        if not all(single.started for single in self.filters):
            raise gym.error.ResetNeeded("call reset before step; the last one may have failed")
        started = time.perf_counter()
        given = action_array(actions, (self.num_envs, *self._low.shape))
        judged = ~self._ended if self._next_step else np.ones(self.num_envs, dtype=bool)
        # What is written is in the space's dtype, in which an env may compute; the rest stays in that of the policy.
        sent = given.copy() if given.dtype == self._dtype else list(given)
        reports = self._judge(given, sent, judged)
        each = (time.perf_counter() - started) / max(1, int(judged.sum()))
        for single, was_judged in zip(self.filters, judged.tolist(), strict=True):
            single.filter_seconds += each * was_judged
            single.filter_calls += was_judged
        observations, rewards, terminated, truncated, infos = self.env.step(sent)
        self._ended = np.asarray(terminated | truncated)
        restarted = self._ended if self._same_step else ~judged
        if self._same_step and restarted.any():
            self._received(infos["final_obs"], infos["final_info"], restarted)
        self._received(observations, infos, ~restarted)
        self._compare(reports, judged)
        self._report(infos, reports, judged & ~restarted)
        if self._same_step and restarted.any():
            self._report(infos["final_info"], reports, restarted)
        self._received(observations, infos, restarted)
        self._start(infos, restarted)
        return observations, rewards, terminated, truncated, infos

    def _compare(self, reports: dict[str, NDArray[Any]], judged: Mask) -> None:
        """`cbf/mismatch`; a state that another episode has replaced within the step cannot be compared."""
        replaced = self._same_step and not self.filters[0].plant.simulates
        for i in np.flatnonzero(judged & ~self._ended if replaced else judged).tolist():
            reports[keys.CBF_MISMATCH][i] = self.filters[i].deviates()

    def _received(self, observations: Any, infos: dict[str, Any], mask: Mask) -> None:
        """Tell plants that simulate what their envs have returned."""
        if not self.filters[0].plant.simulates:
            return
        # Last observations of episodes are in an array of objects, which needs no space to be taken apart.
        final = isinstance(observations, np.ndarray) and observations.dtype == object
        each = observations if final else list(iterate(self.observation_space, observations))
        numbers = {
            key: value for key, value in infos.items() if isinstance(value, np.ndarray) and f"_{key}" in infos
        }
        for i in np.flatnonzero(mask).tolist():
            own = {key: value[i] for key, value in numbers.items() if infos[f"_{key}"][i]}
            self.filters[i].plant.received(copy.deepcopy(each[i]), own)

    def _judge(self, given: NDArray[Any], sent: Rows, judged: Mask) -> dict[str, NDArray[Any]]:
        """Write what to send where it is not what was given; the info keys of all envs, shape (n, ...)."""
        n = self.num_envs
        reports: dict[str, NDArray[Any]] = {key: np.zeros(n, dtype=bool) for key in keys.CBF_BOOLS}
        reports |= {key: np.zeros(n) for key in keys.CBF_FLOATS} | {
            keys.CBF_STAGE: np.zeros(n, dtype=np.int64)
        }
        reports[keys.CBF_REFUSED] = np.zeros((n, len(self.filters[0].constraints)), dtype=bool)
        reports[keys.PROPOSED_ACTION], reports[keys.EXECUTED_ACTION] = np.zeros((2, *given.shape))
        left = judged
        if self.constraint_batch is not None:
            self._follow_models(judged)
            together = self._judge_together(self.constraint_batch, given, sent, judged, reports)
            for i in np.flatnonzero(together).tolist():
                self.filters[i].plant.executed(reports[keys.EXECUTED_ACTION][i])
            left = judged & ~together
        for i in np.flatnonzero(left).tolist():
            engine = self.filters[i].filter
            if self.constraint_batch is not None:
                engine.memories, engine.last = [self.constraint_batch.memory(i)], self._last[i].copy()
            sent[i], report = self.filters[i].judge(given[i])
            for key, value in report.items():
                reports[key][i] = value
            if self.constraint_batch is not None:
                self.constraint_batch.restart(i, engine.memories[0])
        self._last[judged] = reports[keys.EXECUTED_ACTION][judged]
        return reports

    def _judge_together(
        self,
        batch: ConstraintBatch,
        given: NDArray[Any],
        sent: Rows,
        judged: Mask,
        reports: dict[str, NDArray[Any]],
    ) -> Mask:
        """`CBFActionFilter.judge` for the envs whose proposals are admitted; False where an env is judged alone."""
        proposed = given.astype(np.float64)
        inside = ((proposed >= self._low) & (proposed <= self._high)).all(axis=1)
        boxed = np.clip(proposed, self._low, self._high)
        margins, admitted = batch.judge(boxed)
        # An unsafe or unreadable state (NaN) gets a warning, and so does the first action outside of the box.
        known = inside | (np.isfinite(proposed).all(axis=1) & ("clipped" in self.filters[0].warned))
        usual: Mask = judged & known & admitted & (margins >= -SAFE_TOLERANCE)
        batch.executed(usual)
        written, executed = usual & ~inside, np.where(inside[:, None], proposed, boxed.astype(self._dtype))
        for i in np.flatnonzero(written).tolist():
            sent[i] = executed[i].astype(self._dtype)
        found = {
            keys.CBF_MARGIN: np.where(np.isfinite(margins), margins, 0.0),
            keys.PROPOSED_ACTION: proposed,
            keys.EXECUTED_ACTION: executed,
        }
        if written.any():
            found[keys.CBF_CORRECTION] = np.linalg.norm(executed - proposed, axis=1)
        for key, values in found.items():
            reports[key][usual] = values[usual]
        return usual

    def _report(self, infos: dict[str, Any], reports: dict[str, NDArray[Any]], mask: Mask) -> None:
        """Write the reports of the envs in the mask as Gymnasium writes those of single envs."""
        if not mask.any():
            return
        for key, values in reports.items():
            infos[key], infos[f"_{key}"] = values.copy(), mask.copy()  # the rest goes into final_info
            infos[key][~mask] = 0
        if self.filters[0].filter.reporting:
            actions = reports[keys.PROPOSED_ACTION], reports[keys.EXECUTED_ACTION]
            for i in np.flatnonzero(mask).tolist():
                self._add_info(infos, self.filters[i].filter.info(*(action[i] for action in actions)), i)

    def _start(self, infos: dict[str, Any], restarted: Mask) -> None:
        """Take the states of new episodes, and report them."""
        started = np.flatnonzero(restarted).tolist()
        for i in started:
            self._add_info(infos, self.filters[i].start_report(), i)
        if self.constraint_batch is not None:
            self._follow_constraints()
        for i in started:
            engine = self.filters[i].filter
            self._last[i] = engine.last
            if self.constraint_batch is not None:
                self.constraint_batch.restart(i, engine.memories[0])


def single_envs(env: VectorEnv[Any, Any, Any]) -> list[gym.Env[Any, Any]]:
    """The envs in a `SyncVectorEnv`, or an error that says what to do with another vector env."""
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
    return list(inner.envs)


def by_env(env: VectorEnv[Any, Any, Any]) -> str:
    """The line that makes the same vector env of protected envs."""
    if env.spec is None:
        envs = f"[lambda: sw.protect(gym.make(...))] * {env.num_envs}"
        return f"gym.vector.{type(env.unwrapped).__name__}({envs})"
    options = "".join(f"{name}={value!r}, " for name, value in env.spec.kwargs.items())
    return f"gym.make_vec({env.spec.id!r}, {options}wrappers=[sw.protect])"
