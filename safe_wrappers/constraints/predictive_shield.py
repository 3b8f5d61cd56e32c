"""PredictiveShield: an action is admitted if some backup keeps h after it, in a simulation."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import non_negative, positive, whole_number
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.filter.constraint import Array, BoundConstraint, Constraint, Memory
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.rollouts import Policy, RolloutPlant, View

Value = Callable[[Any, Array], ArrayLike]
"""Of an observation and actions, shape (k, m): how good they are, shape (k,)."""
SEES = ("observation", "env")
_NOT_REACHED = -math.ulp(0.0)  # the slack of a rollout that keeps h but does not end in the terminal set


@dataclass
class PredictiveShield(Constraint):
    """Keep `h >= margin` at the end of every step, by simulating what a backup could do after an action.

    An action is admitted if after it one of the backups keeps h to the horizon, or until the episode ends, or, with a
    `terminal` set, until it has reached that set. Of a refused action's neighbours, and the first actions of the
    backups, the nearest that is admitted is executed, or the best by `value`.

    **Proved for the copy and the terminal set**, if there is one: a state from which a backup reaches it stays such a
    state, whatever the policy does, if the simulation is the env (`SimulatorPlant` checks that), the set is invariant
    under that backup with h >= margin, and backups depend on the state alone. **Best effort: horizon**, without one:
    what comes later is not looked at, and an admitted action may lead where every backup loses. h between the ends of
    steps is not looked at either.

    Args:
        h: A function of what it `sees` that returns a number, at least 0 where all is well; or the name of an info
            key that is a cost, positive where it is not ("cost").
        horizon: Steps that are simulated, the proposed action among them.
        backup: "zero" (not with discrete actions), "hold" (the action goes on), an action, a function of what it
            `sees` that returns one, anything with `predict(observation, deterministic=True)` such as an SB3 model; or
            a list of these: any that survives admits.
        terminal: A function of what it `sees`: whether the state lies in a set that the backups never leave, with
            h >= margin. None: there is none.
        sees: Whether `h`, `terminal` and `backup` take the "observation", as the env inside the filter returns it, or
            the unwrapped "env".
        candidates: How many neighbours of a refused action are tried. With discrete actions all are.
        value: Chooses among those that are admitted, such as `safe_wrappers.sb3.critic_value(model)`. None: the
            nearest is taken, and no more are tried.
        margin: Kept free, in the unit of h.
        max_decrease: The most that h can fall within the horizon, whatever is done, in its unit; from a state with
            more than that left nothing is simulated. None: always simulate.
    """

    h: Callable[[Any], float] | str
    horizon: int
    backup: Any = "zero"
    terminal: Callable[[Any], bool] | None = None
    sees: Literal["observation", "env"] = "observation"
    candidates: int = 16
    value: Value | None = None
    margin: float = 0.0
    max_decrease: float | None = None

    simulates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not (callable(self.h) or (isinstance(self.h, str) and self.h)):
            raise ConfigurationError(f"h is a function of the {self.sees}, or an info key; got {self.h!r}")
        self.horizon = whole_number("horizon", self.horizon, 1, "steps")
        if self.sees not in SEES:
            raise UnknownNameError(f"sees is one of {', '.join(SEES)}; got {self.sees!r}")
        for name in ("terminal", "value"):
            given = getattr(self, name)
            if given is not None and not callable(given):
                raise ConfigurationError(f"{name} is a function or None, got {given!r}")
        self.candidates = whole_number("candidates", self.candidates, 0, "actions")
        self.margin = non_negative("margin", self.margin, "the unit of h")
        if self.max_decrease is not None:
            self.max_decrease = positive("max_decrease", self.max_decrease, "the unit of h")
        self.promise = "best effort" if self.terminal is None else "proved"
        backups = self.backup if isinstance(self.backup, list | tuple) else [self.backup]
        if not backups:
            raise ConfigurationError("backup is a backup, or a list with at least one")
        self.backups = [_checked(one) for one in backups]

    def bind(self, plant: Plant) -> "BoundPredictiveShield":
        return BoundPredictiveShield(self, plant)


def _checked(backup: Any) -> Any:
    """A backup; of a model its `predict`, which is not copied with the constraint."""
    if hasattr(backup, "predict"):
        return _PolicyBackup(backup)
    if isinstance(backup, str) and backup not in ("zero", "hold"):
        raise UnknownNameError(
            f"no backup {backup!r}; give zero, hold, an action, a function, a model, or a list of these"
        )
    if not callable(backup) and not isinstance(backup, str | np.ndarray | int | np.integer):
        raise ConfigurationError(
            f"backup is zero, hold, an array or a whole number, a function, a model, or a list; got {backup!r}"
        )
    return backup


class _PolicyBackup:
    """A model's deterministic actions. Copies share the model."""

    def __init__(self, model: Any) -> None:
        self.model = model

    def __deepcopy__(self, memo: dict[int, Any]) -> "_PolicyBackup":
        return self

    def __call__(self, observation: Any) -> Any:
        return self.model.predict(observation, deterministic=True)[0]


class Plan(NamedTuple):
    """What a control leaves of the requirement with the best backup after it, and which one that is."""

    slack: float
    backup: int


