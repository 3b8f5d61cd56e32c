"""Commands that spike at switches and seams."""

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, box
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, Treatment, wrapped
from safe_wrappers.wrappers.chunk_handover import ChunkHandover

RATE = 0.05
"""Share of the range of commands by which the proposed handover lets them change in a control step."""


def command_steps(env: Env, recording: Recording) -> Array:
    """The largest change of a command in each step, as a share of the range, shape (k,); 0 at an episode's start."""
    low, high = box(env.unwrapped)
    commands = recording.executed / np.where(high > low, high - low, 1.0)
    steps = np.abs(np.diff(commands, axis=0, prepend=commands[:1])).max(axis=1)
    return np.asarray(np.where(recording.first, 0.0, steps))


def measure_steps(env: Env, recording: Recording) -> Measured:
    """The largest command steps, but for one in a hundred control steps, as a share of the range."""
    if len(recording.executed) < 2:
        raise NotMeasuredError("a command step takes two control steps")
    steps = command_steps(env, recording)
    figure = float(np.percentile(steps, 99.0))
    evidence = [Evidence("median command step", float(np.median(steps)), "of the range")]
    return Measured(figure, evidence)


def treatment_of_steps(env: Env, recording: Recording) -> Treatment:
    """A handover of single actions that bounds the rate of commands."""
    low, high = box(env)
    rate = float(f"{RATE * float((high - low).min()) / recording.control_dt:.4g}")
    chunks = "If the policy gives chunks, pass them whole: ChunkHandover(env, chunk_size=..., execution_horizon=...)."
    return wrapped(ChunkHandover, chunks, chunk_size=1, execution_horizon=1, rate_limit=rate)


STEPS = Symptom(
    "commands that spike at switches or chunk seams",
    0.2,
    "of the range",
    measure_steps,
    treatment_of_steps,
    True,
)
