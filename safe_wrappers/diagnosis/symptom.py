"""A symptom: how it is measured, and which wrapper treats it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco

from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, physics
from safe_wrappers.wrappers.cbf_action_filter import CBFActionFilter


class NotMeasuredError(Exception):
    """Why a symptom cannot be measured in an env; never leaves this package."""


def require_physics(env: Env) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo's model and data of an env; `NotMeasuredError` where it has none."""
    found = physics(env)
    if found is None:
        raise NotMeasuredError("the env has no MuJoCo model")
    return found


class Measured(NamedTuple):
    """A symptom's figure for one driver, in the symptom's unit, and further numbers."""

    figure: float
    evidence: Sequence[Evidence] = ()


@dataclass(frozen=True)
class Treatment:
    """What helps.

    Attributes:
        code: How the wrapper is typed; "" where none can be tried.
        wrap: Does the same to an env.
        advice: What to do besides, or why no wrapper can be tried.
    """

    code: str = ""
    wrap: Callable[[Env], Env] | None = None
    advice: str = ""


def wrapped(wrapper: Callable[..., Env], advice: str = "", **arguments: Any) -> Treatment:
    """A wrapper of the package, or `protect`, with arguments whose `repr` is how they are typed."""
    words = "".join(f", {name}={value!r}" for name, value in arguments.items())
    code = f"env = sw.{wrapper.__name__}(env{words})"
    return Treatment(code, lambda env: wrapper(env, **arguments), advice)


def filtered(constraint: Callable[..., Any], **arguments: Any) -> Treatment:
    """A filter with one constraint of `safe_wrappers.constraints`; arguments as of `wrapped`."""
    words = ", ".join(f"{name}={value!r}" for name, value in arguments.items())
    code = f"limit = sw.constraints.{constraint.__name__}({words})\nenv = sw.CBFActionFilter(env, [limit])"
    return Treatment(code, lambda env: CBFActionFilter(env, [constraint(**arguments)]))


class Symptom(NamedTuple):
    """One row of the table of symptoms.

    Attributes:
        title: In words.
        threshold: From which on it is a symptom, in `unit`.
        unit: Of the figure; "share" is one of control steps.
        measure: Of an env and what one driver did in it; raises `NotMeasuredError`.
        treatment: For an env and the driver's recording.
        policies_only: Random and attacking drivers have this symptom of themselves.
    """

    title: str
    threshold: float
    unit: str
    measure: Callable[[Env, Recording], Measured]
    treatment: Callable[[Env, Recording], Treatment]
    policies_only: bool = False
