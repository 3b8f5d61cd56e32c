"""A symptom: how it is measured, and which lines treat it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import mujoco

from safe_wrappers.checks import Array
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, physics

Recordings = Mapping[str, Recording]
"""By the driver's name."""


class NotMeasuredError(Exception):
    """Why a symptom cannot be measured in an env; never leaves this package."""


def require_physics(env: Env, that: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo's model and data of an env; `NotMeasuredError` where it has no model `that` could be used."""
    found = physics(env)
    if found is None:
        raise NotMeasuredError(f"the env has no MuJoCo model {that}")
    return found


def replayed(model: mujoco.MjModel, recording: Recording) -> Iterator[tuple[int, mujoco.MjData]]:
    """Every step, and data with where all bodies were after it and how fast."""
    data = mujoco.MjData(model)
    for k, (qpos, qvel) in enumerate(zip(recording.qpos, recording.qvel, strict=True)):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        yield k, data


@dataclass
class Measured:
    """A symptom's figure for one driver.

    Attributes:
        figure: In the symptom's unit.
        steps: The same of every control step, for a plot, shape (k,).
        evidence: Further numbers.
    """

    figure: float
    steps: Array
    evidence: Sequence[Evidence] = field(default_factory=tuple)


class Symptom(NamedTuple):
    """One row of the table of symptoms.

    Attributes:
        title: In words.
        section: Of the appendix.
        threshold: From which on it is a symptom, in `unit`.
        unit: Of the figure; "share" is one of control steps.
        plotted: What a plot shows, and its unit.
        measure: Of an env and what one driver did in it; raises `NotMeasuredError`.
        lines: For an env and the driver's recording: lines that put a wrapper around `env`, and advice.
        policies_only: Random and attacking drivers have this symptom of themselves.
        least: Without a policy the milder of the other drivers counts: what only one of them meets says nothing of
            the env.
    """

    title: str
    section: str
    threshold: float
    unit: str
    plotted: tuple[str, str]
    measure: Callable[[Env, Recording], Measured]
    lines: Callable[[Env, Recording], tuple[str, str]]
    policies_only: bool = False
    least: bool = False
