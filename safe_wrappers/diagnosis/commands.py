"""Commands that spike at switches and seams."""

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, box
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, Treatment, wrapped
from safe_wrappers.errors import SafeWrappersError
from safe_wrappers.plants import RigidModelCheck, rigid_model_check
from safe_wrappers.wrappers.chunk_handover import ChunkHandover

RATE = 0.05
"""Share of the range of commands by which the proposed handover lets them change in a control step."""
RINGS = 0.05
"""Of the amplitude of a full step, what a ramp at the rate proposed for joints that ring leaves vibrating."""


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
    gaps = np.diff(np.flatnonzero(steps > 0.5 * figure)) if figure > 0.0 else np.zeros(0)
    if gaps.size:
        evidence.append(Evidence("control steps between large ones, median", float(np.median(gaps)), ""))
    springs = _ringing(env)
    if springs is not None:
        evidence.append(Evidence("slowest resonance of its joints", springs.resonances[0], "rad/s"))
    return Measured(figure, evidence)


def _ringing(env: Env) -> RigidModelCheck | None:
    """Springs behind the motors that ring on after a step; None where there are none, or none can be read."""
    try:
        check = rigid_model_check(env.unwrapped)
    except SafeWrappersError:
        return None
    return None if not check.springs or check.rigid_is_good_enough else check


def treatment_of_steps(env: Env, recording: Recording) -> Treatment:
    """A handover of single actions that bounds the rate of commands.

    A ramp at rate r leaves at most 2 r / (w range) of the amplitude that a step of the whole range leaves in a
    resonance w.
    """
    low, high = box(env)
    chunks = "If the policy gives chunks, pass them whole: ChunkHandover(env, chunk_size=..., execution_horizon=...)."
    springs = _ringing(env)
    if springs is None:
        rate = [RATE * float((high - low).min()) / recording.control_dt]
    else:
        rate = [0.5 * springs.resonances[0] * RINGS * float(span) for span in high - low]
        chunks = f'Its joints ring: this limit is slow. {chunks[:-2]}, flexible="auto").'
    limit = [float(f"{each:.4g}") for each in rate]
    return wrapped(
        ChunkHandover, chunks, chunk_size=1, execution_horizon=1,
        rate_limit=limit if len(limit) > 1 else limit[0],
    )  # fmt: skip


STEPS = Symptom(
    "commands that spike at switches or chunk seams",
    0.2,
    "of the range",
    measure_steps,
    treatment_of_steps,
    True,
)
