"""Spikes at switches and seams: commands that step from one control step to the next."""

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, box
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom

RATE = 0.05
"""Share of the range of commands by which the proposed handover lets them change in a control step."""


def _relative(env: Env, recording: Recording) -> Array:
    """What the env was given, as shares of its range, shape (k, m)."""
    low, high = box(env.unwrapped)
    span = high - low
    return np.asarray(recording.executed / np.where(span > 0.0, span, 1.0))


def _differences(commands: Array, first: np.ndarray, order: int) -> Array:
    """The largest difference of an order of each step, shape (k,); 0 where an episode is too young."""
    found = np.zeros(len(commands))
    steps = np.diff(commands, n=order, axis=0)
    age = np.zeros(len(commands), dtype=int)
    for k in range(1, len(commands)):
        age[k] = 0 if first[k] else age[k - 1] + 1
    if len(steps):
        found[order:] = np.where(age[order:] >= order, np.abs(steps).max(axis=1), 0.0)
    return found


def measure(env: Env, recording: Recording) -> Measured:
    """The largest command steps, but for one in a hundred control steps, as a share of the range."""
    if len(recording.actions) < 2:
        raise NotMeasuredError("a command step takes two control steps")
    commands = _relative(env, recording)
    steps = _differences(commands, recording.first, 1)
    jumps = np.flatnonzero(steps > 0.5 * np.percentile(steps, 99.0)) if steps.any() else np.zeros(0)
    gaps = np.diff(jumps)
    evidence = [
        Evidence(
            f"99th percentile of the {name} difference", float(np.percentile(values, 99.0)), "of the range"
        )
        for name, values in (
            ("second", _differences(commands, recording.first, 2)),
            ("third", _differences(commands, recording.first, 3)),
        )
    ]
    evidence.append(Evidence("median command step", float(np.median(steps)), "of the range"))
    if len(gaps) > 2:
        evidence.append(Evidence("control steps between large ones, median", float(np.median(gaps)), "steps"))
    return Measured(float(np.percentile(steps, 99.0)), steps, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """A handover of single actions that bounds the rate of commands."""
    low, high = box(env)
    rate = RATE * float((high - low).min()) / recording.control_dt
    return (
        f"env = sw.ChunkHandover(\n    env, chunk_size=1, execution_horizon=1, rate_limit={rate:.4g}\n)",
        "If the policy gives chunks, pass them whole: ChunkHandover(env, chunk_size=..., execution_horizon=...).",
    )


SYMPTOM = Symptom(
    "commands that spike at switches or chunk seams", "section 1.3, splines and bumpless transfer",
    0.2, "of the range", ("command step", "of the range"), measure, lines, policies_only=True,
)  # fmt: skip
