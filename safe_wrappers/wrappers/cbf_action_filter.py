"""CBFActionFilter: executes the policy's action, or one near it that every constraint admits, or a fallback."""

import copy
import math
import threading
import time
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.errors import Array, ConfigurationError, UnsafeStateWarning, non_negative
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.filter.engine import SafetyFilter
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.filter.search import SafeActionSearch, Stage
from safe_wrappers.plants import default_plant, own_plant
from safe_wrappers.plants.env_checks import check_actions, wrappers_of
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Reset, Step, action_array
from safe_wrappers.wrappers.serialize import constraint_from
from safe_wrappers.wrappers.stack import Layer

SAFE_TOLERANCE = 1e-6
"""h below zero by less is rounding (of float32 actions, too), in the constraints' own units."""


class CBFActionFilter(LayerWrapper):
    """Filters actions through constraints, all of them in one projection.

    An action that every constraint admits is executed bit for bit; others are projected onto the rows of all
    constraints and the actuator box at once, and checked; if nothing admissible is found, the fallback acts
    ("brake": where constraints forecast, what violates least of all that was tried).

    **What it guarantees.** No non-finite action, and none outside the action space, reaches the env. The executed
    action satisfies every constraint's rows (to 1e-8 of half the box) or, where a constraint predicts the held
    step, its prediction; else `cbf/infeasible` or `cbf/fallback` is True. If every constraint's `promise` is
    "proved" and the plant is right within the constraints' margins, episodes that start safe stay safe at every
    physics substep, whatever the fallback.

    **What it does not.** A "best effort" constraint, a plant outside its margins, or a start that is already
    unsafe (warned of once per episode, counted in `cbf/unsafe`) void that.

    Args:
        env: With a one-dimensional Box action space.
        constraints: Instances, or the plain dicts that a recorded filter holds. They are copied.
        plant: None reads the env's MuJoCo model, or simulates the env where a constraint does; else an
            `AnalyticPlant`.
        fallback: "brake", "hold", "zero", or a function of the plant that returns a control.
        margin: Added to every constraint's own `margin`, in that constraint's unit (m, rad/s, ...).

    Info, at every step (see `safe_wrappers.info`): ``cbf/intervened``, ``cbf/infeasible``,
    ``cbf/fallback``, ``cbf/nonfinite``, ``cbf/unsafe``, ``cbf/mismatch`` (bool); ``cbf/correction``,
    ``cbf/margin`` (float); ``cbf/stage`` (int); ``cbf/refused``, ``proposed_action``, ``executed_action`` (arrays).

    Attributes:
        filter: The `SafetyFilter` that decides; `filter.bound` are the constraints on the plant.
        constraint_names: Of the constraints, in the order of ``cbf/refused``: their kinds, numbered if repeated.
        warned: What has been warned of: "nonfinite", "clipped", "mismatch", and "unsafe" until the next reset.
        started: Whether there is an episode: the last reset has not failed.
        filter_seconds: Wall time spent filtering so far; `filter_calls` says over how many steps.

    Raises:
        ConfigurationError: Not a Box action space, an empty list, or a constraint or plant that does not fit.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(limit=4.0)])
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> info["cbf/margin"] > 0.0
        True
    """

    layer: ClassVar = Layer.FILTER
    _search: ClassVar[type[SafeActionSearch]] = SafeActionSearch

    def __init__(
        self,
        env: Env,
        constraints: Sequence[Constraint | dict[str, Any]],
        plant: Plant | None = None,
        fallback: str | FallbackFunction = "brake",
        margin: float = 0.0,
    ) -> None:
        LayerWrapper.__init__(self, env)
        self._take_action_space(env)
        plant = own_plant(plant)
        if isinstance(constraints, str | dict) or not isinstance(constraints, Sequence) or not constraints:
            raise ConfigurationError(f"constraints is a list with at least one, got {constraints!r}")
        own = [copy.deepcopy(c) for c in [*map(constraint_from, constraints)]]
        if margin := non_negative("margin", margin, "the constraints' own units"):
            own = [c.widened(margin) for c in own]
        self.constraint_names = _unique([type(c).__name__ for c in own])
        self.plant: Plant = plant if plant is not None else default_plant(env, own)
        self.plant.bind(env)
        of_actions = self._low, self._high, self._dtype, self._search
        self.filter = SafetyFilter(self.plant, own, fallback, *of_actions)
        self._observed = False
        self.filter_seconds, self.filter_calls = 0.0, 0
        self._deciding = threading.RLock()

    def __getstate__(self) -> dict[str, Any]:
        """All but the lock, which no copy shares."""
        return {name: value for name, value in vars(self).items() if name != "_deciding"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take a state of `__getstate__`."""
        super().__setstate__(state)
        self._deciding = threading.RLock()

    def _take_action_space(self, env: Env) -> None:
        space = check_actions(env)
        self._low, self._high = np.asarray(space.low, np.float64), np.asarray(space.high, np.float64)
        self._shape: tuple[int, ...] = space.shape
        self._dtype: Any = space.dtype

    @property
    def constraints(self) -> list[Constraint]:
        """The constraints with the added margin, as given but for what they found on the plant."""
        for given, bound in zip(self.filter.constraints, self.filter.bound, strict=True):
            vars(given).update({k: v for k, v in vars(bound.spec).items() if k in ("promise", "validated")})
        return list(self.filter.constraints)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env and forget the episode: commands in flight, the last action, the warning.

        Another thread's step is waited for, as another reset.
        """
        with self._deciding:
            return super().reset(seed=seed, options=options)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self.warned.discard("unsafe")
        self._observed = False
        self.plant.received(observation, info)
        self.filter.start()
        info |= dict.fromkeys(keys.CBF_BOOLS, False) | dict.fromkeys(keys.CBF_FLOATS, 0.0)
        info[keys.CBF_MARGIN], info[keys.CBF_UNSAFE] = self._margin()
        info[keys.CBF_REFUSED] = np.zeros(len(self.filter.bound), dtype=bool)
        info[keys.CBF_STAGE] = int(Stage.PROPOSAL)
        # When all sub-envs of a vector env reset at once, its infos hold only the keys that a reset reports.
        info[keys.PROPOSED_ACTION], info[keys.EXECUTED_ACTION] = np.zeros((2, *self._shape))
        info |= self.filter.info()
        return observation

    def step(self, action: Any) -> Step:
        """Filter the action and step the env with what may be executed; another thread waits meanwhile."""
        with self._deciding:  # the env makes the step that was judged, from the state in which it was
            started = time.perf_counter()
            sent, report = self._judge(action)
            self.filter_seconds += time.perf_counter() - started
            self.filter_calls += 1
            observation, reward, terminated, truncated, info = self.plant.step(self.env, sent)
            self.plant.received(observation, info)
            info |= report
            if deviation := self.plant.deviation():
                message = f"{deviation}; what the filter guarantees does not hold (cbf/mismatch)"
                self._warn_once("mismatch", message)
                info[keys.CBF_MISMATCH] = True
            info |= self.filter.info()
        return observation, reward, terminated, truncated, info

    def observe(self) -> None:
        """Take the env's present state ahead of `step`, for a wrapper outside that asks `filter` about it.

        `step` then decides in this state, and has to be what happens to the env next.
        """
        self.filter.observe()
        self._observed = True

    def look(self) -> Sequence[Bound]:
        """The constraints in the env's present state, for who looks on; none where that is not a number.

        `step` observes anew, and decides and reports what it would have.
        """
        count = self.plant.observation_id
        self.filter.observe()
        self.plant.observation_id = count
        return self.filter.bound if self.filter.margin == self.filter.margin else ()

    def _judge(self, action: Any) -> tuple[Any, dict[str, Any]]:
        """What to send for a proposed action in the env's present state, and the step's info keys."""
        self._refuse_without_reset()
        proposed: Array = action_array(action, self._shape, np.float64)
        if not self._observed:
            self.filter.observe()
        self._observed = False
        margin, unsafe = self._margin()
        readable = self.filter.margin == self.filter.margin
        # False for NaN too, so that one comparison clears the common case.
        inside = bool(((proposed >= self._low) & (proposed <= self._high)).all())
        finite = inside or bool(np.isfinite(proposed).all())
        usable: Array | None = proposed
        if not (readable and finite):
            if readable:
                self._warn_once(
                    "nonfinite", f"the policy's action is not finite ({proposed}); the fallback acts"
                )
            usable, proposed = None, np.where(np.isfinite(proposed), proposed, 0.0)
        elif not inside:
            usable = np.clip(proposed, self._low, self._high)
            clipped = float(np.linalg.norm(usable - proposed))
            message = f"the policy's action left the action space by {clipped:.3g}; it is boxed"
            self._warn_once("clipped", message)
        decision = self.filter.filter(usable)
        intervened = decision.changed
        if inside and not decision.changed:
            # Bit for bit the policy's own action wherever the filter has nothing to say.
            sent, executed, correction = action, proposed.copy(), 0.0
        else:
            sent = decision.control.astype(self._dtype)
            executed = sent.astype(np.float64)
            correction = float(np.linalg.norm(executed - proposed))
            if finite and readable:
                # What fails least may be the proposal itself, and a change may be lost in rounding.
                intervened &= bool((executed != np.clip(proposed, self._low, self._high)).any())
        self.filter.executed(executed)
        refused = decision.refused
        return sent, {
            keys.CBF_INTERVENED: intervened,
            keys.CBF_INFEASIBLE: decision.infeasible,
            keys.CBF_FALLBACK: decision.fallback,
            keys.CBF_NONFINITE: not finite,
            keys.CBF_UNSAFE: unsafe,
            keys.CBF_MISMATCH: False,
            keys.CBF_REFUSED: np.zeros(len(self.filter.bound), dtype=bool) if refused is None else refused,
            keys.CBF_CORRECTION: correction,
            keys.CBF_MARGIN: margin,
            keys.PROPOSED_ACTION: proposed,
            keys.EXECUTED_ACTION: executed.copy(),
            keys.CBF_STAGE: int(decision.stage),
        }

    def _margin(self) -> tuple[float, bool]:
        """`cbf/margin` and `cbf/unsafe`: 0 where no h is finite, unsafe where the state or an h is not a number."""
        lowest = self.filter.margin
        unsafe = not lowest >= -SAFE_TOLERANCE
        margin = lowest if math.isfinite(lowest) else 0.0
        if unsafe:
            message = (
                f"the state is outside the safe set (cbf/margin = {margin:.3g}); nothing is promised there"
            )
            self._warn_once("unsafe", message, UnsafeStateWarning)
        return margin, unsafe


def _unique(kinds: list[str]) -> list[str]:
    """A number behind every kind that occurs more than once."""
    places = [kinds[: i + 1].count(kind) for i, kind in enumerate(kinds)]
    return [k if kinds.count(k) == 1 else f"{k} {place}" for k, place in zip(kinds, places, strict=True)]


def filter_inside(env: Env) -> CBFActionFilter | None:
    """The filter among an env's wrappers, or None."""
    return next((inner for inner in wrappers_of(env) if isinstance(inner, CBFActionFilter)), None)
