"""PredictiveShield: an action is admitted if some backup keeps h after it, in a simulation."""

import contextlib
import functools
import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.checks import Array, non_negative, one_number, whole_number
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.filter.constraint import BoundConstraint, Constraint, Memory
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.rollouts import NotFiniteError, RolloutPlant, View

Value = Callable[[Any, Array], ArrayLike]
"""Of an observation and actions, shape (k, m): how good they are, shape (k,)."""
SEES = ("observation", "env", "view")
_ENDS_ALONE = (
    "PredictiveShield judges h at the ends of control steps alone: each has {} physics substeps, and between its "
    'ends h may be lost without a flag. An h that sees="env" is judged at each of them in an env that steps as '
    "Gymnasium's MujocoEnv does. Else keep a margin, or take JointSpeedLimit, JointPositionLimit, SpeedLimit, "
    "Workspace or another constraint that forecasts every substep"
)
_NOT_REACHED = -math.ulp(0.0)  # the slack of a rollout that keeps h but does not end in the terminal set


@dataclass
class PredictiveShield(Constraint):
    """Keep `h >= margin` at every step, by simulating what a backup could do after an action.

    An action is admitted if after it one of the backups keeps h to the horizon, or until the episode ends, or, with a
    `terminal` set, until it has reached that set. Of a refused action's neighbours, and the first actions of the
    backups, the nearest that is admitted is executed, or the best by `value`.

    **Proved for the copy and the terminal set**, if there is one: a state from which a backup reaches it stays such a
    state, whatever the policy does, if the simulation is the env (`SimulatorPlant` checks that), the set is invariant
    under that backup with h >= margin, and backups depend on the state alone. **Best effort: horizon**, without one:
    what comes later is not looked at, and an admitted action may lead where every backup loses.

    **When h is judged**: at the ends of steps; with `sees="env"`, in envs that step as Gymnasium's `MujocoEnv` does,
    at every physics substep. A warning says where it is not. An info key is judged when the env judges it.

    Args:
        h: A function of what it `sees` that returns a number, at least 0 where all is well; or the name of an info
            key that is a cost, positive where it is not ("cost").
        horizon: Steps that are simulated, the proposed action among them.
        backup: "zero" (not with discrete actions), "hold" (the action goes on), an action, a function of what it
            `sees` that returns one, anything with `predict(observation, deterministic=True)` such as an SB3 model; or
            a list of these: any that survives admits. An action is a whole number or an array.
        terminal: A function of what it `sees`: whether the state lies in a set that the backups never leave, with
            h >= margin. None: there is none.
        sees: Whether `h`, `terminal` and `backup` take the "observation", as the env inside the filter returns it,
            the unwrapped "env", or a "view" (`safe_wrappers.plants.View`), which has both, and info.
        candidates: How many neighbours of a refused action are tried. With discrete actions all are.
        value: Chooses among those that are admitted, such as the critic of a learner. None: the
            nearest is taken, and no more are tried.
        margin: Kept free, in the unit of h.
    """

    h: Callable[[Any], float] | str
    horizon: int
    backup: Any = "zero"
    terminal: Callable[[Any], bool] | None = None
    sees: Literal["observation", "env", "view"] = "observation"
    candidates: int = 16
    value: Value | None = None
    margin: float = 0.0

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
        self.promise = "best effort" if self.terminal is None else "proved"
        backups = self.backup if isinstance(self.backup, list | tuple) else [self.backup]
        if not backups:
            raise ConfigurationError("backup is a backup, or a list with at least one")
        self.backup = [_checked(one) for one in backups]


def _checked(backup: Any) -> Any:
    """A backup; of a model its `predict`, which is not copied with the constraint; of an array a list."""
    if hasattr(backup, "predict"):
        return _PolicyBackup(backup)
    if isinstance(backup, str) and backup not in ("zero", "hold"):
        raise UnknownNameError(
            f"no backup {backup!r}; give zero, hold, an action, a function, a model, or a list of these"
        )
    if callable(backup) or isinstance(backup, str):
        return backup
    if not isinstance(backup, np.ndarray | list | tuple | int | np.integer):
        raise ConfigurationError(
            f"backup is zero, hold, an array or a whole number, a function, a model, or a list; got {backup!r}"
        )
    return np.asarray(backup).tolist()


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