class BoundPredictiveShield(BoundConstraint):
    """PredictiveShield on a plant that simulates."""

    predicts = True
    spec: PredictiveShield
    plant: RolloutPlant

    def __init__(self, spec: PredictiveShield, plant: Plant) -> None:
        plant.require_simulation("PredictiveShield")
        super().__init__(spec, plant)
        self.info_keys = self.plant.info_keys
        if not self.plant.simulates_env and (spec.sees == "env" or isinstance(spec.h, str)):
            raise UnsupportedEnvError(
                f"the rollouts of an {type(plant).__name__} have observations alone, and neither an env nor its "
                'info: take sees="observation", and as h a function of it'
            )
        discrete = self.plant.discrete
        if discrete and "zero" in [one for one in spec.backups if isinstance(one, str)]:
            raise ConfigurationError(
                "a discrete action has no zero: give as backup the action that is safe, or hold, or a function"
            )
        self._policies: list[Policy | None] = [self._policy(one) for one in spec.backups]
        self._needed = spec.margin + self.plant.margins(self._measure, spec.horizon)
        offsets = np.random.default_rng(0).uniform(-1.0, 1.0, (spec.candidates, self.plant.lower.size))
        # A quarter of them anywhere, the others nearer and nearer.
        self._offsets = offsets * np.geomspace(1.0, 0.05, spec.candidates or 1)[: len(offsets), None]

    def start(self) -> Memory:
        return 0, np.clip(np.zeros_like(self.plant.lower), self.plant.lower, self.plant.upper)

    def observe(self, memory: Memory) -> None:
        self._survivor, self._last = memory
        self._known: dict[bytes, Plan] = {}
        view = self.plant.view
        # Many envs report their cost after steps, and not after a reset.
        self._unknown = isinstance(self.spec.h, str) and self.spec.h not in view.info
        self._now = math.inf if self._unknown else self._measure(view)

    def check(self) -> None:
        for index in range(len(self._policies)):
            self._first(index)

    def value(self) -> Array:
        return np.zeros(0) if self._unknown else np.array([self._now])

    def _measure(self, view: View) -> float:
        """h; NaN where it is not a number."""
        spec = self.spec
        if isinstance(spec.h, str):
            if spec.h not in view.info:
                raise ConfigurationError(f"the env reports no info[{spec.h!r}]; it has {sorted(view.info)}")
            return -float(view.info[spec.h])
        h = np.asarray(spec.h(self._seen(view)), dtype=np.float64)
        if h.size != 1:
            raise ConfigurationError(f"h must return one number, got an array of shape {h.shape}")
        return float(h.reshape(()))

    def _seen(self, view: View) -> Any:
        return view.env if self.spec.sees == "env" else view.observation

    def _terminal(self, view: View) -> bool:
        assert self.spec.terminal is not None
        return bool(self.spec.terminal(self._seen(view)))

    def _policy(self, backup: Any) -> Policy | None:
        """The backup as a function of a view; None holds."""
        if isinstance(backup, str):
            zero = self.plant.control(np.zeros(self.plant.lower.shape), "zero") if backup == "zero" else None
            return None if zero is None else lambda view: self.plant.action(zero)
        if isinstance(backup, _PolicyBackup):
            return lambda view: self._action(backup(view.observation), "the backup")
        if callable(backup):
            return lambda view: self._action(backup(self._seen(view)), "the backup")
        constant = self._action(backup, "backup")
        return lambda view: constant

    def _action(self, given: Any, of: str) -> Any:
        return self.plant.action(self.plant.control(given, of))

    def _first(self, index: int) -> Array:
        """What a backup would do now, shape (m,)."""
        policy = self._policies[index]
        return self._last if policy is None else self.plant.control(policy(self.plant.view), "the backup")

    def plan(self, control: Array) -> Plan:
        """The first backup that keeps h after a control, the survivor of the last step first, else the best."""
        key = control.tobytes()
        if key not in self._known:
            order = sorted(range(len(self._policies)), key=lambda index: index != self._survivor)
            best = Plan(-math.inf, order[0])
            for index in order:
                slack = self._slack(control, self._policies[index])
                if slack > best.slack:
                    best = Plan(slack, index)
                if slack >= 0.0:
                    break
            self._known[key] = best
        return self._known[key]

    def _slack(self, control: Array, policy: Policy | None) -> float:
        spec = self.spec
        until = None if spec.terminal is None else self._terminal
        least = float(self._needed.min())
        rollout = self.plant.rollout(control, spec.horizon, policy, self._measure, least, until)
        values = np.array(rollout.values)
        slack = float((values - self._needed[: len(values)]).min())
        if math.isnan(slack):
            return -math.inf
        if until is not None and not (rollout.reached or rollout.ended):
            return min(slack, _NOT_REACHED)
        return slack

    def slack(self, control: Array) -> float:
        far = self.spec.max_decrease
        if far is not None and not self._unknown and self._now - self._needed.max() >= far:
            return float(self._now - self._needed.max() - far)
        return self.plan(control).slack

    def candidates(self, control: Array) -> Iterable[Array]:
        firsts = [self._first(index) for index in range(len(self._policies))]
        every = self.plant.neighbours(control, self._offsets, firsts)
        if self.spec.value is None:
            return every
        admitted = np.array([u for u in every if self.admits(u)])
        if not len(admitted):
            return ()
        values = np.asarray(self.spec.value(self.plant.view.observation, admitted), dtype=np.float64)
        if values.shape != (len(admitted),):
            raise ConfigurationError(
                f"value must return a number for each of {len(admitted)} actions, got shape {values.shape}"
            )
        return admitted[np.argsort(np.where(np.isnan(values), np.inf, -values), kind="stable")]

    def backup(self) -> Array | None:
        """What the first backup would do that survives its own action, else what the best one would."""
        firsts: Sequence[Array] = [self._first(index) for index in range(len(self._policies))]
        return max(firsts, key=lambda first: min(self.slack(first), 0.0))

    def executed(self, control: Array) -> Memory:
        known = self._known.get(control.tobytes())
        return self._survivor if known is None else known.backup, control

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        """The plant's own info keys."""
        return self.plant.info()
