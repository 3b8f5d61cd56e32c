"""Stale commands: how old what the machine executes is, found by looking for each command among the proposals."""

import math

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom

OLDEST = 100
"""Proposals that are looked through, control steps back."""
_SAME = 1e-6
"""Difference of two equal commands, as a share of the range: envs may compute in single precision."""
_EVERY = 0.5
"""Share of the commands that has to be found, or nothing is said of their age."""


def ages(env: Env, recording: Recording) -> Array:
    """Control steps between the proposal of each command and its execution, shape (k,); NaN where none was found."""
    proposed, executed = recording.actions, recording.executed
    if executed.shape != proposed.shape:
        raise NotMeasuredError(
            f"a proposal has {proposed.shape[1]} numbers, the env's action {executed.shape[1]}"
        )
    same = _SAME * np.maximum(1.0, np.abs(proposed).max())
    age = np.full(len(executed), np.nan)
    start = 0
    for k in range(len(executed)):
        start = k if recording.first[k] else start
        back = proposed[max(start, k - OLDEST) : k + 1][::-1]
        hit = np.flatnonzero((np.abs(back - executed[k]) <= same).all(axis=1))
        age[k] = hit[0] if hit.size else np.nan
    if np.isfinite(age).mean() < _EVERY:
        raise NotMeasuredError(
            "most commands are none of the proposals: the env, or a wrapper such as a filter, changes actions"
        )
    return age


def measure(env: Env, recording: Recording) -> Measured:
    """For how long the machine went on with a command after the proposals had changed, at most, control steps."""
    changes = np.abs(np.diff(recording.actions, axis=0)).max(axis=1, initial=0.0) > 0.0
    if not changes.any() or changes.mean() < 0.9:
        raise NotMeasuredError(
            "the driver's proposals repeat themselves, so that an old one cannot be told from a new"
        )
    age = ages(env, recording)
    known = age[np.isfinite(age)]
    usual = float(np.median(known))
    evidence = [
        Evidence("usual age of a command", usual, "control steps"),
        Evidence("oldest command", float(known.max()), "control steps"),
        Evidence("steps with a command older than usual", float((known > usual).mean()), "share"),
    ]
    stale = np.nan_to_num(np.maximum(age - usual, 0.0))
    return Measured(float(stale.max()), stale, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """A lease has to be inside of what loses commands: it is told, not tried."""
    lease = 2.0 + float(np.nanmedian(ages(env, recording)))
    seconds = f" ({lease * recording.control_dt:.3g} s)" if math.isfinite(recording.control_dt) else ""
    return "", (
        f"Put LeaseExpiry inside the link, next to the env: a lease of {lease:g} control steps{seconds} lets through "
        "commands that are as old as usual, and brakes from then on."
    )


SYMPTOM = Symptom(
    "commands that go stale: the link is silent or stalls", "section 1.4, leases and reach",
    2.0, "control steps", ("age above the usual one", "control steps"), measure, lines,
)  # fmt: skip