class BoundPredictiveShield(BoundConstraint, of=PredictiveShield):
    """PredictiveShield on a plant that simulates."""

    predicts = True
    spec: PredictiveShield
    plant: RolloutPlant

    def __init__(self, spec: PredictiveShield, plant: Plant) -> None:
        if not plant.simulates:
            raise UnsupportedEnvError(
                f"PredictiveShield simulates backups, which a {type(plant).__name__} cannot: take "
                "plant=SimulatorPlant(), and put other constraints' requirements into h"
            )
        super().__init__(spec, plant)
        self.info_keys = self.plant.info_keys
        if not self.plant.simulates_env and (spec.sees == "env" or isinstance(spec.h, str)):
            raise UnsupportedEnvError(
                f"the rollouts of an {type(plant).__name__} have observations alone, and neither an env nor its "
                'info: take sees="observation", and as h a function of it'
            )
        if not self.plant.exact:
            spec.promise = "best effort"  # of an unchecked, noisy or fitted model a set proves nothing
        self._between = spec.sees == "env" and self.plant.judges_substeps
        # The env's own judge, an info key, decides by itself when it looks.
        if self.plant.substeps > 1 and not (self._between or isinstance(spec.h, str)):
            warnings.warn(_ENDS_ALONE.format(self.plant.substeps), stacklevel=2)
        discrete = self.plant.discrete
        if discrete and "zero" in [one for one in spec.backup if isinstance(one, str)]:
            raise ConfigurationError(
                "a discrete action has no zero: give as backup the action that is safe, or hold, or a function"
            )
        self._backups = [self._prepared(one) for one in spec.backup]
        self._needed = spec.margin + self.plant.margins(self._measure, spec.horizon)
        self._points = np.random.default_rng(0).random((spec.candidates, self.plant.lower.size))

    def start(self) -> Memory:
        return 0, np.clip(np.zeros_like(self.plant.lower), self.plant.lower, self.plant.upper)

    def observe(self, memory: Memory) -> None:
        self._survivor, self._last = memory
        self._known: dict[bytes, Plan] = {}
        view = self.plant.view
        # Many envs report their cost after steps, and not after a reset.
        self._unknown = isinstance(self.spec.h, str) and self.spec.h not in view.info
        self._now = math.inf if self._unknown else self._measure(view)
        if not self.plant.exact:  # any more
            self.spec.promise = "best effort"

    def check(self) -> None:
        if np.isfinite(self.plant.state).all():
            for backup in self._backups:
                self._first(backup)

    def value(self) -> Array:
        return np.zeros(0) if self._unknown else np.array([self._now])

    def _measure(self, view: View) -> float:
        """h; NaN where it is not a number."""
        spec = self.spec
        if isinstance(spec.h, str):
            if spec.h not in view.info:
                raise ConfigurationError(f"the env reports no info[{spec.h!r}]; it has {sorted(view.info)}")
            return -float(view.info[spec.h])
        return one_number("h", spec.h(self._seen(view)))

    def _seen(self, view: View) -> Any:
        return view if self.spec.sees == "view" else getattr(view, self.spec.sees)

    def _terminal(self, view: View) -> bool:
        assert self.spec.terminal is not None
        return bool(self.spec.terminal(self._seen(view)))

    def _prepared(self, backup: Any) -> Any:
        """A function, a control, shape (m,), or "hold"."""
        if callable(backup) or (isinstance(backup, str) and backup == "hold"):
            return backup
        zero = isinstance(backup, str)
        return self.plant.control(np.zeros(self.plant.lower.shape) if zero else backup, "the backup")

    def _control(self, backup: Any, view: View) -> Array:
        """What a backup that does not hold would do, shape (m,)."""
        if not callable(backup):
            return np.asarray(backup)
        seen = view.observation if isinstance(backup, _PolicyBackup) else self._seen(view)
        return self.plant.control(backup(seen), "the backup")

    def _action(self, backup: Any, view: View) -> Any:
        return self.plant.action(self._control(backup, view))

    def _first(self, backup: Any) -> Array:
        """What a backup would do now, shape (m,)."""
        return self._last if isinstance(backup, str) else self._control(backup, self.plant.view)

    def _firsts(self) -> list[Array]:
        """What the backups would do now that have an answer."""
        found = []
        for backup in self._backups:
            with contextlib.suppress(NotFiniteError):
                found.append(self._first(backup))
        return found

    def plan(self, control: Array) -> Plan:
        """The first backup that keeps h after a control, the survivor of the last step first, else the best."""
        key = control.tobytes()
        if key not in self._known:
            order = sorted(range(len(self._backups)), key=lambda index: index != self._survivor)
            best = Plan(-math.inf, order[0])
            for index in order:
                slack = self._after(control, self._backups[index])
                if slack > best.slack:
                    best = Plan(slack, index)
                if slack >= 0.0:
                    break
            self._known[key] = best
        return self._known[key]

    def _after(self, control: Array, backup: Any) -> float:
        """The slack of a control with a backup after it; NaN where an h is."""
        spec, policy = self.spec, None if isinstance(backup, str) else functools.partial(self._action, backup)
        until = None if spec.terminal is None else self._terminal
        least = float(self._needed.min())
        try:
            rollout = self.plant.rollout(
                control, spec.horizon, policy, self._measure, least, until, self._between
            )
        except NotFiniteError:
            return -math.inf  # the backup has no answer
        values = np.array(rollout.values)
        slack = float((values - self._needed[: len(values)]).min())
        if until is not None and not (rollout.reached or rollout.ended):
            return min(slack, _NOT_REACHED)
        return slack

    def slack(self, control: Array) -> float:
        return self.plan(control).slack

    def candidates(self, control: Array) -> Iterable[Array]:
        every = self.plant.neighbours(control, self._points, self._firsts())
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
        return max(self._firsts(), key=lambda first: min(self.slack(first), 0.0), default=None)

    def executed(self, control: Array) -> Memory:
        known = self._known.get(control.tobytes())
        return self._survivor if known is None else known.backup, control

    def info(self, proposed: Array | None, executed: Array | None) -> dict[str, Any]:
        """The plant's own info keys."""
        return self.plant.info()
