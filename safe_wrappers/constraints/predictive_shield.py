"""PredictiveShield: an action is admitted if some backup keeps h after it, in a simulation."""

import contextlib
import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnknownNameError,
    UnsupportedEnvError,
    non_negative,
    one_number,
    whole_number,
)
from safe_wrappers.filter.constraint import Constraint, Memory
from safe_wrappers.plants.plant import Model, Plant
from safe_wrappers.plants.simulator import NotFiniteError, View

Value = Callable[[Any, Array], ArrayLike]
"""Of an observation and actions, shape (k, m): how good they are, shape (k,)."""
SEES = ("observation", "env", "view")
_ENDS_ALONE = (
    "PredictiveShield judges h at the ends of control steps alone: each has {} physics substeps, and between its "
    'ends h may be lost without a flag. An h that sees="env" is judged at each of them in an env that steps as '
    "Gymnasium's MujocoEnv does. Else keep a margin, or take JointSpeedLimit, JointPositionLimit, SpeedLimit, "
    "Workspace or another constraint that forecasts every substep"
)
_NOT_REACHED = -1e-6  # the slack of a rollout that keeps h but does not end in the terminal set


class Plan(NamedTuple):
    """What a control leaves of the requirement with the best backup after it, and which one that is."""

    slack: float
    backup: int
    holds: int = 1  # control intervals, as of every trajectory


@dataclass
class PredictiveShield(Constraint, Model):
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
    smooth: ClassVar[bool] = False
    rounding = 1e-12
    recovery_s: ClassVar[float] = 0.0  # from outside, too, h is to be kept

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

    def setup(self, plant: Plant) -> None:
        if not plant.simulates:
            raise UnsupportedEnvError(
                f"PredictiveShield simulates backups, which a {type(plant).__name__} cannot: take "
                "plant=SimulatorPlant(), and put other constraints' requirements into h"
            )
        super().setup(plant)
        if not self.plant.exact:
            self.promise = "best effort"  # of an unchecked or noisy simulation a set proves nothing
        self._between = self.sees == "env" and self.plant.judges_substeps
        # The env's own judge, an info key, decides by itself when it looks.
        if self.plant.substeps > 1 and not (self._between or isinstance(self.h, str)):
            warnings.warn(_ENDS_ALONE.format(self.plant.substeps), stacklevel=2)
        discrete = self.plant.discrete
        if discrete and "zero" in [one for one in self.backup if isinstance(one, str)]:
            raise ConfigurationError(
                "a discrete action has no zero: give as backup the action that is safe, or hold, or a function"
            )
        nothing = np.zeros(self.plant.lower.shape)
        self._backups: list[Any] = [
            one
            if callable(one) or one == "hold"
            else self.plant.control(nothing if one == "zero" else one, "the backup")
            for one in self.backup
        ]
        self._points = np.random.default_rng(0).random((self.candidates, self.plant.lower.size))

    def observe(self, memory: Memory) -> None:
        begins = not memory
        self._last = memory.get("control", np.clip(0.0, self.plant.lower, self.plant.upper))
        self._known: dict[bytes, Plan] = {}
        plans: dict[bytes, Plan] = memory.get("plans", {})
        executed = plans.get(self._last.tobytes())
        self._survivor = memory.get("survivor", 0) if executed is None else executed.backup
        memory["plans"], memory["survivor"] = self._known, self._survivor
        view = self.plant.view
        # Many envs report their cost after steps, and not after a reset.
        unknown = isinstance(self.h, str) and self.h not in view.info
        self._now = np.zeros(0) if unknown else np.array([self._measure(view)])
        if not self.plant.exact:  # any more
            self.promise = "best effort"
        if begins and np.isfinite(self.plant.state).all():
            for backup in self._backups:
                self._control(backup, view)  # refuses at a reset what no action is

    def rollout(self, control: Array | None, horizon: int = 1) -> Plan | None:
        """What a control leads to; nothing of None: the present state is known."""
        return None if control is None else self.plan(control)

    def h_along(self, path: Plan | None) -> Array:
        """The least h."""
        now: Array = self._now[None]
        return now if path is None else np.array([[path.slack + self.margin]])

    def _measure(self, view: View) -> float:
        """h; NaN where it is not a number."""
        if isinstance(self.h, str):
            if self.h not in view.info:
                raise ConfigurationError(f"the env reports no info[{self.h!r}]; it has {sorted(view.info)}")
            return -float(view.info[self.h])
        return one_number("h", self.h(_seen(self.sees, view)))

    def _control(self, backup: Any, view: View) -> Array:
        """What a backup does in a state, shape (m,); the action goes on under "hold"."""
        if isinstance(backup, str):
            return np.asarray(self._last)
        if not callable(backup):
            return np.asarray(backup)
        sees = "observation" if isinstance(backup, _PolicyBackup) else self.sees
        return np.asarray(self.plant.control(backup(_seen(sees, view)), "the backup"))

    def _firsts(self) -> list[Array]:
        """What the backups would do now that have an answer."""
        found = []
        for backup in self._backups:
            with contextlib.suppress(NotFiniteError):
                found.append(self._control(backup, self.plant.view))
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
        plant, terminal = self.plant, self.terminal
        policy = None if isinstance(backup, str) else lambda view: plant.action(self._control(backup, view))
        until = None if terminal is None else lambda view: bool(terminal(_seen(self.sees, view)))
        try:
            rollout = plant.rollout(
                control, self.horizon, policy, self._measure, self.margin, until, self._between
            )
        except NotFiniteError:
            return -math.inf  # the backup has no answer
        slack = float((np.array(rollout.values) - self.margin).min())
        if terminal is not None and not (rollout.reached or rollout.ended):
            return min(slack, _NOT_REACHED)
        return slack

    def proposals(self, control: Array | None) -> Iterable[Array]:
        if control is None:
            # What the first backup would do that survives its own action, else what the best one would.
            return sorted(self._firsts(), key=lambda first: -min(self.plan(first).slack, 0.0))[:1]
        every: list[Array] = self.plant.neighbours(control, self._points, self._firsts())
        if self.value is None:
            return every
        admitted = np.array([u for u in every if self.plan(u).slack >= 0.0])
        if not len(admitted):
            return ()
        values = np.asarray(self.value(self.plant.view.observation, admitted), dtype=np.float64)
        if values.shape != (len(admitted),):
            raise ConfigurationError(
                f"value must return a number for each of {len(admitted)} actions, got shape {values.shape}"
            )
        return admitted[np.argsort(np.where(np.isnan(values), np.inf, -values), kind="stable")]


def _seen(sees: str, view: View) -> Any:
    return view if sees == "view" else getattr(view, sees)


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
